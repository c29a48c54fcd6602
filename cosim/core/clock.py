"""The communication grid: integer nanoseconds, and blocks of steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from time import perf_counter

import numpy as np

from cosim.arrays import Nanoseconds, Vector
from cosim.core.contracts import Block
from cosim.errors import ClockError

NANOSECONDS = 1_000_000_000
LARGEST_NS = 2**63 - 1
BLOCK_WORK = 0.05  # s of wall time that a block should take
FIRST_BLOCK = 1  # grows fourfold; a slow component must not keep the first report waiting


def nanoseconds(seconds: float | str) -> int:
    """Convert seconds to nanoseconds, exactly.

    Raises
    ------
    ClockError
        If ``seconds`` is not a number, not a whole number of nanoseconds, or beyond 292 years.
    """
    try:
        exact = Fraction(Decimal(str(seconds))) * NANOSECONDS
    except (InvalidOperation, ValueError, OverflowError) as error:  # no number, NaN, infinity
        raise ClockError(f"{seconds} is not a time in seconds; needed a finite number") from error
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


def seconds(ns: Nanoseconds) -> Vector:
    """Convert nanoseconds to seconds, each from its integer: nothing accumulates."""
    return ns / NANOSECONDS


def whole_steps(duration: float | str, step_ns: int, what: str) -> int:
    """Return ``duration`` [s] in communication steps.

    Raises
    ------
    ClockError
        If it is not a whole number of them; ``what`` names the duration in the message.
    """
    ns = nanoseconds(duration)
    steps, rest = divmod(ns, step_ns)
    if rest:
        nearest_steps = max(1, round(ns / step_ns))
        nearest = nearest_steps * step_ns / NANOSECONDS
        step = step_ns / NANOSECONDS
        raise ClockError(
            f"{what}: {duration} s is not a whole number of {step} s steps; nearest: {nearest} s"
        )
    return steps


@dataclass(frozen=True, slots=True)
class Clock:
    """A regular grid of communication points from 0 to ``stop``.

    Parameters
    ----------
    stop, step : float
        End of the run and communication step [s], whole nanoseconds; ``stop`` a whole number of
        steps.
    block : int or None
        Communication steps in one block; None: as many as make about 50 ms of work. Results do not
        depend on it.

    Raises
    ------
    ClockError
        If a time is off the grid, or not positive.
    """

    stop: float
    step: float
    block: int | None = None

    def __post_init__(self) -> None:
        if nanoseconds(self.step) <= 0:
            raise ClockError(f"step: found {self.step} s, needed a positive time")
        if nanoseconds(self.stop) <= 0:
            raise ClockError(f"stop: found {self.stop} s, needed a positive time")
        whole_steps(self.stop, self.step_ns, "stop")
        if self.block is not None and self.block < 1:
            raise ClockError(f"block: found {self.block} steps, needed at least 1")

    @property
    def step_ns(self) -> int:
        """Communication step [ns]."""
        return nanoseconds(self.step)

    @property
    def steps(self) -> int:
        """Number of communication steps of the run."""
        return nanoseconds(self.stop) // self.step_ns

    def blocks(self, limit: int) -> Iterator[Block]:
        """Yield the blocks of the run, none longer than ``limit`` steps.

        Without a fixed size the time between two requests decides how long the next block is.
        """
        index = 0
        size = min(self.block or FIRST_BLOCK, limit)
        while index < self.steps:
            size = min(size, self.steps - index)
            numbers = np.arange(index, index + size + 1, dtype=np.int64)
            ns = numbers * self.step_ns
            began = perf_counter()
            yield Block(index, ns, seconds(ns), self.step_ns / NANOSECONDS)
            index += size
            if self.block is None:
                elapsed = max(perf_counter() - began, 1e-9)
                factor = min(4.0, max(0.25, BLOCK_WORK / elapsed))
                size = max(1, min(limit, int(size * factor)))
