"""Known factors alpha of a disturbance for the kernels: expressions in t, or signals of the run."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from ctypes import c_int32, c_void_p
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from cosim.errors import UsageError
from cosim.native.library import int32, pointer
from cosim.native.numerics.expression import Program
from cosim.native.numerics.programs import program_array

_ROUNDING: Final = 1e-9  # of an age in communication steps that is a whole number


class AlphasStruct(ctypes.Structure):
    """cosim_alphas."""

    _fields_ = (
        *((name, c_int32) for name in ("count", "signals")),
        *((name, c_void_p) for name in ("element", "programs")),
    )


class PastAlphasStruct(ctypes.Structure):
    """cosim_past_alphas."""

    _fields_ = (
        *((name, c_int32) for name in ("count", "signals")),
        *((name, c_void_p) for name in ("element", "programs")),
        *((name, c_int32) for name in ("rows", "depth")),
        *((name, c_void_p) for name in ("age", "steps", "part")),
    )


@dataclass(frozen=True, slots=True)
class AlphaSignal:
    """An alpha that is a signal of the run: an element of the input ``alpha``.

    Parameters
    ----------
    text : str
        What it is, such as ``schedule.y[1]``.
    element : int
        Of the input.
    lag : float
        How far the signal lags behind alpha [s].
    """

    text: str
    element: int
    lag: float = 0.0


Alpha: TypeAlias = Program | AlphaSignal


def signals_among(alphas: Sequence[Alpha]) -> list[AlphaSignal]:
    """Return the distinct signals, in the order of the input's elements."""
    by_element = {alpha.element: alpha for alpha in alphas if isinstance(alpha, AlphaSignal)}
    return [by_element[element] for element in sorted(by_element)]


def elements_of(alphas: Sequence[Alpha]) -> list[int]:
    """Return for each alpha its element of the input; -1: it is an expression."""
    return [alpha.element if isinstance(alpha, AlphaSignal) else -1 for alpha in alphas]


def alphas_struct(alphas: Sequence[Alpha]) -> tuple[AlphasStruct, tuple[object, ...]]:
    """Return cosim_alphas, and what must outlive it."""
    programs = program_array(alphas)
    elements = int32(elements_of(alphas))
    signals = len(signals_among(alphas))
    struct = AlphasStruct(len(alphas), signals, pointer(elements), ctypes.addressof(programs))
    return struct, (programs, *alphas, elements)


class _StepsBefore(NamedTuple):
    steps: int
    part: float


@dataclass(frozen=True, eq=False, kw_only=True)
class PastAlphas:
    """The numbers of cosim_past_alphas: alphas at instants before now.

    Parameters
    ----------
    alphas : sequence of Alpha
    ages : sequence of float
        How long before now they are [s].
    h : float
        Communication step [s].
    depth : int or None
        Samples of the signals that are kept; None: as many as are needed.

    Raises
    ------
    UsageError
        If a signal lags behind its alpha so far that the value is not there yet.
    """

    alphas: Sequence[Alpha]
    ages: Sequence[float]
    h: float
    depth: int | None = None

    def __post_init__(self) -> None:
        for signal in signals_among(self.alphas):
            if min(self.ages) < signal.lag * (1.0 - _ROUNDING):
                raise UsageError(
                    f"alpha {signal.text!r}: expected a lag of at most {min(self.ages):g} s, got "
                    f"{signal.lag:g} s"
                )

    @property
    def signals(self) -> int:
        """The number of elements of the input ``alpha``."""
        return len(signals_among(self.alphas))

    @property
    def samples(self) -> int:
        """How many samples of the signals are kept."""
        if self.depth is not None:
            return self.depth
        needed = [0]
        for alpha in signals_among(self.alphas):
            for age in self.ages:
                before = self._before(alpha, age)
                needed.append(before.steps + (before.part > 0.0))
        return max(needed)

    @property
    def steps(self) -> list[int]:
        """Whole communication steps before now, of signals, for every alpha and age."""
        return [before.steps for before in self._all_before()]

    @property
    def parts(self) -> list[float]:
        """The parts of a step beside them."""
        return [before.part for before in self._all_before()]

    @property
    def memory(self) -> int:
        """The number of doubles of the samples."""
        return self.samples * self.signals

    def _all_before(self) -> list[_StepsBefore]:
        befores: list[_StepsBefore] = []
        for alpha in self.alphas:
            befores += [self._before(alpha, age) for age in self.ages]
        return befores

    def _before(self, alpha: Alpha, age: float) -> _StepsBefore:
        if isinstance(alpha, Program):
            return _StepsBefore(0, 0.0)
        steps = max(age - alpha.lag, 0.0) / self.h
        whole = round(steps)
        if abs(steps - whole) <= _ROUNDING * max(1, whole):
            return _StepsBefore(whole, 0.0)
        floor = math.floor(steps)
        return _StepsBefore(floor, steps - floor)

    def struct(self) -> tuple[PastAlphasStruct, tuple[object, ...]]:
        """Return cosim_past_alphas, and what must outlive it."""
        programs = program_array(self.alphas)
        elements = int32(elements_of(self.alphas))
        ages = np.array(self.ages, np.float64)
        steps = int32(self.steps)
        parts = np.array(self.parts, np.float64)
        state = PastAlphasStruct(
            len(self.alphas),
            self.signals,
            pointer(elements),
            ctypes.addressof(programs),
            len(self.ages),
            self.samples,
            pointer(ages),
            pointer(steps),
            pointer(parts),
        )
        return state, (programs, *self.alphas, elements, ages, steps, parts)
