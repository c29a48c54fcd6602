"""The trials of a tuning: what was asked for, what it came to, and how many more there may be.

The searches are deterministic: a tuning that goes on begins its search again, and every point that
was tried already is answered from what is known. So it needs no saved state of any optimizer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from cosim.studies.contracts import COMPLETE, MemberOutcome
from cosim.studies.tuning.points import point_name

Evaluate: TypeAlias = Callable[[Sequence[Mapping[str, Any]]], Sequence[MemberOutcome]]

SAMPLES: Final = "samples"  # the metric that counts those of a residual
MOST_REPEATED: Final = 1000  # points in a row, all of them known: the search goes round in circles


class SearchEnded(Exception):
    """A search must end, though it would go on; ``reason`` says why."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class SearchTrial:
    """A point that was tried.

    Parameters
    ----------
    number : int
        Of the member.
    point : mapping of key to value
    objective : float or None
        None: there is none.
    problem : str
        Why there is none; empty: there is one.
    cost : float
        What is minimized; +inf where there is no objective.
    samples : int
        What the metric ``samples`` says; 0: there is none.
    warnings : sequence of str
        What its run warned of.
    """

    number: int
    point: Mapping[str, Any]
    objective: float | None
    problem: str
    cost: float
    samples: int = 0
    warnings: Sequence[str] = ()


class Trials:
    """Tries points, each once, until the members are used up.

    Parameters
    ----------
    evaluate : callable
        Runs points as members, all at a time, and returns their outcomes in their order.
    objective : str
        The name of the metric.
    members : int
        How many there may be; more can be allowed later.
    maximize : bool
    """

    def __init__(
        self, evaluate: Evaluate, *, objective: str, members: int, maximize: bool = False
    ) -> None:
        self._evaluate = evaluate
        self._objective = objective
        self.members = members
        self._sign = -1.0 if maximize else 1.0
        self._by_point: dict[str, SearchTrial] = {}
        self._repeated = 0
        self.best: SearchTrial | None = None

    @property
    def all(self) -> tuple[SearchTrial, ...]:
        """All trials, in the order in which they were asked for."""
        return tuple(self._by_point.values())

    def known(self, point: Mapping[str, Any]) -> SearchTrial | None:
        """Return the trial of a point; None: it was not tried."""
        return self._by_point.get(point_name(point))

    def costs(self, points: Sequence[Mapping[str, Any]]) -> list[float]:
        """Return what is minimized at points; those that are new are run, together.

        Raises
        ------
        SearchEnded
            If there are more new points than members left (the first of them are run), or if no
            point was new for long.
        """
        new: dict[str, Mapping[str, Any]] = {}
        for point in points:
            name = point_name(point)
            if name not in self._by_point:
                new[name] = point
        if new:
            self._repeated = 0
            self._run(new)
        else:
            self._repeated += len(points)
            if self._repeated > MOST_REPEATED:
                raise SearchEnded("the search asked for no new point any more")
        return [self._by_point[point_name(point)].cost for point in points]

    def _run(self, new: Mapping[str, Mapping[str, Any]]) -> None:
        remaining = max(self.members - len(self._by_point), 0)
        names = list(new)[:remaining]
        outcomes = self._evaluate([new[name] for name in names]) if names else []
        for name, outcome in zip(names, outcomes, strict=True):
            self._add(name, new[name], outcome)
        if remaining < len(new):
            raise SearchEnded("all members were used")

    def _add(self, name: str, point: Mapping[str, Any], outcome: MemberOutcome) -> None:
        objective, problem = self._objective_of(outcome)
        cost = math.inf if objective is None else self._sign * objective
        samples = outcome.metrics.get(SAMPLES)
        count = int(samples) if isinstance(samples, float) else 0
        trial = SearchTrial(
            outcome.number, dict(point), objective, problem, cost, count, outcome.warnings
        )
        self._by_point[name] = trial
        if objective is not None and (self.best is None or cost < self.best.cost):
            self.best = trial

    def _objective_of(self, outcome: MemberOutcome) -> tuple[float | None, str]:
        """Return the objective, and why there is none."""
        if outcome.status != COMPLETE:
            return None, outcome.reason or "failed"
        value = outcome.metrics.get(self._objective)
        if value is None:
            return None, "the objective has no value"
        if isinstance(value, str) or not math.isfinite(value):
            return None, f"the objective is {value}, no finite number"
        return float(value), ""
