"""Expressions that have no finite value at some instant of a run, known before it."""

from __future__ import annotations

from typing import Final

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
    times_ns = clock.start_ns + clock.step_ns * np.arange(points, dtype=np.int64)
    times = seconds(times_ns)
    values = evaluate_at([compile_expression(text)], times)[:, 0]
    is_finite = np.isfinite(values)
    if not is_finite.all():
        first = int(is_finite.argmin())
        raise UsageError(
            f"alpha {text!r} is {values[first]:g} at t = {times[first]:g} s; needed a finite "
            "number at every communication point of the run"
        )
