"""Sources: components without inputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix, Vector, frozen
from cosim.core.contracts import Stopped
from cosim.core.signals import Interface, Signal, SignalType, Variability
from cosim.errors import UsageError
from cosim.native.expression import compile_expression
from cosim.native.step import evaluate, expression_step


class Expression:
    """``y_i(t)`` given as expressions in t; see :mod:`cosim.native.expression` for the language.

    Parameters
    ----------
    texts : sequence of str
        One expression an element of y.
    variability : {"continuous", "discrete"}
        "discrete" for signals that jump.
    unit : str or None
    kind : {"real", "integer", "boolean"}
    """

    def __init__(
        self,
        texts: Sequence[str],
        *,
        variability: Variability = "continuous",
        unit: str | None = None,
        kind: SignalType = "real",
    ) -> None:
        self.programs = tuple(compile_expression(text) for text in texts)
        self.interface = Interface(outputs=(Signal("y", len(texts), unit, variability, kind=kind),))
        self._step = expression_step(self.programs)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Give y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give y(t)."""
        return np.array([evaluate(program, t) for program in self.programs])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Give y at ``t[1:]``."""
        return self._step.advance(t, h, u)


def constant(
    value: Sequence[float], *, unit: str | None = None, kind: SignalType = "real"
) -> Expression:
    """``y = value``."""
    return Expression([repr(float(v)) for v in value], unit=unit, kind=kind)


def step(
    *, time: float, before: float = 0.0, after: float = 1.0, unit: str | None = None
) -> Expression:
    """``y = before`` until ``time`` [s], then ``after``: a discrete signal."""
    past = f"step(t - {float(time)!r})"  # products with 0 and 1: both values to the last bit
    return Expression(
        [f"{float(before)!r}*(1 - {past}) + {float(after)!r}*{past}"],
        variability="discrete",
        unit=unit,
    )


def ramp(
    *, slope: float, start: float = 0.0, offset: float = 0.0, unit: str | None = None
) -> Expression:
    """``y = offset + slope max(0, t - start)``."""
    return Expression(
        [f"{float(offset)!r} + {float(slope)!r}*max(0, t - {float(start)!r})"], unit=unit
    )


def sine(
    *,
    rate: float,
    amplitude: float = 1.0,
    phase: float = 0.0,
    offset: float = 0.0,
    unit: str | None = None,
) -> Expression:
    """``y = offset + amplitude sin(rate t + phase)``; rate in rad/s."""
    return Expression(
        [f"{float(offset)!r} + {float(amplitude)!r}*sin({float(rate)!r}*t + {float(phase)!r})"],
        unit=unit,
    )


def chirp(
    *,
    rate: float,
    sweep: float,
    amplitude: float = 1.0,
    offset: float = 0.0,
    unit: str | None = None,
) -> Expression:
    """``y = offset + amplitude sin(rate t + sweep t^2 / 2)``: the rate [rad/s] grows by ``sweep`` [rad/s^2]."""
    angle = f"({float(rate)!r} + {0.5 * float(sweep)!r}*t)*t"
    return Expression([f"{float(offset)!r} + {float(amplitude)!r}*sin({angle})"], unit=unit)


class Table:
    """Straight lines between the points of a table; beyond its ends it refuses.

    Parameters
    ----------
    t : Vector, shape (N,)
        Instants [s], increasing.
    y : Matrix, shape (N, n)
    hold : bool
        Keep each value until the next instant instead (a discrete signal).

    Raises
    ------
    UsageError
        If the points are no table, or the run starts outside of it.
    Stopped
        From ``advance``, where the table ends.
    """

    def __init__(
        self, t: Vector, y: Matrix, *, hold: bool = False, unit: str | None = None
    ) -> None:
        if len(t) < 2 or len(t) != len(y):
            raise UsageError(
                f"table: found {len(t)} instants and {len(y)} values, needed the same number of both, at least 2"
            )
        if not (np.isfinite(t).all() and np.isfinite(y).all()):
            raise UsageError("table: found NaN or infinity, needed finite numbers")
        late = np.flatnonzero(np.diff(t) <= 0.0)
        if late.size:
            raise UsageError(
                f"table: t[{late[0] + 1}] = {t[late[0] + 1]} s does not come after {t[late[0]]} s; needed increasing instants"
            )
        self.t, self.y, self.hold = frozen(t, 1), frozen(y, 2), hold
        self.interface = Interface(
            outputs=(Signal("y", y.shape[1], unit, "discrete" if hold else "continuous"),)
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Give y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give y(t)."""
        if not self.t[0] <= t <= self.t[-1]:
            raise UsageError(self._beyond(t))
        y: Vector = self._at(np.array([t]))[0]
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Give y at ``t[1:]``."""
        inside = t[1:][t[1:] <= self.t[-1]]
        y = self._at(inside)
        if len(y) < len(t) - 1:
            raise Stopped(y, self._beyond(float(t[len(y) + 1])))
        return y

    def _beyond(self, t: float) -> str:
        return f"table: covers {self.t[0]} s to {self.t[-1]} s, was asked for {t} s"

    def _at(self, t: Vector) -> Matrix:
        if self.hold:
            return self.y[np.searchsorted(self.t, t, side="right") - 1]
        return np.column_stack([np.interp(t, self.t, column) for column in self.y.T])


class Noise:
    """Seeded Gaussian noise, a new value at every communication point: a discrete signal.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    seed : int
    size : int
    """

    def __init__(
        self, *, deviation: float, seed: int, size: int = 1, unit: str | None = None
    ) -> None:
        self.deviation, self.seed, self.size = deviation, seed, size
        self.interface = Interface(outputs=(Signal("y", size, unit, "discrete"),))
        self._last = np.zeros(size)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Begin the sequence anew."""
        self._generator = np.random.Generator(np.random.PCG64(self.seed))
        self._last = self._draw(1)[0]
        return self._last.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the last value."""
        return self._last.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Draw K values."""
        values = self._draw(len(t) - 1)
        if len(values):
            self._last = values[-1].copy()
        return values

    def _draw(self, count: int) -> Matrix:
        return self.deviation * self._generator.standard_normal((count, self.size))
