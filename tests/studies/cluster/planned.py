"""Studies whose members cost what they say, and follow from their numbers."""

import math
import os
import time
from pathlib import Path

from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome, StudyMember, StudySubject
from cosim.studies.dataset import metric_column, parameter_column
from cosim.studies.dataset import StudyIdentity
from tests.studies.cluster.processes import LIMIT

OPENER = "tests.studies.cluster.planned:open_counted"
SUBJECT = StudySubject("counted", metrics={"root": "last(plant.y)"})
APART = {"wall_time", "worker"}


class CountedMembers:
    """Members that are numbers."""

    def __init__(self, count, **same):
        self.count = count
        self.same = same

    def __len__(self):
        return self.count

    def members(self, begin=0, end=None):
        """Return the members from one number to another."""
        numbers = range(begin, self.count if end is None else end)
        return [StudyMember(number, {"x": number / 7, **self.same}) for number in numbers]


class CountedRunner:
    """Takes the root of ``x``; every eleventh member fails, every 31st ends its process."""

    def __enter__(self):
        return self

    def __exit__(self, error_type, error, trace):
        pass

    def run(self, member):
        """Run a member, or say that it could be."""
        if member.number < 0:
            return MemberOutcome(member.number, COMPLETE)
        began = time.perf_counter()
        if "marks" in member.set:
            Path(member.set["marks"], f"{member.number}-{os.getpid()}").touch()
        spend(member.set.get("cost", 0.0))
        time.sleep(member.set.get("sleeps", 0.0))
        if member.number >= member.set.get("waiting from", math.inf):
            wait_for(Path(member.set["waits for"]))
        if member.set.get("ends the worker of dask") == member.number:
            os.kill(os.getppid(), 9)
        if member.set.get("crashes") and member.number % 31 == 30:
            os.kill(os.getpid(), 11)
        wall_time = time.perf_counter() - began
        if member.number % 11 == 10:
            return MemberOutcome(member.number, FAILED, "it is an eleventh", wall_time=wall_time)
        metrics = {"root": math.sqrt(member.set["x"])}
        return MemberOutcome(
            member.number, COMPLETE, steps=member.number, metrics=metrics, wall_time=wall_time
        )


def spend(seconds):
    """Use a processor for some time [s]."""
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


def wait_for(path):
    """Wait until a file is there."""
    until = time.monotonic() + LIMIT
    while not path.exists() and time.monotonic() < until:
        time.sleep(0.01)


def open_counted(subject):
    """Open the runner above."""
    return CountedRunner()


def identity(members, part_size=20):
    """Return what the study is about."""
    columns = (
        parameter_column("x", [0.5]),
        metric_column("root", "last(plant.y)"),
    )
    return StudyIdentity(
        name="counted",
        text="",
        digests={"key scenario.stop": "ab" * 32},
        columns=columns,
        members=members,
        part_size=part_size,
    )


def assert_same(found, needed):
    """Compare column by column, but for where and how long members ran."""
    assert found.column_names == needed.column_names
    for name in set(found.column_names) - APART:
        assert found.column(name).to_pylist() == needed.column(name).to_pylist(), name
