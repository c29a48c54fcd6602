"""Objectives in closed form, as members would evaluate them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome

OBJECTIVE = "J"


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
