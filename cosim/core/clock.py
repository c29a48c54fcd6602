"""The communication grid: its points in nanoseconds and in seconds, and blocks of steps.

A step is a whole number of nanoseconds, or a fraction such as 1/60 s. Then the points are the
multiples of it from 0 s on: components get the double next to k/60, and the stamp of a row is the
whole nanosecond next to it, from which k follows again.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from functools import cached_property, lru_cache
from time import perf_counter
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Nanoseconds, Vector
from cosim.core.arguments import kind_of
from cosim.core.contracts import Block
from cosim.errors import ClockError, quoted
from cosim.instants import (
    NANOSECONDS,
    Grid,
    StepNs,
    step_part,
    step_seconds,
    step_value,
)

LARGEST_NS = 2**63 - 1
LARGEST_EXPONENT = 400  # of ten: beyond every double
BLOCK_WORK = 0.05  # s of wall time that a block should take, at least
FIRST_BLOCK = 1  # grows fourfold; a slow component must not keep the first report waiting
REPETITIONS: Final = 1000  # of events or returns that do not advance time; as in model_exchange.c
CAUSES: Final = 100  # of the last of them
LARGEST_DENOMINATOR: Final = 100_000  # of a fraction that a step may have meant
CLOSE: Final = 1e-12  # of a step: it was written with so many digits
_HIGHEST_RATE: Final = 10_000  # Hz, of which the periods differ by more than whole nanoseconds
RESOLUTION: Final = 1e-9  # s in which so many are none that advance it


def nanoseconds(seconds: float | str | Fraction) -> int:
    """Convert seconds to nanoseconds, exactly.

    Raises
    ------
    ClockError
        If ``seconds`` is not a number, not a whole number of nanoseconds, or beyond 292 years.
    """
    exact = exact_nanoseconds(seconds)
    if isinstance(exact, int):
        return exact
    smallest = 1 if exact > 0 else -1
    nearest = (round(exact) or smallest) / NANOSECONDS
    raise ClockError(f"{seconds} s is not a whole number of nanoseconds; nearest: {nearest} s")


def exact_nanoseconds(seconds: float | str | Fraction) -> int | Fraction:
    """Convert seconds to nanoseconds; a fraction only where they are no whole number.

    Raises
    ------
    ClockError
        If ``seconds`` is not a number, or beyond 292 years.
    """
    return _of_float(seconds) if type(seconds) is float else _exactly(seconds)


def _exactly(seconds: float | str | Fraction) -> int | Fraction:
    exact = seconds if isinstance(seconds, Fraction) else _decimal(seconds)
    exact *= NANOSECONDS
    if abs(exact) > LARGEST_NS:
        raise ClockError(
            f"{seconds} s does not fit into 64-bit nanoseconds; at most "
            f"{LARGEST_NS / NANOSECONDS:.3e} s"
        )
    return step_part(exact, 1)


def _decimal(seconds: float | str) -> Fraction:
    """Return a number as it is written."""
    try:
        decimal = Decimal(str(seconds))
    except (InvalidOperation, ValueError) as error:  # no number
        raise _no_time(seconds) from error
    if not decimal.is_finite():
        raise _no_time(seconds)
    if decimal and not -LARGEST_EXPONENT <= decimal.adjusted() <= LARGEST_EXPONENT:
        # As a fraction it could have more digits than there is memory.
        limit = f"1e-{LARGEST_EXPONENT} to 1e{LARGEST_EXPONENT}"
        raise ClockError(f"{kind_of(seconds)} s is not within {limit} s")
    return Fraction(decimal)


_of_float = lru_cache(1024)(_exactly)  # the times of a scenario are asked for many times


@final
@dataclass(slots=True)
class Standstill:
    """Finds out whether what happens again and again advances time: events, early returns.

    Any number of them may lie in a communication step; ``REPETITIONS`` of them within a nanosecond,
    or within what so many roundings of a late time are, do not end.

    Parameters
    ----------
    since : float
        Time that is not advanced [s]; at first, at which it begins.
    count : int
        Repetitions since then.
    causes : set
        What was named as a cause of the last ``CAUSES`` repetitions since then.

    >>> standstill = Standstill(0.3)
    >>> any(standstill.lasts(0.3 + 1e-8 * k) for k in range(10_000))
    False
    >>> any(standstill.lasts(0.31) for k in range(10_000))
    True
    """

    since: float
    count: int = 0
    causes: set[Hashable] = field(default_factory=set)

    def lasts(self, t: float, causes: Iterable[Hashable] = ()) -> bool:
        """Count one more at ``t`` [s]; return whether they do not advance time."""
        if t - self.since > max(RESOLUTION, 16 * REPETITIONS * math.ulp(t)):
            self.since = t
            self.count = 0
        if self.count in (0, REPETITIONS - CAUSES):
            self.causes.clear()
        self.causes.update(causes)
        self.count += 1
        return self.count >= REPETITIONS


def start_nanoseconds(start_time: float) -> int:
    """Convert the start of a run [s] to nanoseconds.

    Raises
    ------
    ClockError
        If it is not a whole number of nanoseconds, or negative.
    """
    ns = nanoseconds(start_time)
    if ns < 0:
        raise ClockError(
            f"start_time: expected a time >= 0 s, got {start_time} s; the times of a log begin at 0"
        )
    return ns


def _no_time(value: object) -> ClockError:
    found = value[:60] if isinstance(value, str) else kind_of(value)
    return ClockError(f"expected a finite number of seconds, got {found}")


def seconds(ns: Nanoseconds) -> Vector:
    """Convert nanoseconds to seconds, each from its integer: nothing accumulates."""
    return ns / NANOSECONDS


def whole_steps(
    time: float | str | Fraction, step_ns: StepNs, what: str, *, start_ns: int = 0
) -> int:
    """Return a duration, or an instant after ``start_ns``, in communication steps.

    Where the step is no whole number of nanoseconds, it is the time next to a point that counts.

    Parameters
    ----------
    time : float, str or Fraction
        Seconds.
    step_ns : int or Fraction
        Communication step [ns].
    what : str
        Names the time in the message.
    start_ns : int
        The start of the run where ``time`` is an instant [ns].

    Raises
    ------
    ClockError
        If it is not a whole number of them, or no time at all.
    """
    try:
        exact = nanoseconds(time) if isinstance(step_ns, int) else exact_nanoseconds(time)
    except ClockError as error:
        raise ClockError(f"{what}: {error}") from error
    grid = Grid(start_ns, step_ns)
    steps = grid.number(round(exact))
    if grid.stamp(steps) != round(exact):
        nearest = grid.stamp(max(1, round((exact - start_ns) / step_ns))) / NANOSECONDS
        since = f" after the start at {start_ns / NANOSECONDS} s" if start_ns else ""
        raise ClockError(
            f"{what}: {time} s is not a whole number of {step_value(step_ns)} s steps{since}; "
            f"nearest: {nearest} s"
        )
    return steps


@dataclass(frozen=True)
class Clock:
    """A regular grid of communication points from ``start_time`` to ``stop``.

    Parameters
    ----------
    stop : float
        End of the run [s], a whole number of steps after ``start_time``.
    step : float or Fraction
        Communication step [s]: whole nanoseconds, or a fraction, such as ``Fraction(1, 60)``. Then
        ``stop`` and ``start_time`` become the doubles next to the multiples that they stand for.
    block : int or None
        Communication steps in one block; None: as many as make about 50 ms of work. Results do not
        depend on it.
    start_time : float
        First communication point [s], whole nanoseconds from 0 on: the times of a log are unsigned.

    Raises
    ------
    ClockError
        If a time is no number, off the grid, or not positive.
    """

    stop: float
    step: float | Fraction
    block: int | None = None
    start_time: float = 0.0

    def __post_init__(self) -> None:
        for key in ("stop", "step", "start_time"):
            value = getattr(self, key)
            if isinstance(value, str):  # a text is no number here, though nanoseconds reads it
                raise ClockError(f"{key}: expected a number of seconds, got {quoted(value)}")
        if self.step_ns <= 0:
            raise ClockError(f"step: expected a time > 0, got {self.step} s")
        if exact_nanoseconds(self.stop) <= self.start_ns:
            needed = f"a time after start_time = {self.start_time} s"
            if self.start_ns == 0:
                needed = "a time > 0"
            raise ClockError(f"stop: expected {needed}, got {self.stop} s")
        if isinstance(self.step_ns, Fraction):
            self._check_fraction(self.step_ns)
        steps = self._steps_to_stop()
        if isinstance(self.step_ns, Fraction):
            for key, number in (("start_time", 0), ("stop", steps)):
                object.__setattr__(self, key, self.grid.instant(number))
        if self.block is not None and (type(self.block) is not int or self.block < 1):
            found = kind_of(self.block)
            raise ClockError(f"block: expected a number of steps >= 1, or None, got {found}")

    def _check_fraction(self, step_ns: Fraction) -> None:
        """Check that points differ as whole nanoseconds, and that 64 bits are enough for them.

        Raises
        ------
        ClockError
            If not.
        """
        longest = LARGEST_NS // (4 * step_ns.denominator)
        if step_ns < 1 or exact_nanoseconds(self.stop) > longest:
            raise ClockError(
                f"step: expected a fraction from 1e-9 s on whose points up to stop are told apart "
                f"in 64 bits, got {self.step} s, with which stop is at most "
                f"{longest / NANOSECONDS:g} s"
            )

    def _steps_to_stop(self) -> int:
        try:
            return self.steps_until(self.stop, "stop")
        except ClockError as error:
            raise ClockError(f"{error}{self._fraction_hint()}") from error

    def _fraction_hint(self) -> str:
        """Name the fraction whose first point a step is the whole nanosecond of, as 1/60 s."""
        if isinstance(self.step_ns, Fraction):
            return ""
        rate = round(NANOSECONDS / self.step_ns)
        is_fraction = 0 < rate <= _HIGHEST_RATE and NANOSECONDS % rate
        if not is_fraction or round(NANOSECONDS / rate) != self.step_ns:
            return ""
        return f', or a step of the fraction "1/{rate}"'

    @cached_property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        return self.step_of(self.step)

    @staticmethod
    def step_of(step: float | Fraction) -> StepNs:
        """Return a communication step in nanoseconds.

        Raises
        ------
        ClockError
            If it is a double that is no whole number of them.
        """
        if isinstance(step, Fraction):
            return exact_nanoseconds(step)
        try:
            return nanoseconds(step)
        except ClockError as error:
            if not isinstance(step, float) or not math.isfinite(step):
                raise
            fraction = Fraction(step).limit_denominator(LARGEST_DENOMINATOR)
            if abs(fraction - Fraction(step)) > CLOSE * abs(step):
                raise
            raise ClockError(f'{error}; or the fraction "{fraction}"') from error

    @cached_property
    def h(self) -> float:
        """Communication step, the double next to it [s]."""
        return step_seconds(self.step_ns)

    @cached_property
    def start_ns(self) -> int:
        """Stamp of the first communication point [ns]."""
        if isinstance(self.step_ns, int):
            return start_nanoseconds(self.start_time)
        multiple = whole_steps(self.start_time, self.step_ns, "start_time")
        return start_nanoseconds(Grid(0, self.step_ns).stamp(multiple) / NANOSECONDS)

    @cached_property
    def grid(self) -> Grid:
        """Its communication points, which go on beyond its stop."""
        return Grid(self.start_ns, self.step_ns)

    @cached_property
    def steps(self) -> int:
        """Number of communication steps of the run."""
        return self.steps_until(self.stop, "stop")

    @property
    def points(self) -> Vector:
        """All communication points of the run, shape (steps + 1,) [s]."""
        return self.grid.time(np.arange(self.steps + 1))

    def steps_until(self, time: float | str, what: str) -> int:
        """Return the number of the communication point at an instant [s].

        Raises
        ------
        ClockError
            If there is none; ``what`` names the instant in the message.
        """
        return whole_steps(time, self.step_ns, what, start_ns=self.start_ns)

    def nearest_points(self, times: Vector) -> Vector:
        """Return the communication point nearest to each instant [s], also outside the run."""
        return self.grid.time(self._nearest(times))

    def _nearest(self, times: Vector) -> NDArray[np.int64]:
        numbers = np.rint((times * NANOSECONDS - self.start_ns) / float(self.step_ns))
        return numbers.astype(np.int64)

    def at_points(self, times: Vector) -> Vector:
        """Return instants [s], those that are stamps of communication points as these points.

        Also outside the run: a part of a run takes them for what the whole took them for.
        """
        if isinstance(self.step_ns, int):
            return times
        longest = LARGEST_NS // (4 * self.step_ns.denominator)
        ns = np.clip(times * NANOSECONDS, -longest, longest)
        numbers = np.rint(ns / float(self.step_ns)).astype(np.int64)
        grid = Grid(0, self.step_ns)
        is_stamp = seconds(grid.stamp(numbers)) == times
        points: Vector = np.where(is_stamp, grid.time(numbers), times)
        return points

    def is_point(self, times: Vector) -> Mask:
        """Return which instants are communication points, but for the rounding of doubles."""
        rounding = 4.0 * np.spacing(np.maximum(np.abs(times), self.h))
        on_grid: Mask = np.abs(self.nearest_points(times) - times) <= rounding
        return on_grid

    def is_point_or_stamp(self, times: Vector) -> Mask:
        """Return which instants are communication points, or the whole nanoseconds next to them.

        Of a step that is a fraction, logs and tables have the latter.
        """
        stamps = seconds(self.grid.stamp(self._nearest(times)))
        rounding = 4.0 * np.spacing(np.maximum(np.abs(times), self.h))
        is_stamp: Mask = np.abs(stamps - times) <= rounding
        return self.is_point(times) | is_stamp

    def points_around(self, time: float) -> tuple[float, float]:
        """Return the communication points before and after an instant [s] that is none."""
        (nearest,) = self._nearest(np.array([time])).tolist()
        before = nearest - 1 if self.grid.instant(nearest) >= time else nearest
        return self.grid.instant(before), self.grid.instant(before + 1)

    def block_at(self, index: int, steps: int) -> Block:
        """Return some communication steps, from the point of number ``index`` on."""
        numbers = np.arange(index, index + steps + 1, dtype=np.int64)
        ns = self.grid.stamp(numbers)
        time = self.grid.time(numbers)
        for array in (ns, time):
            array.setflags(write=False)  # components see them
        return Block(index, ns, time, self.h)

    def blocks(self, limit: int, work: float = BLOCK_WORK) -> Iterator[Block]:
        """Yield the blocks of the run, none longer than ``limit`` steps.

        Without a fixed size the time between two requests decides how long the next block is: as
        many steps as take ``work`` seconds.
        """
        index = 0
        size = min(self.block or FIRST_BLOCK, limit)
        while index < self.steps:
            size = min(size, self.steps - index)
            began = perf_counter()
            yield self.block_at(index, size)
            index += size
            if self.block is None:
                elapsed = max(perf_counter() - began, 1e-9)
                factor = min(4.0, max(0.25, work / elapsed))
                size = max(1, min(limit, int(size * factor)))
