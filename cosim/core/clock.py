"""The communication grid: integer nanoseconds, and blocks of steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from functools import cached_property, lru_cache
from time import perf_counter

import numpy as np

from cosim.arrays import Mask, Nanoseconds, Vector
from cosim.core.arguments import kind_of
from cosim.core.contracts import Block
from cosim.errors import ClockError, quoted
from cosim.instants import NANOSECONDS

LARGEST_NS = 2**63 - 1
LARGEST_EXPONENT = 400  # of ten: beyond every double
BLOCK_WORK = 0.05  # s of wall time that a block should take, at least
FIRST_BLOCK = 1  # grows fourfold; a slow component must not keep the first report waiting


def nanoseconds(seconds: float | str) -> int:
    """Convert seconds to nanoseconds, exactly.

    Raises
    ------
    ClockError
        If ``seconds`` is not a number, not a whole number of nanoseconds, or beyond 292 years.
    """
    return _of_float(seconds) if type(seconds) is float else _exactly(seconds)


def _exactly(seconds: float | str) -> int:
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
    exact = Fraction(decimal) * NANOSECONDS
    whole = round(exact)
    if exact != whole:
        smallest = 1 if exact > 0 else -1
        nearest = (whole or smallest) / NANOSECONDS
        raise ClockError(f"{seconds} s is not a whole number of nanoseconds; nearest: {nearest} s")
    if abs(whole) > LARGEST_NS:
        raise ClockError(
            f"{seconds} s does not fit into 64-bit nanoseconds; at most "
            f"{LARGEST_NS / NANOSECONDS:.3e} s"
        )
    return whole


_of_float = lru_cache(1024)(_exactly)  # the times of a scenario are asked for many times


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


def whole_steps(time: float | str, step_ns: int, what: str, *, start_ns: int = 0) -> int:
    """Return a duration, or an instant after ``start_ns``, in communication steps.

    Parameters
    ----------
    time : float or str
        Seconds.
    step_ns, start_ns : int
        Communication step, and the start of the run where ``time`` is an instant [ns].
    what : str
        Names the time in the message.

    Raises
    ------
    ClockError
        If it is not a whole number of them, or no time at all.
    """
    try:
        ns = nanoseconds(time) - start_ns
    except ClockError as error:
        raise ClockError(f"{what}: {error}") from error
    steps, rest = divmod(ns, step_ns)
    if rest:
        nearest_steps = max(1, round(ns / step_ns))
        nearest = (start_ns + nearest_steps * step_ns) / NANOSECONDS
        step = step_ns / NANOSECONDS
        since = f" after the start at {start_ns / NANOSECONDS} s" if start_ns else ""
        raise ClockError(
            f"{what}: {time} s is not a whole number of {step} s steps{since}; nearest: {nearest} s"
        )
    return steps


@dataclass(frozen=True)
class Clock:
    """A regular grid of communication points from ``start_time`` to ``stop``.

    Parameters
    ----------
    stop, step : float
        End of the run and communication step [s], whole nanoseconds; ``stop`` a whole number of
        steps after ``start_time``.
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
    step: float
    block: int | None = None
    start_time: float = 0.0

    def __post_init__(self) -> None:
        for key in ("stop", "step", "start_time"):
            value = getattr(self, key)
            if isinstance(value, str):  # a text is no number here, though nanoseconds reads it
                raise ClockError(f"{key}: expected a number of seconds, got {quoted(value)}")
        if self.step_ns <= 0:
            raise ClockError(f"step: expected a time > 0, got {self.step} s")
        if nanoseconds(self.stop) <= self.start_ns:
            needed = f"a time after start_time = {self.start_time} s"
            if self.start_ns == 0:
                needed = "a time > 0"
            raise ClockError(f"stop: expected {needed}, got {self.stop} s")
        self.steps_until(self.stop, "stop")
        if self.block is not None and (type(self.block) is not int or self.block < 1):
            found = kind_of(self.block)
            raise ClockError(f"block: expected a number of steps >= 1, or None, got {found}")

    @cached_property
    def step_ns(self) -> int:
        """Communication step [ns]."""
        return nanoseconds(self.step)

    @cached_property
    def start_ns(self) -> int:
        """First communication point [ns]."""
        return start_nanoseconds(self.start_time)

    @cached_property
    def steps(self) -> int:
        """Number of communication steps of the run."""
        return (nanoseconds(self.stop) - self.start_ns) // self.step_ns

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
        numbers = np.rint((times * NANOSECONDS - self.start_ns) / self.step_ns)
        return seconds(self.start_ns + numbers.astype(np.int64) * self.step_ns)

    def is_point(self, times: Vector) -> Mask:
        """Return which instants are communication points, but for the rounding of doubles."""
        rounding = 4.0 * np.spacing(np.maximum(np.abs(times), self.step_ns / NANOSECONDS))
        on_grid: Mask = np.abs(self.nearest_points(times) - times) <= rounding
        return on_grid

    def points_around(self, time: float) -> tuple[float, float]:
        """Return the communication points before and after an instant [s] that is none."""
        (nearest,) = self.nearest_points(np.array([time]))
        step = self.step_ns if nearest < time else -self.step_ns
        other = (round(nearest * NANOSECONDS) + step) / NANOSECONDS
        first, second = sorted((float(nearest), other))
        return first, second

    def block_at(self, index: int, steps: int) -> Block:
        """Return some communication steps, from the point of number ``index`` on."""
        ns = np.arange(index, index + steps + 1, dtype=np.int64) * self.step_ns + self.start_ns
        time = seconds(ns)
        for array in (ns, time):
            array.setflags(write=False)  # components see them
        return Block(index, ns, time, self.step_ns / NANOSECONDS)

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
