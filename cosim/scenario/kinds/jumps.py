"""Expressions in t that a run cannot have as they are: that jump between points, or are not finite.

A continuous signal is interpolated linearly between two communication points, so a jump in it would
become a ramp of a whole step. A discrete one holds its value from a communication point on, so it
can jump there, to the value that it has after the jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.errors import UsageError
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.jumps import Jump, jumps
from cosim.native.numerics.programs import evaluate

# that are looked at; what comes later stops the run where it is reached
MOST_POINTS: Final = 1_000_000


def check_continuous(text: str, clock: Clock, way_out: str) -> None:
    """Check that an expression does not jump during a run.

    Raises
    ------
    UsageError
        If it may; ``way_out`` says what can be done.
    """
    for jump in _jumps_in_run(text, clock):
        at = "" if jump.instant is None else f" at {jump.instant!r} s"
        raise UsageError(
            f"expression {text!r}: {jump.text} jumps{at}; linear interpolation would turn the "
            f"jump into a ramp over one step; {way_out}"
        )


def check_sampled(text: str, clock: Clock) -> list[str]:
    """Check the jumps of an expression that is evaluated at the communication points and held.

    Returns
    -------
    list of str
        What is to be known of those whose instants are not known.

    Raises
    ------
    UsageError
        If a jump is known to be between two communication points, or the value at the jump is not
        the one after it, which has to hold from there.
    """
    notes = []
    for jump in _jumps_in_run(text, clock):
        if jump.instant is None:
            notes.append(
                f"{jump.text} jumps where its argument passes 0; between two communication points "
                "that shows at the second: an error of first order in the step"
            )
            continue
        times = np.array([jump.instant])
        if not clock.is_point(times)[0]:
            before, after = clock.points_around(jump.instant)
            raise UsageError(
                f"expression {text!r}: {jump.text} jumps at {jump.instant!r} s, between two "
                f"communication points; expected {before!r} s or {after!r} s"
            )
        point = float(clock.nearest_points(times)[0])
        if point < clock.stop and not _holds_value_after(jump, point):
            raise UsageError(
                f"expression {text!r}: {jump.text} still has the value before its jump at the "
                f"communication point {point!r} s and would hold it for a step; write {jump.remedy}"
            )
    return notes


def _jumps_in_run(text: str, clock: Clock) -> list[Jump]:
    """Return the jumps that may change a value of a run."""
    return [jump for jump in jumps(text) if _is_in_run(jump, clock)]


def _is_in_run(jump: Jump, clock: Clock) -> bool:
    if jump.instant is None:
        return True
    if jump.instant == clock.start_time:  # only the value after it counts, if that is there
        return not _holds_value_after(jump, jump.instant)
    return clock.start_time < jump.instant <= clock.stop and math.isfinite(jump.instant)


def _holds_value_after(jump: Jump, point: float) -> bool:
    """Return whether the value at a jump is the one after it, as it is computed."""
    value = evaluate(compile_expression(jump.text), point)
    return value == evaluate(compile_expression(jump.remedy), point + 1.0)


def seen_late(what: str, discrete: bool, way_out: str) -> str:
    """Return what is to be known of an output that jumps with what is interpolated linearly.

    ``discrete`` says that it holds its value over a step, ``way_out`` what can be done if not.
    """
    shown = "that shows at the second, an error of first order in the step"
    if not discrete:
        ramp = "the jump becomes a ramp over that step, an error of first order in the step"
        shown = f"{ramp}; {way_out}"
    return f"{what}: between two communication points {shown}"


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
    times = clock.grid.time(np.arange(min(clock.steps + 1, MOST_POINTS)))
    found = values(times)
    wrong = np.flatnonzero(~np.isfinite(found))
    if wrong.size:
        first = int(wrong[0])
        raise UsageError(
            f"alpha {text!r}: expected a finite value at every communication point of the run, "
            f"got {found[first]:g} at t = {times[first]:g} s"
        )
