"""The inputs of an FMU over one communication step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from cosim.arrays import Vector

CLOSE: Final = 1e-9  # of a communication step: times that are the same


@dataclass(slots=True)
class InputRamp:
    """The inputs over one communication step, by linear interpolation.

    Instants in it are fractions of it, so that its ends and halves are exact.
    """

    t: float  # [s]
    h: float  # [s]
    u0: Vector
    u1: Vector
    change: Vector
    ticks: dict[float, float] = field(default_factory=dict)  # of clocks: their times [s]

    def time(self, s: float) -> float:
        """Return the time [s]."""
        if s in self.ticks:
            return self.ticks[s]
        return self.t + s * self.h if s else self.t

    def duration(self, s0: float, s1: float) -> float:
        """Return the time from one instant to another [s]."""
        if self.ticks:
            return self.time(s1) - self.time(s0)
        return (s1 - s0) * self.h

    def at(self, s: float) -> Vector:
        """Return the inputs."""
        if s == 1.0:
            return self.u1
        return self.u0 + s * self.change if s else self.u0

    def fraction(self, time: float) -> float:
        """Return the instant; the ends where it is close to them."""
        s = (time - self.t) / self.h
        for end in (0.0, 1.0):
            if abs(s - end) <= CLOSE:
                return end
        return s
