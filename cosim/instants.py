"""Times in seconds, on the grid of whole nanoseconds and between.

A time on the grid is ``n / 1e9``, the double next to it. Up to 2**22 s (48 days) these are less
than half a nanosecond from what they stand for, so that each of them stands for one n.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import MAX_EMAX, MAX_PREC, MIN_EMIN, Context, Decimal
from fractions import Fraction
from typing import Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Seconds: TypeAlias = float | Decimal  # a Decimal is taken with all its digits
StepNs: TypeAlias = int | Fraction  # of a whole number of nanoseconds an int
PointNumbers = TypeVar("PointNumbers", int, NDArray[np.int64])

NANOSECONDS = 1_000_000_000  # in a second
EXACT = 2**53  # integers up to it are doubles
LARGEST_DENOMINATOR = 1_000_000  # of a fraction that a double may have meant


_EXACT: Final = Context(prec=MAX_PREC, Emin=MIN_EMIN, Emax=MAX_EMAX)


def last_nanosecond(t: Seconds) -> int:
    """Return the number of the last whole nanosecond at or before a time [s]."""
    if isinstance(t, Decimal):
        return math.floor(t.scaleb(9, _EXACT))
    nearest = round(t * NANOSECONDS)
    return nearest if nearest / NANOSECONDS <= t else nearest - 1


def first_nanosecond(t: Seconds) -> int:
    """Return the number of the first whole nanosecond at or behind a time [s]."""
    return -last_nanosecond(t.copy_negate() if isinstance(t, Decimal) else -t)


def whole_duration(begin: float, end: float) -> float | None:
    """Return the time between two times on the grid [s]; None: one of them is not on it."""
    first = last_nanosecond(begin)
    last = last_nanosecond(end)
    is_whole = first / NANOSECONDS == begin and last / NANOSECONDS == end
    return (last - first) / NANOSECONDS if is_whole else None


def duration(begin: float, end: float) -> float:
    """Return the time between two times [s]: between two on the grid it is on the grid, too."""
    whole = whole_duration(begin, end)
    return end - begin if whole is None else whole


def step_seconds(step_ns: StepNs) -> float:
    """Return a step as the double next to it [s]."""
    return float(step_ns / NANOSECONDS)


def step_part(step_ns: StepNs, count: int) -> StepNs:
    """Return one of ``count`` equal parts of a step [ns]."""
    part = Fraction(step_ns) / count
    return part if part.denominator > 1 else part.numerator


def step_of(h: float) -> StepNs:
    """Return the step that has this double [ns]: whole nanoseconds, or the simplest fraction."""
    whole = round(h * NANOSECONDS)
    if whole / NANOSECONDS == h:
        return whole
    fraction = Fraction(h).limit_denominator(LARGEST_DENOMINATOR)
    exact = fraction if float(fraction) == h else Fraction(h)
    return step_part(exact * NANOSECONDS, 1)


def written_step(h: float) -> float | str:
    """Return a step [s] as a scenario takes it: a fraction, where it is one, of parts of 1 ns."""
    if not math.isfinite(h):
        return h
    step_ns = step_of(h)
    return h if step_ns.denominator > LARGEST_DENOMINATOR else step_value(step_ns)


def step_value(step_ns: StepNs) -> float | str:
    """Return a step as a scenario has it [s]: ``0.001``, ``"1/60"``."""
    seconds = step_ns / NANOSECONDS
    return str(seconds) if isinstance(seconds, Fraction) else seconds


@dataclass(frozen=True, slots=True)
class Grid:
    """Points at equal distances: the stamp of a point, and the number of a stamp.

    PointNumbers and stamps may be integers or arrays of them.

    >>> Grid(0, Fraction(50_000_000, 3)).stamp(2)  # 2/60 s
    33333333

    Parameters
    ----------
    start_ns : int
        Stamp of the point of number 0 [ns].
    step_ns : int or Fraction
        Between two points [ns]; of a fraction every multiple is a point.
    """

    start_ns: int
    step_ns: StepNs

    def stamp(self, number: PointNumbers) -> PointNumbers:
        """Return the whole nanosecond next to a point."""
        step_ns = self.step_ns
        if isinstance(step_ns, int):
            return self.start_ns + number * step_ns
        numerator, denominator = step_ns.as_integer_ratio()
        multiple = self._first + number
        return (2 * numerator * multiple + denominator) // (2 * denominator)

    def number(self, stamp: PointNumbers) -> PointNumbers:
        """Return the last point whose stamp is not after this one."""
        step_ns = self.step_ns
        if isinstance(step_ns, int):
            return (stamp - self.start_ns) // step_ns
        return _multiple(stamp, step_ns) - self._first

    def time(self, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the doubles next to points [s]."""
        if isinstance(self.step_ns, int):
            return self.stamp(numbers) / NANOSECONDS
        numerator, denominator = (self.step_ns / NANOSECONDS).as_integer_ratio()
        multiples = self._first + numbers
        largest = max(int(np.abs(multiples).max(initial=0)) * numerator, denominator)
        if largest <= EXACT:
            return multiples * numerator / denominator
        # As doubles the operands of the division would be rounded, too.
        return np.array([self.instant(number) for number in numbers.tolist()], np.float64)

    def instant(self, number: int) -> float:
        """Return the double next to one point [s]."""
        if isinstance(self.step_ns, int):
            return self.stamp(number) / NANOSECONDS
        numerator, denominator = (self.step_ns / NANOSECONDS).as_integer_ratio()
        return (self._first + number) * numerator / denominator

    @property
    def _first(self) -> int:
        """Which multiple of a fraction the point of number 0 is."""
        assert isinstance(self.step_ns, Fraction)
        return _multiple(self.start_ns, self.step_ns)


def _multiple(stamp: PointNumbers, step_ns: Fraction) -> PointNumbers:
    """Return the last multiple of a fraction whose stamp is not after this one."""
    numerator, denominator = step_ns.as_integer_ratio()
    return ((2 * stamp + 1) * denominator - 1) // (2 * numerator)
