"""Which workers a study uses, on a cluster in this process, whose workers are made to differ."""

import hashlib
import threading
import zipfile
from dataclasses import astuple

import pytest

from cosim.errors import RunError, UsageError
from cosim.studies.cluster import (
    admission,
    cluster_workers,
    environment,
    file_copies,
    worker_functions,
)
from cosim.studies.cluster.cluster_run import run_on_cluster
from cosim.studies.cluster.study_plugin import StudyPlugin
from cosim.studies.contracts import MemberOutcome
from cosim.studies.dataset import StudyDataset
from tests.studies.cluster.planned import OPENER, SUBJECT, CountedMembers, identity

pytestmark = pytest.mark.slow

LIMIT = 20.0  # [s], which nothing here takes


@pytest.fixture(scope="module")
def local():
    """Serve a cluster without workers, inside of this process."""
    import distributed

    with distributed.LocalCluster(
        processes=False,
        n_workers=0,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",  # None: a port that others may have
    ) as cluster:
        yield cluster


@pytest.fixture
def client(local, monkeypatch):
    """Return a client of a cluster with one worker, where nobody waits for another."""
    import distributed

    monkeypatch.setattr(cluster_workers, "PATIENCE", 0.0)
    local.scale(1)
    with distributed.Client(local, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=LIMIT)
        yield client
        local.scale(0)
        while client.nthreads():
            pass


def run(client, place, *, count=6, files=None, **options):
    """Run a study in a new dataset; return how many members have an outcome."""
    with StudyDataset.open_or_create(place, identity(count)) as dataset:
        run_on_cluster(
            client,
            SUBJECT,
            CountedMembers(count, sleeps=0.02),
            dataset,
            str(place),
            files=files or {},
            opener=OPENER,
            **options,
        )
        return len(dataset)


def test_an_outcome_comes_back_with_all_that_it_has():
    start = (3, "failed", "it is lost", 5, {"y": 1.0}, 0.5, "{}", "a worker")
    values = (*start, ["it is late"], {"log": True})
    outcome = MemberOutcome(*values)
    assert values == astuple(outcome) == worker_functions.plain_outcome(outcome)


def test_a_worker_that_comes_does_not_hold_up_the_others(client, local, tmp_path, monkeypatch):
    """What takes long on it is done while they run members."""
    is_complete = threading.Event()
    in_time = []
    prepare = StudyPlugin._prepare

    def slow(self):
        if in_time:
            in_time.append(is_complete.wait(LIMIT))
        in_time.append(True)
        prepare(self)

    def add(done, planned, failed):
        local.scale(2)
        if done == planned:
            is_complete.set()

    monkeypatch.setattr(StudyPlugin, "_prepare", slow)
    assert run(client, tmp_path / "a", count=60, progress=add) == 60
    assert all(in_time)


def test_a_study_waits_for_another_worker_where_one_is_excluded(
    client, local, tmp_path, monkeypatch
):
    """And says what it waits for, and why those that are there are not used."""
    monkeypatch.setattr(cluster_workers, "PATIENCE", LIMIT)
    own = environment.describe_environment()
    answers = [{**own, "numpy": "0.1"}]
    monkeypatch.setattr(
        worker_functions, "describe_environment", lambda: answers.pop() if answers else own
    )
    answers.append(own)  # of the scheduler
    notices = []

    def add(text):
        notices.append(text)
        local.scale(2)

    assert run(client, tmp_path / "a", notice=add) == 6
    reason = f"expected numpy {own['numpy']}, got 0.1"
    assert [text.replace(*_address(text)) for text in notices] == [
        f"worker X is not used: {reason}",
        f"no worker can run the study: X: {reason}; waiting 20 s for a suitable worker",
    ]


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("python", "expected Python 3.*, got other"),
        ("cosim", "expected cosim .*, got other"),
        ("content", "expected a cosim whose source has the hash .*, got other"),
        ("numpy", "expected numpy .*, got other"),
        ("scipy", "expected scipy .*, got other"),
        ("system", r"plant.fmu has no binary for .*-other; available: x86_64-linux;"),
    ],
)
def test_a_worker_that_differs_is_not_used(key, reason, client, tmp_path, monkeypatch):
    """Where no other comes, no member is run."""
    path = tmp_path / "plant.fmu"
    write_fmu(path)
    own = environment.describe_environment()
    answers = [{**own, key: "other"}, own]  # the scheduler's is asked first
    monkeypatch.setattr(worker_functions, "describe_environment", answers.pop)
    with pytest.raises(UsageError, match=f"^no worker can run the study: inproc://.*: {reason}"):
        run(client, tmp_path / "a", files={str(path): hash_of(path)})


