"""Parts without memory: sum, gain, limit."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError


class Static:
    """``y = g(u)`` at every instant.

    Parameters
    ----------
    interface : Interface
        Every output feeds through from every input.
    function : callable
        From inputs, shape (K, n_u), to outputs, shape (K, n_y), row by row.
    """

    def __init__(self, interface: Interface, function: Callable[[Matrix], Matrix]) -> None:
        self.interface = interface
        self._function = function

    def initialize(self, t: float, u: Vector) -> Vector:
        """Give y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give y(t)."""
        y: Vector = self._function(u[np.newaxis])[0]
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Give y at ``t[1:]``."""
        return self._function(u[1:])


def _through(inputs: Sequence[Signal], size: int, unit: str | None) -> Interface:
    output = Signal("y", size, unit, "inherited")
    return Interface(tuple(inputs), (output,), {"y": tuple(signal.name for signal in inputs)})


def sum_of(signs: Sequence[float], *, size: int = 1, unit: str | None = None) -> Static:
    """``y = sum_i signs_i u_i``: inputs ``u1``, ``u2``, ... of the same size."""

    def function(u: Matrix) -> Matrix:
        total = np.zeros((len(u), size))
        for i, sign in enumerate(signs):
            total += sign * u[:, i * size : (i + 1) * size]
        return total

    if not signs:
        raise UsageError("sum: found no signs, needed one for each input, like [1, -1]")
    return Static(
        _through([Signal(f"u{i + 1}", size, unit) for i in range(len(signs))], size, unit), function
    )


def gain(K: Matrix, *, unit: str | None = None) -> Static:
    """``y = K u`` for K of shape (n_y, n_u); the sum runs in a fixed order."""

    def function(u: Matrix) -> Matrix:
        total = np.zeros((len(u), len(K)))
        for j, column in enumerate(K.T):
            total += u[:, j : j + 1] * column
        return total

    return Static(_through([Signal("u", K.shape[1])], len(K), unit), function)


def limit(*, lower: float, upper: float, size: int = 1, unit: str | None = None) -> Static:
    """``y = min(max(u, lower), upper)``.

    Raises
    ------
    UsageError
        If lower is not below upper.
    """
    if not lower < upper:
        raise UsageError(f"limit: found lower = {lower} and upper = {upper}, needed lower < upper")
    return Static(
        _through([Signal("u", size, unit)], size, unit), lambda u: np.clip(u, lower, upper)
    )
