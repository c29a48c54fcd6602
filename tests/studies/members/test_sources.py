"""Members read what was there when their study was planned, or have no outcome."""

import os
import shutil

import pytest

import cosim
from cosim.digests import sha256_of
from cosim.errors import ChangedFileError
from cosim.fmi.reading.model_description import read
from cosim.studies.contracts import COMPLETE, StudyMember, StudySubject
from cosim.studies.members.logging_runner import open_logging_runner
from cosim.studies.members.runner import open_runner
from cosim.studies.workers.pool import WorkerPool
from tests.fmi.small import able, compiled
from tests.scenario.user_modules import RELAY, THERMOSTAT

RUNNER = "cosim.studies.members.runner:open_runner"
CHANGED = r"{} has changed since this study began: .*put it back as it was .* new=True"
SCENARIO = """
scenario = { name = "x", stop = 0.1, step = 0.01 }
[components]
u = { kind = "table", file = "u.csv" }
plant = { kind = "fmu", path = "a.fmu" }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture(scope="module")
def binary(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("binary"))


@pytest.fixture
def subject(tmp_path, binary):
    """Return what members of a scenario with a table and FMUs have in common, all files hashed."""
    (tmp_path / "x.toml").write_text(SCENARIO)
    (tmp_path / "u.csv").write_text("t,y\n0,1\n1,1\n")
    for name, x in (("a", 1.0), ("b", 2.0), ("c", 3.0)):
        able(binary, tmp_path / f"{name}.fmu", A=-1.0, B=1.0, C=1.0, x=x)
    digests = {str(path): sha256_of(path) for path in tmp_path.iterdir()}
    return StudySubject(
        str(tmp_path / "x.toml"),
        set={"plant.start": {"A": -1.0}},
        metrics={"y": "last(plant.y)"},
        digests=digests,
    )


def swapped(folder, number, name):
    return StudyMember(number, swap={"plant": str(folder / f"{name}.fmu")})


@pytest.mark.parametrize("name", ["x.toml", "u.csv", "a.fmu"])
def test_a_worker_that_starts_later_refuses_changed_files(subject, tmp_path, name):
    """Of the scenario, of a table, and of an FMU that all members read."""
    with (tmp_path / name).open("ab") as file:
        file.write(b"\n")
    with pytest.raises(ChangedFileError, match=CHANGED.format(name)):
        open_runner(subject)


def test_a_pool_ends_with_what_its_worker_found(subject, tmp_path):
    """When a worker is replaced, or in the middle of its members; what came before is kept."""
    members = [*map(StudyMember, range(3)), swapped(tmp_path, 3, "b")]
    (tmp_path / "b.fmu").write_bytes(b"another")
    with WorkerPool(RUNNER, subject, 1, members_per_worker=3) as pool:
        results = pool.run(members)
        assert [next(results)[0].number for _ in range(3)] == [0, 1, 2]
        with pytest.raises(ChangedFileError, match=CHANGED.format(r"b\.fmu")):
            next(results)
        (tmp_path / "a.fmu").write_bytes(b"another")
        with pytest.raises(ChangedFileError, match=CHANGED.format(r"a\.fmu")):
            next(pool.run(members))


def test_a_file_that_changes_between_members_is_found(subject, tmp_path, binary):
    """Also where the process knows it already, and where no other member reads it."""
    with open_runner(subject) as runner:
        assert runner.run(swapped(tmp_path, 0, "b")).status == COMPLETE
        (tmp_path / "b.fmu").unlink()
        able(binary, tmp_path / "b.fmu", A=-1.0, B=1.0, C=1.0, x=5.0)
        assert runner.run(swapped(tmp_path, 1, "c")).status == COMPLETE
        with pytest.raises(ChangedFileError, match=CHANGED.format("b.fmu")):
            runner.run(swapped(tmp_path, 2, "b"))


def test_a_file_that_is_gone_is_no_failure_of_its_member(subject, tmp_path):
    """The study cannot go on without it."""
    with open_runner(subject) as runner:
        (tmp_path / "c.fmu").unlink()
        with pytest.raises(ChangedFileError, match=r"c\.fmu .*cannot be read \(No such file"):
            runner.run(swapped(tmp_path, 0, "c"))


def test_the_same_content_is_the_same_file(subject, tmp_path):
    """Touched, or written again."""
    with open_runner(subject) as runner:
        os.utime(tmp_path / "u.csv", ns=(1, 1))
        shutil.copy(tmp_path / "a.fmu", tmp_path / "copy")
        (tmp_path / "copy").replace(tmp_path / "a.fmu")
        assert runner.run(StudyMember(0)).status == COMPLETE


def test_a_file_that_changes_during_a_member_discards_its_outcome(subject, tmp_path, monkeypatch):
    """Nobody knows which of the two contents it read."""
    from cosim.studies.members import runner as module

    run_rows = module.run_rows

    def changing(*arguments):
        run_rows(*arguments)
        (tmp_path / "u.csv").write_text("t,y\n0,2\n1,2\n")

    monkeypatch.setattr(module, "run_rows", changing)
    with open_runner(subject) as runner, pytest.raises(ChangedFileError, match=r"u\.csv"):
        runner.run(StudyMember(0))


def test_members_that_run_again_for_their_log_are_checked(subject, tmp_path):
    """As those that run for the first time."""
    with open_logging_runner(subject) as runner:
        (tmp_path / "b.fmu").write_bytes(b"another")
        with pytest.raises(ChangedFileError, match=r"b\.fmu"):
            runner.run(swapped(tmp_path, 0, "b"))


def test_the_module_of_a_user_is_checked(tmp_path):
    """It is imported again where it has changed, so that later members had another class."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text(RELAY)
    path = str(tmp_path / "x.toml")
    digests = {path: sha256_of(path)}
    subject = StudySubject(
        path, {"scenario.stop": 1.0}, metrics={"y": "max(room.y)"}, digests=digests
    )
    with open_runner(subject) as runner:
        assert runner.run(StudyMember(0)).status == COMPLETE
        (tmp_path / "relay.py").write_text(RELAY + "\n")
        with pytest.raises(ChangedFileError, match=r"relay\.py"):
            runner.run(StudyMember(1))
    other = StudySubject(
        **{**subject.to_dict(), "digests": {**digests, "code of relay:Relay": "1"}}
    )
    with (
        open_runner(other) as runner,
        pytest.raises(ChangedFileError, match="the code of relay:Relay has changed"),
    ):
        runner.run(StudyMember(0))


