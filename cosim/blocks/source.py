"""Sources: components without inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.core.contracts import Stopped
from cosim.core.signals import Interface, Signal, SignalType, Variability
from cosim.errors import UsageError
from cosim.native.blocks.functions import drawn_step, table_step
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.noise import WORDS_PER_NORMAL, normal
from cosim.native.numerics.programs import evaluate, expression_step
from cosim.native.step import NativeStep

_DRAWN_AHEAD: Final = 4096  # numbers that are drawn at once: a call for each value is slow


class Expression:
    """``y_i(t)`` given as expressions in t.

    :mod:`cosim.native.numerics.expression` describes the language.

    Parameters
    ----------
    texts : sequence of str
        One expression an element of y.
    variability : {"continuous", "discrete", "inherited"}
        "discrete" for signals that jump, "inherited" for constants.
    unit : str or None
    signal_type : {"real", "integer", "boolean"}
    """

    def __init__(
        self,
        texts: Sequence[str],
        *,
        variability: Variability = "continuous",
        unit: str | None = None,
        signal_type: SignalType = "real",
    ) -> None:
        self.programs = tuple(compile_expression(text) for text in texts)
        y = Signal("y", len(texts), unit, variability, type=signal_type)
        self.interface = Interface(outputs=(y,), rollback=True, native=True, continuous=True)
        self._step = expression_step(self.programs)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return np.array([evaluate(program, t) for program in self.programs])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``."""
        return self._step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""


def constant(
    value: Sequence[float], *, unit: str | None = None, signal_type: SignalType = "real"
) -> Expression:
    """Build ``y = value``."""
    texts = [_number(element) for element in value]
    # what is added to it may hold or not
    return Expression(texts, variability="inherited", unit=unit, signal_type=signal_type)


def step(
    *, time: float, before: float = 0.0, after: float = 1.0, unit: str | None = None
) -> Expression:
    """Build ``y = before`` until ``time`` [s], then ``after``: a discrete signal."""
    past = f"step(t - {_number(time)})"
    # products with 0 and 1: both values to the last bit
    first = f"{_number(before)}*(1 - {past})"
    second = f"{_number(after)}*{past}"
    return Expression([f"{first} + {second}"], variability="discrete", unit=unit)


def ramp(
    *, slope: float, start_time: float = 0.0, offset: float = 0.0, unit: str | None = None
) -> Expression:
    """Build ``y = offset + slope max(0, t - start_time)``."""
    elapsed = f"max(0, t - {_number(start_time)})"
    text = f"{_number(offset)} + {_number(slope)}*{elapsed}"
    return Expression([text], unit=unit)


def sine(
    *,
    rate: float,
    amplitude: float = 1.0,
    phase: float = 0.0,
    offset: float = 0.0,
    unit: str | None = None,
) -> Expression:
    """Build ``y = offset + amplitude sin(rate t + phase)``; rate in rad/s, phase in rad."""
    angle = f"{_number(rate)}*t + {_number(phase)}"
    text = f"{_number(offset)} + {_number(amplitude)}*sin({angle})"
    return Expression([text], unit=unit)


def chirp(
    *,
    rate: float,
    sweep: float,
    amplitude: float = 1.0,
    offset: float = 0.0,
    unit: str | None = None,
) -> Expression:
    """Build ``y = offset + amplitude sin(rate t + sweep t^2 / 2)``.

    The rate [rad/s] grows by ``sweep`` [rad/s^2].
    """
    half_sweep = _number(0.5 * float(sweep))
    angle = f"({_number(rate)} + {half_sweep}*t)*t"
    text = f"{_number(offset)} + {_number(amplitude)}*sin({angle})"
    return Expression([text], unit=unit)


def _number(value: float) -> str:
    return repr(float(value))


class Table:
    """Linear interpolation between the points of a table.

    Parameters
    ----------
    t : Vector, shape (N,)
        Instants [s], increasing. With ``hold`` two may be equal, a jump: the second row counts.
    y : Matrix, shape (N, n)
    hold : bool
        Zero-order hold instead: each value until the next instant (a discrete signal).
    extrapolate : bool
        Hold the first value before the first instant, and the last value after the last.
    unit : str, or tuple of str, optional
        One for all elements, or one for each.

    Raises
    ------
    UsageError
        If the points are no table, or the run starts outside it without ``extrapolate``.
    Stopped
        From ``advance``, where the table ends without ``extrapolate``.
    """

    def __init__(
        self,
        t: Vector,
        y: Matrix,
        *,
        hold: bool = False,
        extrapolate: bool = False,
        unit: str | tuple[str, ...] | None = None,
    ) -> None:
        check_points(t, y, hold=hold)
        self.t = frozen(t, 1)
        self.y = frozen(y, 2)
        self.hold = hold
        self.extrapolate = extrapolate
        slopes = np.zeros_like(self.y)
        if not hold:
            slopes[:-1] = _slopes(self.t, self.y)
        self._step = table_step(self.t, self.y, slopes, hold=hold, extrapolate=extrapolate)
        size = y.shape[1]
        signal = Signal("y", size, unit, "discrete" if hold else "continuous")
        self.interface = Interface(outputs=(signal,), rollback=True, native=True, continuous=True)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t).

        Raises
        ------
        UsageError
            If ``t`` is outside the table.
        """
        y = self._step.outputs_at(t, u)
        if y is None:
            raise UsageError(self._beyond(t))
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``.

        Raises
        ------
        Stopped
            Where the table ends; with the rows before it.
        """
        y = self._step.advance(t, h, u)
        if self._step.status:
            raise Stopped(y, self._beyond(float(t[len(y) + 1])))
        return y

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def _beyond(self, t: float) -> str:
        begin = self.t[0]
        end = self.t[-1]
        return f"table: expected a time from {begin} s to {end} s, got {t} s"


