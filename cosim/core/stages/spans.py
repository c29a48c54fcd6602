"""Spans and their parts: a communication step, or what an event leaves of a part of one.

The parts are those of a binary tree: part ``number`` of ``2**level``, with ends that are rounded
down to whole nanoseconds. So the parts of a communication step have two lengths a level at most,
all of them known before the run, and what components compute for them is recorded like the rest of
their designs. An event divides a part at the time that the component gave, whatever that is; both
pieces are spans of their own, which are divided like communication steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from cosim.instants import NANOSECONDS, first_nanosecond, last_nanosecond

NEAR: Final = 6  # levels: near its end is the last 2**-6 of a part


@dataclass(frozen=True, slots=True)
class Span:
    """What is divided: a communication step, or a piece of a part of one.

    Parameters
    ----------
    begin, end : float
        [s]
    first_ns, last_ns : int
        The first and the last whole nanosecond in it [ns].
    event : str
        The component that has an event at its end; empty: none has.
    is_step : bool
        Whether it is a communication step.
    """

    begin: float
    end: float
    first_ns: int
    last_ns: int
    event: str = ""
    is_step: bool = False

    @classmethod
    def between(cls, begin: float, end: float, event: str = "") -> Span:
        """Return what is between two times [s]."""
        return cls(begin, end, first_nanosecond(begin), last_nanosecond(end), event)

    @property
    def whole(self) -> StepPart:
        """All of it as one part."""
        return StepPart(self, 0, 0)

    def instant(self, number: int, level: int) -> float:
        """Return where part ``number`` of ``2**level`` begins [s]."""
        if number == 0:
            return self.begin
        if number == 1 << level:
            return self.end
        offset = number * (self.last_ns - self.first_ns) >> level
        return (self.first_ns + offset) / NANOSECONDS


@dataclass(frozen=True, slots=True)
class StepPart:
    """Part ``number`` of the ``2**level`` parts of a span."""

    span: Span
    level: int
    number: int

    @property
    def begin(self) -> float:
        """Where it begins [s]."""
        return self.span.instant(self.number, self.level)

    @property
    def end(self) -> float:
        """Where it ends [s]."""
        return self.span.instant(self.number + 1, self.level)

    @property
    def event(self) -> str:
        """The component that has an event at its end; empty: none has."""
        is_last = self.number + 1 == 1 << self.level
        return self.span.event if is_last else ""

    @property
    def has_halves(self) -> bool:
        """Whether there is a whole nanosecond to divide it at."""
        return self.span.last_ns - self.span.first_ns >= 2 << self.level

    @property
    def halves(self) -> tuple[StepPart, StepPart]:
        """Its first and its second half."""
        level = self.level + 1
        first = StepPart(self.span, level, 2 * self.number)
        second = StepPart(self.span, level, 2 * self.number + 1)
        return first, second

    @property
    def last_and_rest(self) -> tuple[StepPart, StepPart]:
        """What is near its end, and what is before that, as spans of their own."""
        near = StepPart(self.span, self.level + NEAR, ((self.number + 1) << NEAR) - 1).begin
        last = Span.between(near, self.end, self.event)
        return last.whole, Span.between(self.begin, near).whole

    @property
    def ends_a_longer_one(self) -> bool:
        """Whether a part of twice its length ends there, too."""
        return self.level > 0 and self.number % 2 == 1

    def following(self, level: int) -> StepPart | None:
        """Return the part of a level that begins where it ends; None: its span ends there."""
        number = (self.number + 1) >> (self.level - level)
        return None if number == 1 << level else StepPart(self.span, level, number)
