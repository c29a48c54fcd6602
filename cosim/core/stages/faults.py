"""Faults of signals: what an input gets in place of what its source gives.

::

    freeze   u(t) = u(t0)                           a sensor that is stuck
    offset   u(t) = s(t) + offset
    gain     u(t) = gain s(t)                       an error of its scale
    drift    u(t) = s(t) + rate (t - t0)
    noise    u(t) = s(t) + deviation n(t)           n: Gaussian, anew at every communication point
    drop     u(t) = s(t), or u(t - h) or no value   a sample that is lost, with a probability
    delay    u(t) = s(max(t0, t - d))               nothing new arrives for the first d

with s(t) the source at a communication point, t0 the instant at which the fault begins, h the
communication step, and d a whole number of these. A sample that is lost leaves no value where the
input is one that may have none; another input holds the last one that arrived.

Of every element that is u = g s + c, with g and c fixed from one communication point to the next:
that is what compiled code computes. Random numbers depend on the seed, the element's number in its
signal and the communication points since t0, on nothing else.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.core.signals import FaultKind
from cosim.native.numerics.noise import WORDS_PER_NORMAL, normal

DRAWN: Final = 1024  # random numbers that are drawn at once
NOTHING_ADDED: Final = -0.0  # 0.0 would make 0.0 of -0.0


@dataclass(frozen=True, slots=True)
class FaultInstant:
    """What is known of an element at a communication point, when the next one is determined.

    Parameters
    ----------
    steps : int
        Of the point that is determined, since the fault began.
    h : float
        Communication step [s].
    source : float
        What the source gave at the point before; at the beginning: what it gives.
    kept : float
        What the input was there.
    """

    steps: int
    h: float
    source: float
    kept: float


class Fault(Protocol):
    """The fault of one element of an input."""

    @property
    def kind(self) -> FaultKind:
        """Its kind."""
        ...

    @property
    def parameters(self) -> tuple[float, ...]:
        """What it is known by, for the log."""
        ...

    @property
    def varies(self) -> bool:
        """Whether gain and value change from one communication point to the next."""
        ...

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return gain and value at a communication point; gain 0: the value alone."""
        ...

    def copy(self) -> Fault:
        """Return a fault that goes on from here on its own."""
        ...


@dataclass(frozen=True, slots=True)
class FreezeFault:
    """The input keeps the value that it has."""

    kind: ClassVar[FaultKind] = "freeze"
    varies: ClassVar[bool] = False
    parameters: ClassVar[tuple[float, ...]] = ()

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return the value."""
        return 0.0, instant.kept

    def copy(self) -> Fault:
        """Return itself: it has no state."""
        return self


@dataclass(frozen=True, slots=True)
class OffsetFault:
    """A constant is added."""

    offset: float
    kind: ClassVar[FaultKind] = "offset"
    varies: ClassVar[bool] = False

    @property
    def parameters(self) -> tuple[float, ...]:
        """The constant."""
        return (self.offset,)

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return the constant."""
        return 1.0, self.offset

    def copy(self) -> Fault:
        """Return itself: it has no state."""
        return self


@dataclass(frozen=True, slots=True)
class GainFault:
    """The source is multiplied by a factor; 0: the input is 0."""

    gain: float
    kind: ClassVar[FaultKind] = "gain"
    varies: ClassVar[bool] = False

    @property
    def parameters(self) -> tuple[float, ...]:
        """The factor."""
        return (self.gain,)

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return the factor."""
        return self.gain, NOTHING_ADDED if self.gain else 0.0

    def copy(self) -> Fault:
        """Return itself: it has no state."""
        return self


@dataclass(frozen=True, slots=True)
class DriftFault:
    """A ramp is added, which begins at 0."""

    rate: float
    kind: ClassVar[FaultKind] = "drift"
    varies: ClassVar[bool] = True

    @property
    def parameters(self) -> tuple[float, ...]:
        """Its growth [1/s]."""
        return (self.rate,)

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return the ramp."""
        return 1.0, self.rate * (instant.steps * instant.h)

    def copy(self) -> Fault:
        """Return itself: it has no state."""
        return self


class _Words:
    """Random words by their number: those of one element under one seed.

    Parameters
    ----------
    seed : int
    element : int
        Of its signal.
    each : int
        Words that one number takes.
    """

    def __init__(self, seed: int, element: int, each: int) -> None:
        self._entropy = (seed, element)
        self._each = each
        self._first = -1

    def drawn(self, number: int) -> tuple[NDArray[np.uint64] | None, int]:
        """Return the words around a number where they are drawn anew, and its place in them."""
        chunk, place = divmod(number, DRAWN)
        if chunk == self._first:
            return None, place
        self._first = chunk
        words: NDArray[np.uint64] = np.random.PCG64((*self._entropy, chunk)).random_raw(
            self._each * DRAWN
        )
        return words, place


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFault:
    """Gaussian noise is added, a new value at every communication point."""

    deviation: float
    seed: int
    element: int
    _words: _Words = field(init=False)
    _normal: Vector = field(init=False)
    kind: ClassVar[FaultKind] = "noise"
    varies: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "_words", _Words(self.seed, self.element, WORDS_PER_NORMAL))
        object.__setattr__(self, "_normal", np.empty(DRAWN))

    @property
    def parameters(self) -> tuple[float, ...]:
        """Standard deviation and seed."""
        return self.deviation, float(self.seed)

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return the noise."""
        words, place = self._words.drawn(instant.steps)
        if words is not None:
            self._normal[:] = normal(words)
        return 1.0, self.deviation * float(self._normal[place])

    def copy(self) -> Fault:
        """Return itself: its numbers depend on the instant alone."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class DropFault:
    """Samples are lost."""

    probability: float
    seed: int
    element: int
    may_be_nan: bool
    _words: _Words = field(init=False)
    _lost: NDArray[np.bool_] = field(init=False)
    kind: ClassVar[FaultKind] = "drop"
    varies: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "_words", _Words(self.seed, self.element, 1))
        object.__setattr__(self, "_lost", np.empty(DRAWN, np.bool_))

    @property
    def parameters(self) -> tuple[float, ...]:
        """The probability that one is lost, and the seed."""
        return self.probability, float(self.seed)

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return what takes the place of a sample that is lost, or the source."""
        words, place = self._words.drawn(instant.steps)
        if words is not None:
            # 53 bits of a word, as a number from 0 to 1, 1 excluded
            self._lost[:] = (words >> np.uint64(11)) * 2.0**-53 < self.probability
        if not self._lost[place]:
            return 1.0, NOTHING_ADDED
        return 0.0, math.nan if self.may_be_nan else instant.kept

    def copy(self) -> Fault:
        """Return itself: what is lost depends on the instant alone."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class DelayFault:
    """The source arrives late, by a number of communication steps."""

    steps: int
    past: deque[float] = field(default_factory=deque)
    kind: ClassVar[FaultKind] = "delay"
    varies: ClassVar[bool] = True

    @property
    def parameters(self) -> tuple[float, ...]:
        """The number of steps."""
        return (float(self.steps),)

    def at(self, instant: FaultInstant) -> tuple[float, float]:
        """Return what was sent so long ago, or first."""
        if instant.steps == 0:
            return 0.0, instant.source
        self.past.append(instant.source)
        if len(self.past) > self.steps:
            self.past.popleft()
        return 0.0, self.past[0]

    def copy(self) -> Fault:
        """Return one with the same past."""
        return DelayFault(self.steps, self.past.copy())