def _slopes(t: Vector, y: Matrix) -> Matrix:
    """Return the slopes between the points of a table, shape (N - 1, n)."""
    with np.errstate(over="ignore"):
        rises = np.diff(y, axis=0)
        slopes: Matrix = rises / np.diff(t)[:, np.newaxis]
    steep = np.flatnonzero(~np.isfinite(slopes).all(axis=1))
    if steep.size:
        first = steep[0]
        raise UsageError(
            f"table: the slope of y overflows between t[{first}] = {t[first]} s and "
            f"{t[first + 1]} s; use instants further apart, or zero-order interpolation"
        )
    return slopes


def check_points(t: Vector, y: Matrix, *, hold: bool) -> None:
    """Check the points of a table; parameters as of :class:`Table`.

    Raises
    ------
    UsageError
        If they are none.
    """
    instants = len(t)
    values = len(y)
    if instants < 2 or instants != values:
        raise UsageError(
            f"table: expected as many values as instants, at least 2, got {instants} instants and "
            f"{values} values"
        )
    finite = np.isfinite(t).all() and np.isfinite(y).all()
    if not finite:
        raise UsageError("table: expected finite numbers, got NaN or infinity")
    steps = np.diff(t)
    not_increasing = np.flatnonzero(steps < 0.0 if hold else steps <= 0.0)
    if not_increasing.size:
        before = not_increasing[0]
        after = before + 1
        if t[before] == t[after]:
            raise UsageError(
                f"table: t[{before}] and t[{after}] are both {t[after]} s, a jump, which linear "
                'interpolation cannot represent; use interpolation = "zero-order", or put the two '
                "a communication step apart"
            )
        raise UsageError(
            f"table: expected increasing instants, got t[{after}] = {t[after]} s after "
            f"t[{before}] = {t[before]} s"
        )


class NoiseState(NamedTuple):
    """Which of the rows that were drawn is next, and the state of the generator before them."""

    next: int
    generator: Any


class Noise:
    """Seeded Gaussian noise, a new value at every communication point: a discrete signal.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    seed : int
    size : int
        Number of elements of y.
    unit : str, optional
    """

    def __init__(
        self, *, deviation: float, seed: int, size: int = 1, unit: str | None = None
    ) -> None:
        self.deviation = deviation
        self.seed = seed
        self.size = size
        y = Signal("y", size, unit, "discrete")
        self.interface = Interface(outputs=(y,), rollback=True, native=True)
        self._rows = np.zeros((max(1, _DRAWN_AHEAD // size), size))
        self._step = drawn_step(self._rows)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the sequence from its seed."""
        self._bits = np.random.PCG64(self.seed)
        self._draw()
        self._next = 1
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the last value."""
        y: Vector = self._rows[self._next - 1].copy()
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return the next K values; draw more where those that were drawn are used up."""
        values = np.empty((len(t) - 1, self.size))
        completed = 0
        while completed < len(values):
            if self._next == len(self._rows):
                self._draw()
                self._next = 0
            rows = self._rows[self._next :][: len(values) - completed]
            values[completed : completed + len(rows)] = rows
            completed += len(rows)
            self._next += len(rows)
        return values

    def save(self) -> NoiseState:
        """Return which of the rows that were drawn is next, and the generator before them."""
        return NoiseState(self._next, self._before)

    def restore(self, state: NoiseState) -> None:
        """Go back to a saved state."""
        if state.generator != self._before:
            self._bits.state = state.generator
            self._draw()
        self._next = state.next

    def native(self) -> NativeStep:
        """Return the compiled step: it takes what was drawn."""
        return self._step

    @property
    def _next(self) -> int:
        """The number of the next row of those that were drawn."""
        return int(self._step.memory[0])

    @_next.setter
    def _next(self, row: int) -> None:
        self._step.memory[0] = row

    def _draw(self) -> None:
        """Draw all rows anew."""
        self._before = self._bits.state
        words: NDArray[np.uint64] = self._bits.random_raw(WORDS_PER_NORMAL * self._rows.size)
        self._rows[:] = self.deviation * normal(words).reshape(self._rows.shape)
