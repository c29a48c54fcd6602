"""Scenarios on workers that have neither their files nor, perhaps, the modules of users.

A path below ``/proc/self/cwd`` is another file in every process: nobody else has those of this one.
"""

import hashlib
import shutil
import sys

import pytest

from cosim.errors import UsageError
from cosim.studies.cluster import cluster_workers
from cosim.studies.cluster.cluster_run import run_on_cluster
from cosim.studies.contracts import FAILED, StudyMember, StudySubject
from cosim.studies.dataset import metric_column, parameter_column
from cosim.studies.dataset import StudyIdentity
from cosim.studies.dataset import StudyDataset
from cosim.studies.workers.pool import WorkerPool
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS
from tests.scenario.user_modules import RELAY, THERMOSTAT
from tests.studies.cluster.planned import assert_same

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="/proc is of Linux"),
]

RUNNER = "cosim.studies.members.runner:open_runner"
HERE = "/proc/self/cwd"
WITH_FMU = """
scenario = { name = "x", stop = 0.1, step = 0.01 }
[components]
plant = { kind = "fmu", path = "../fmus/GOOD.fmu" }
other = { kind = "fmu", path = "/proc/self/cwd/fmus/GOOD.fmu" }
"""


class ListedMembers:
    """Members as they are given."""

    def __init__(self, members):
        self._members = members

    def __len__(self):
        return len(self._members)

    def members(self, begin=0, end=None):
        """Return the members from one number to another."""
        return self._members[begin:end]


def identity(members):
    """Return what the study is about."""
    return StudyIdentity(
        name="x",
        text="",
        digests={},
        columns=(parameter_column("swap.plant", ["x"]), metric_column("y", "last(plant.y)")),
        members=members,
        part_size=5,
    )


def hashed(folder):
    """Return the files of a folder, under paths that are this process's own, with their hashes."""
    return {
        f"{HERE}/{path.relative_to(folder)}": hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*.*")
    }


@pytest.mark.usefixtures("worker_processes")
def test_files_are_sent_and_outcomes_name_those_of_the_planner(two_workers, tmp_path, monkeypatch):
    """A scenario with a relative and an absolute path, FMUs that members swap, one that fails."""
    folder = tmp_path / "study"
    (folder / "x").mkdir(parents=True)
    (folder / "fmus").mkdir()
    for name in ("GOOD", "FAILS_STEP", "CRASH"):
        built = compile_fmu(
            tmp_path / f"{name}.fmu", STATELESS, "rogue2.c", defines=(f"ROGUE={name}",)
        )
        shutil.copy(built, folder / "fmus")
    (folder / "x" / "s.toml").write_text(WITH_FMU)
    monkeypatch.chdir(folder)
    others = {1: "FAILS_STEP", 4: "CRASH", 7: "FAILS_STEP"}
    swaps = {n: {"plant": f"{HERE}/fmus/{name}.fmu"} for n, name in others.items()}
    design = ListedMembers([StudyMember(n, swap=swaps.get(n, {})) for n in range(12)])
    subject = StudySubject(f"{HERE}/x/s.toml", metrics={"y": "last(plant.y)"})
    with StudyDataset.open_or_create(tmp_path / "a", identity(12)) as dataset:
        run_on_cluster(
            two_workers.address, subject, design, dataset, str(tmp_path / "a"), files=hashed(folder)
        )
        found = dataset.read()
    with (
        StudyDataset.open_or_create(tmp_path / "b", identity(12)) as dataset,
        WorkerPool(RUNNER, subject, 1) as pool,
    ):
        for result in pool.run(design.members()):
            dataset.add(*result)
        needed = dataset.read()
    reasons = found.column("reason").to_pylist()
    assert f"{HERE}/fmus/FAILS_STEP.fmu" in reasons[1]
    own = [reason and reason.replace(str(folder), HERE) for reason in needed["reason"].to_pylist()]
    place = needed.column_names.index("reason")
    assert_same(found, needed.set_column(place, "reason", [own]))
    assert found.column("status").to_pylist().count(FAILED) == 3


def of_thermostat(folder):
    """Return a study of the thermostat in a folder, whose class is beside it."""
    (folder / "x").mkdir(parents=True)
    (folder / "x" / "s.toml").write_text(THERMOSTAT)
    (folder / "x" / "relay.py").write_text(RELAY)
    members = [StudyMember(n, {"relay.width": 0.1 + n / 10}) for n in range(4)]
    return ListedMembers(members), StudySubject(
        f"{HERE}/x/s.toml", metrics={"y": "max(room.y)"}, set={"scenario.stop": 5.0}
    )


def test_modules_of_users_go_with_the_scenario(two_workers, tmp_path, monkeypatch):
    """Where they are among the files."""
    design, subject = of_thermostat(tmp_path / "study")
    monkeypatch.chdir(tmp_path / "study")
    with StudyDataset.open_or_create(tmp_path / "a", identity(4)) as dataset:
        place = str(tmp_path / "a")
        files = hashed(tmp_path / "study")
        run_on_cluster(two_workers.address, subject, design, dataset, place, files=files)
        assert dataset.read().column("reason").null_count == 4


def test_a_worker_without_the_class_of_a_user_is_named(two_workers, tmp_path, monkeypatch):
    """It is found before the first member; here, where the study is planned, it is there."""
    monkeypatch.setattr(cluster_workers, "PATIENCE", 0.0)
    design, subject = of_thermostat(tmp_path / "study")
    monkeypatch.chdir(tmp_path / "study")
    files = {
        path: hash_ for path, hash_ in hashed(tmp_path / "study").items() if "relay" not in path
    }
    with StudyDataset.open_or_create(tmp_path / "a", identity(4)) as dataset:
        place = str(tmp_path / "a")
        with pytest.raises(UsageError, match=r"no worker can run the study: tcp://.*relay"):
            run_on_cluster(two_workers.address, subject, design, dataset, place, files=files)
        assert len(dataset) == 0
