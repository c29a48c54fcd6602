"""Components without memory: outputs that are a function of the inputs at the same instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Stopped
from cosim.core.linearization import Linearized, static
from cosim.core.signals import Interface
from cosim.errors import RunError
from cosim.native.step import NativeStep

RELATIVE: Final = 2.0**-17  # steps of central differences: near the cube root of the rounding
DISTANCES: Final = (1.0, 1e3, 1e6)  # from an operating point, where its derivatives are tried
LINEAR: Final = 1e-6  # relative: beyond the rounding of these derivatives


class CompiledStatic:
    """``y = g(u)`` at every instant, by a compiled function.

    Parameters
    ----------
    interface : Interface
        Every output feeds through from every input.
    step : NativeStep
        Of a component without memory; it declines where the function is not defined.
    reason : callable
        From inputs, shape (n_u,), that it declines, to the reason.
    gain : Matrix, shape (n_y, n_u), optional
        D, where ``g(u) = D u``.
    """

    def __init__(
        self,
        interface: Interface,
        step: NativeStep,
        reason: Callable[[Vector], str] = str,
        *,
        gain: Matrix | None = None,
    ) -> None:
        self.interface = replace(
            interface, rollback=True, native=True, linearizable=True, substeps=True
        )
        self._step = step
        self._reason = reason
        self._gain = gain

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t).

        Raises
        ------
        RunError
            Where the function is not defined.
        """
        y = self._step.outputs_at(t, u)
        if y is None:
            raise RunError(self._reason(u))
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``.

        Raises
        ------
        Stopped
            Where the function is not defined; with the rows before it.
        """
        y = self._step.advance(t, h, u)
        if self._step.status:
            raise Stopped(y, self._reason(u[len(y) + 1]))
        return y

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return D, where it is not known by central differences."""
        if self._gain is not None:
            return static(self._gain)
        return _linearized(lambda changed: self.outputs(t, changed), u, self.interface)

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""


class Static:
    """``y = g(u)`` at every instant, by a function in Python.

    Parameters
    ----------
    interface : Interface
        Every output feeds through from every input.
    function : callable
        From inputs, shape (K, n_u), to outputs, shape (K, n_y), row by row.
    first_refused : callable, optional
        From inputs, shape (K, n_u), to the first row that the function is not defined at, with the
        reason; None: it is defined at all of them.
    """

    def __init__(
        self,
        interface: Interface,
        function: Callable[[Matrix], Matrix],
        first_refused: Callable[[Matrix], tuple[int, str] | None] = lambda u: None,
    ) -> None:
        self.interface = replace(interface, rollback=True, linearizable=True, substeps=True)
        self._function = function
        self._first_refused = first_refused

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return D by central differences."""
        return _linearized(lambda changed: self.outputs(t, changed), u, self.interface)

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t).

        Raises
        ------
        RunError
            Where the function is not defined.
        """
        rows = u[np.newaxis]
        refused = self._first_refused(rows)
        if refused is not None:
            _, reason = refused
            raise RunError(reason)
        y: Vector = self._function(rows)[0]
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``.

        Raises
        ------
        Stopped
            Where the function is not defined; with the rows before it.
        """
        rows = u[1:]
        refused = self._first_refused(rows)
        if refused is not None:
            first, reason = refused
            raise Stopped(self._function(rows[:first]), reason)
        return self._function(rows)


@np.errstate(all="ignore")  # far away it may not be defined
def _linearized(
    function: Callable[[Vector], Vector], u: Vector, interface: Interface
) -> Linearized:
    """Return D by central differences, and whether it holds far from u, too."""
    own = static(_differences(function, u, interface))
    direction = np.where(_are_real(interface), 1.0 / np.arange(1.0, len(u) + 1.0), 0.0)
    try:
        y = function(u)
        for size in (sign * distance for distance in DISTANCES for sign in (1.0, -1.0)):
            change = own.D @ (size * direction)
            error = np.abs(function(u + size * direction) - y - change).max(initial=0.0)
            terms = np.abs(y).max(initial=0.0) + np.abs(own.D).max(initial=0.0) * abs(size)
            if not error <= LINEAR * terms:
                return replace(own, is_local=True)
    except (RunError, ArithmeticError, ValueError):  # it is not defined there
        return replace(own, is_local=True)
    return own


def _are_real(interface: Interface) -> list[bool]:
    is_real: list[bool] = []
    for signal in interface.inputs:
        is_real += [signal.type == "real"] * signal.size
    return is_real


def _differences(function: Callable[[Vector], Vector], u: Vector, interface: Interface) -> Matrix:
    """Return the derivatives of a function, shape (n_y, n_u), by central differences.

    By integers and Booleans, which do not change by little, they are zero.
    """
    D = np.zeros((interface.n_y, len(u)))
    for i in np.flatnonzero(_are_real(interface)):
        # a power of two, so that the difference of the inputs has no rounding of its own
        step = RELATIVE * 2.0 ** np.ceil(np.log2(max(1.0, abs(u[i]))))
        above = u.copy()
        above[i] += step
        below = u.copy()
        below[i] -= step
        D[:, i] = (function(above) - function(below)) / (2.0 * step)
    return D
