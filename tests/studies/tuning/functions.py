"""Objectives in closed form, as members would evaluate them."""

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest

from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome, StudyMember
from cosim.studies.dataset import metric_column
from cosim.studies.dataset import StudyIdentity
from cosim.studies.dataset import StudyDataset
from cosim.studies.tuning.members import TrialMembers, in_pool
from cosim.studies.tuning.recorded import TuningDataset
from cosim.studies.tuning.searching import METHODS

OBJECTIVE = "J"
# optuna is not there where the slow tests are left out
EACH_METHOD = [
    pytest.param(method, marks=pytest.mark.slow) if method == "optuna" else method
    for method in METHODS
]


class Recorded:
    """Evaluates a function of the values by key; ``batches`` are the points that it was given."""

    def __init__(self, function: Callable[[Mapping[str, Any]], float]) -> None:
        self.function = function
        self.batches: list[list[dict[str, Any]]] = []

    def __call__(self, points: Sequence[Mapping[str, Any]]) -> list[MemberOutcome]:
        self.batches.append([dict(point) for point in points])
        first = len(self.points) - len(points)
        return [self._outcome(first + k, point) for k, point in enumerate(points)]

    @property
    def points(self) -> list[dict[str, Any]]:
        return [point for batch in self.batches for point in batch]

    def _outcome(self, number: int, point: Mapping[str, Any]) -> MemberOutcome:
        try:
            return MemberOutcome(number, COMPLETE, metrics={OBJECTIVE: self.function(point)})
        except ArithmeticError as error:
            return MemberOutcome(number, FAILED, reason=str(error))


class CountingPool:
    """Runs members here; their outcomes follow from their values. It may be lost with one."""

    def __init__(self, function, most):
        self.function = function
        self.most = most
        self.ran = []

    def run(self, members):
        """Yield members with their outcomes, the last of a batch first."""
        for member in reversed(list(members)):
            if len(self.ran) == self.most:
                raise KeyboardInterrupt
            self.ran.append(member)
            metrics = {"objective": self.function(member.set)}
            yield member, MemberOutcome(member.number, COMPLETE, metrics=metrics)


def tried(place, columns, ask, function=lambda point: float(len(repr(point))), *, most=math.inf):
    """Ask for points with a dataset, until ``most`` have run; return them, and its rows at the end.

    ``ask`` takes what evaluates batches of points.
    """
    pool = CountingPool(function, most)
    identity = StudyIdentity("x", "", {}, (*columns, metric_column("objective")), 100)
    with contextlib.closing(TuningDataset(place, identity)) as dataset:
        run = in_pool(pool)
        with contextlib.suppress(KeyboardInterrupt):
            ask(TrialMembers(run, run, _member_of, dataset, members=100))
    rows = StudyDataset.open(place).read().to_pylist() if place.exists() else []
    return pool.ran, repr(rows)


def _member_of(number, point):
    return StudyMember(number, dict(point))
