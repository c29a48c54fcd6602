"""Signals that jump: between communication points they cannot.

A continuous signal is interpolated linearly between two communication points, so a jump in it would
become a ramp of a whole step. A discrete one holds its value from a communication point on, so it
can jump there, to the value that it has after the jump.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.clock import Clock
from cosim.errors import UsageError
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.jumps import Jump, jumps
from cosim.native.numerics.programs import evaluate

_UNSEEN: Final = 0.01  # of a column's range


def check_continuous(text: str, clock: Clock, way_out: str) -> None:
    """Check that an expression does not jump during a run.

    Raises
    ------
    UsageError
        If it may; ``way_out`` says what can be done.
    """
    for jump in jumps(text):
        if _in_run(jump, clock):
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
    for jump in jumps(text):
        if not _in_run(jump, clock):
            continue
        if jump.instant is None:
            notes.append(
                f"{jump.text} jumps where its argument passes 0; between two communication points "
                "that shows at the second: an error of first order in the step"
            )
        else:
            _check_jump(text, jump, jump.instant, clock)
    return notes


def _in_run(jump: Jump, clock: Clock) -> bool:
    """Return whether a jump may change a value of a run."""
    if jump.instant is None:
        return True
    if jump.instant == clock.start_time:  # only the value after it counts, if that is there
        return not _holds_value_after(jump, jump.instant)
    return clock.start_time < jump.instant <= clock.stop and math.isfinite(jump.instant)


def _check_jump(text: str, jump: Jump, instant: float, clock: Clock) -> None:
    times = np.array([instant])
    if not clock.is_point(times)[0]:
        before, after = clock.points_around(instant)
        raise UsageError(
            f"expression {text!r}: {jump.text} jumps at {instant!r} s, between two communication "
            f"points; expected {before!r} s or {after!r} s"
        )
    point = float(clock.nearest_points(times)[0])
    if point < clock.stop and not _holds_value_after(jump, point):
        raise UsageError(
            f"expression {text!r}: {jump.text} still has the value before its jump at the "
            f"communication point {point!r} s and would hold it for a step; write {jump.remedy}"
        )


def _holds_value_after(jump: Jump, point: float) -> bool:
    """Return whether the value at a jump is the one after it, as it is computed."""
    value = evaluate(compile_expression(jump.text), point)
    return value == evaluate(compile_expression(jump.remedy), point + 1.0)


def held_from_points(t: Vector, y: Matrix, clock: Clock) -> Vector:
    """Return the instants of a held table, those that are communication points exactly so.

    Parameters
    ----------
    t : Vector, shape (N,)
        Increasing [s]; one that differs from a communication point by the rounding of doubles, or
        that is its whole nanosecond, is that point.
    y : Matrix, shape (N, n)

    Raises
    ------
    UsageError
        If a value changes between two communication points of the run.
    """
    on_grid = clock.is_point_or_stamp(t)
    changes = np.zeros(len(t), np.bool_)
    changes[1:] = (y[1:] != y[:-1]).any(axis=1)
    in_run = (t > clock.start_time) & (t <= clock.stop)
    wrong = np.flatnonzero(changes & in_run & ~on_grid)
    if wrong.size:
        first = int(wrong[0])
        instant = float(t[first])
        before, after = clock.points_around(instant)
        others = f" ({wrong.size} such instants)" if wrong.size > 1 else ""
        raise UsageError(
            f"table: y jumps at t[{first}] = {instant!r} s, between two communication points; "
            f"expected {before!r} s or {after!r} s{others}"
        )
    held: Vector = np.where(on_grid, clock.nearest_points(t), t)
    return held


def unseen_rows(t: Vector, y: Matrix, clock: Clock) -> list[str]:
    """Return what is to be known of rows that a linearly interpolated table has between points.

    The signal is a straight line from one communication point to the next, so what the table does
    between them is lost.

    Parameters
    ----------
    t : Vector, shape (N,)
    y : Matrix, shape (N, n)

    Returns
    -------
    list of str
        Empty where no row is farther from the line than a hundredth of the range of its column.
    """
    in_run = (t > clock.start_time) & (t < clock.stop)
    between = in_run & ~clock.is_point_or_stamp(t)
    times = t[between]
    distances = _distances_from_lines(t, y, between, clock)
    unseen = distances > _UNSEEN
    if not unseen.any():
        return []
    row = int(distances.argmax())
    return [
        f"{np.count_nonzero(unseen)} rows between communication points are not seen: the "
        f"signal is a straight line there, and at t = {float(times[row])!r} s it is "
        f"{distances[row]:.2g} of the table's range away from the row; a smaller step shows them"
    ]


def _distances_from_lines(t: Vector, y: Matrix, between: Mask, clock: Clock) -> Vector:
    """Return how far rows between communication points are from the line, of their range."""
    times = t[between]
    h = clock.h
    steps_before = np.floor((times - clock.start_time) / h)
    before = clock.start_time + steps_before * h
    farthest = np.zeros(len(times))
    for column in y.T:
        first = np.interp(before, t, column)
        last = np.interp(before + h, t, column)
        line = first + (last - first) * (times - before) / h
        tallest = np.ptp(column) or 1.0
        distances = np.abs(column[between] - line) / tallest
        farthest = np.maximum(farthest, distances)
    return farthest