def test_a_recording_is_checked(tmp_path):
    """With the files before it, where it was rotated."""
    log = tmp_path / "run.mcap"
    cosim.run("academic", out=log, set={"scenario.stop": 0.2})
    subject = StudySubject("academic", metrics={"y": "last(plant.y)"}, digests={str(log): ""})
    member = StudyMember(0, recording=str(log))
    with open_runner(subject) as runner, pytest.raises(ChangedFileError, match=r"run\.mcap"):
        runner.run(member)
    digests = {str(log): sha256_of(log), str(tmp_path / "run.part2.mcap"): sha256_of(log)}
    subject = StudySubject(**{**subject.to_dict(), "digests": digests})
    with open_runner(subject) as runner:
        assert runner.run(member).status == COMPLETE
        log.write_bytes(b"")
        part = StudyMember(0, recording=str(tmp_path / "run.part2.mcap"))
        with pytest.raises(ChangedFileError, match=r"run\.mcap"):
            runner.run(part)


def test_replays_unpack_an_fmu_once(subject, tmp_path, monkeypatch):
    """As runs do; what they come to is as of a replay alone, bit for bit."""
    log = tmp_path / "run.mcap"
    cosim.run(subject.scenario, set=subject.set, out=log)
    swap = {"plant": str(tmp_path / "b.fmu")}
    changes = [{"plant.start": {"A": -1.0 - n}} for n in range(2)]
    alone = [cosim.replay(log, swap=swap, set=one)["plant.y"][-1] for one in changes]
    unpacked = []

    def counted(*given, **into):
        unpacked.append(given)
        return read(*given, **into)

    monkeypatch.setattr("cosim.fmi.unpacked.read", counted)
    replayed = StudySubject(subject.scenario, metrics=subject.metrics)
    with open_runner(replayed) as runner:
        for number, one in enumerate(changes):
            outcome = runner.run(StudyMember(number, one, swap, str(log)))
            assert outcome.metrics == {"y": alone[number]}, outcome.reason
    assert len(unpacked) == 1