@pytest.mark.parametrize("key", ["python", "cosim"])
def test_a_scheduler_that_differs_is_one_error(key, client, tmp_path, monkeypatch):
    """It reads the tasks."""
    other = {**environment.describe_environment(), key: "other"}
    monkeypatch.setattr(worker_functions, "describe_environment", lambda: other)
    with pytest.raises(UsageError, match=r"^the scheduler at inproc.* cannot read .*got other"):
        run(client, tmp_path / "a")


def test_a_scheduler_without_workers_is_one_error(local, tmp_path, monkeypatch):
    """After a while; until then some may come."""
    import distributed

    monkeypatch.setattr(cluster_workers, "PATIENCE", 0.0)
    notices = []
    with (
        distributed.Client(local, set_as_default=False) as client,
        pytest.raises(RunError, match=r"^the scheduler had no workers for 0 s; start some"),
    ):
        run(client, tmp_path / "a", notice=notices.append)
    (notice,) = notices
    assert notice.startswith("the scheduler has no workers for the study; waiting 0 s for a ")


@pytest.mark.parametrize("is_direct", [True, False])
def test_files_pass_the_scheduler_only_where_workers_cannot_be_reached(
    is_direct, client, tmp_path, monkeypatch
):
    """Each content goes to each worker once."""
    import distributed

    monkeypatch.setattr(file_copies, "_has", lambda path, digest: False)
    sent = []
    scatter = distributed.Client.scatter

    def note(self, data, **options):
        sent.append((data, options["direct"]))
        return scatter(self, data, **options)

    monkeypatch.setattr(distributed.Client, "scatter", note)
    if not is_direct:
        monkeypatch.setattr(admission, "CONNECTING", -1.0)
    files = {}
    for name in ("a", "b"):
        path = tmp_path / name
        path.write_bytes(f"the same, {is_direct}".encode())
        files[str(path)] = hash_of(path)
    for place in ("x", "y"):
        assert run(client, tmp_path / place, files=files) == 6
    assert sent == [(path.read_bytes(), is_direct)]


def test_a_large_file_does_not_pass_the_scheduler(client, tmp_path, monkeypatch):
    """The reason says what to do."""
    monkeypatch.setattr(file_copies, "_has", lambda path, digest: False)
    monkeypatch.setattr(admission, "CONNECTING", -1.0)
    monkeypatch.setattr(admission, "MOST_RELAYED", 2_000_000)
    path = tmp_path / "large.csv"
    path.write_bytes(bytes(3_000_000))
    with pytest.raises(UsageError, match=r"large.csv has 3 MB, and .* at most 2 MB are sent"):
        run(client, tmp_path / "a", files={str(path): hash_of(path)})


def test_a_file_that_changes_meanwhile_is_not_sent(client, tmp_path, monkeypatch):
    """Members would not be what the dataset says."""
    monkeypatch.setattr(file_copies, "_has", lambda path, digest: False)
    path = tmp_path / "table.csv"
    path.write_bytes(b"1")
    with pytest.raises(UsageError, match=r"table.csv changed while the study ran; run it agai"):
        run(client, tmp_path / "a", files={str(path): "0" * 64})


def write_fmu(path):
    """Write what has a binary for one platform, which is all that is asked of it."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("binaries/x86_64-linux/plant.so", b"")


def hash_of(path):
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _address(text):
    return next(word for word in text.split() if word.startswith("inproc:")).rstrip(":"), "X"
