"""Expressions that have no finite value at some instant of a run, known before it."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from cosim.core.clock import Clock, seconds
from cosim.errors import UsageError
from cosim.native.expression import compile_expression
from cosim.native.step import evaluate_at

# that are looked at; what comes later stops the run where it is reached
MOST_POINTS: Final = 1_000_000


def check_finite(text: str, clock: Clock) -> None:
    """Check that an expression is finite at the communication points of a run.

    Raises
    ------
    UsageError
        If it is not; names the first.
    """
    points = min(clock.steps + 1, MOST_POINTS)
    problem = _first_not_finite(text, clock.start_ns, clock.step_ns, points)
    if problem is not None:
        raise UsageError(
            f"alpha {text!r} is {problem.value:g} at t = {problem.time:g} s; needed a finite "
            "number at every communication point of the run"
        )


class _Problem(NamedTuple):
    time: float
    value: float


@lru_cache(maxsize=64)  # source and regressor of a scenario share their alphas
def _first_not_finite(text: str, start_ns: int, step_ns: int, points: int) -> _Problem | None:
    times = seconds(start_ns + step_ns * np.arange(points, dtype=np.int64))
    values = evaluate_at([compile_expression(text)], times)[:, 0]
    is_finite = np.isfinite(values)
    if is_finite.all():
        return None
    first = int(is_finite.argmin())
    return _Problem(float(times[first]), float(values[first]))
