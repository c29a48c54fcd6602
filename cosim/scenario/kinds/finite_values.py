"""Expressions that have no finite value at some instant of a run, known before it."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.errors import UsageError
from cosim.instants import Grid
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.programs import evaluate_at

# that are looked at; what comes later stops the run where it is reached
MOST_POINTS: Final = 1_000_000


def check_finite(text: str, clock: Clock) -> None:
    """Check that an expression is finite at the communication points of a run.

    Raises
    ------
    UsageError
        If it is not; names the first.
    """
    problem = _first_of_expression(text, clock.grid, _points(clock))
    _refuse(text, problem)


def check_finite_values(text: str, values: Callable[[Vector], Vector], clock: Clock) -> None:
    """Check that a signal that is known before the run is finite at its communication points.

    Parameters
    ----------
    text : str
        Its name.
    values : callable
        Of the signal at instants of the run ``(N,)`` [s].
    clock : Clock

    Raises
    ------
    UsageError
        If it is not; names the first.
    """
    times = clock.grid.time(np.arange(_points(clock)))
    _refuse(text, _first_not_finite(times, values(times)))


def _refuse(text: str, problem: _Problem | None) -> None:
    if problem is not None:
        raise UsageError(
            f"alpha {text!r}: expected a finite value at every communication point of the run, "
            f"got {problem.value:g} at t = {problem.time:g} s"
        )


def _points(clock: Clock) -> int:
    return min(clock.steps + 1, MOST_POINTS)


class _Problem(NamedTuple):
    time: float
    value: float


@lru_cache(maxsize=64)  # source and regressor of a scenario share their alphas
def _first_of_expression(text: str, grid: Grid, points: int) -> _Problem | None:
    times = grid.time(np.arange(points))
    return _first_not_finite(times, evaluate_at([compile_expression(text)], times)[:, 0])


def _first_not_finite(times: Vector, values: Vector) -> _Problem | None:
    is_finite = np.isfinite(values)
    if is_finite.all():
        return None
    first = int(is_finite.argmin())
    return _Problem(float(times[first]), float(values[first]))
