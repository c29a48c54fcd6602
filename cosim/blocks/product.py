"""Product: inputs multiplied and divided, element by element."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Stopped
from cosim.core.signals import Interface, Signal
from cosim.errors import RunError, UsageError


class Product:
    """``y = u1 u2 ...``, or divided by some of them, element by element.

    Parameters
    ----------
    operations : str
        For each input ``*`` or ``/``: ``"**/"`` is ``y = u1 u2 / u3``, computed from left to right.
    size : int
        Number of elements of every signal.
    unit : str, optional
        The unit of y.

    Raises
    ------
    UsageError
        If there are no operations, or others.
    RunError
        From ``initialize`` and ``outputs``, where an input to divide by is 0; from ``advance`` it
        is :class:`Stopped`.
    """

    def __init__(self, operations: str, *, size: int = 1, unit: str | None = None) -> None:
        if not operations or set(operations) - {"*", "/"}:
            raise UsageError(
                f"product: found operations {operations!r}, needed * or / for each input, "
                'like "*/" for u1/u2'
            )
        self.operations = operations
        names = tuple(f"u{i}" for i in range(1, len(operations) + 1))
        inputs = tuple(Signal(name, size) for name in names)
        y = Signal("y", size, unit, "inherited")
        self.interface = Interface(inputs, (y,), {"y": names})
        self._size = size

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        rows = u[np.newaxis]
        if self._zeros(rows).any():
            raise RunError(self._not_divided(u))
        y: Vector = self._at(rows)[0]
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``.

        Raises
        ------
        Stopped
            Where an input to divide by is 0; with the rows before it.
        """
        rows = u[1:]
        refused = np.flatnonzero(self._zeros(rows).any(axis=1))
        if refused.size:
            first = int(refused[0])
            raise Stopped(self._at(rows[:first]), self._not_divided(rows[first]))
        return self._at(rows)

    def _at(self, u: Matrix) -> Matrix:
        """Return y, shape (K, size), for inputs of shape (K, n_u)."""
        y = np.ones((len(u), self._size))
        # a result beyond all numbers is named by the master, as with every component
        with np.errstate(over="ignore", invalid="ignore"):
            for i, operation in enumerate(self.operations):
                factor = u[:, i * self._size : (i + 1) * self._size]
                y = y * factor if operation == "*" else y / factor
        return y

    def _zeros(self, u: Matrix) -> Mask:
        """Return which inputs are to divide by and 0, of the shape of u."""
        divides = [operation == "/" for operation in self.operations]
        zeros: Mask = np.repeat(divides, self._size) & (u == 0.0)
        return zeros

    def _not_divided(self, u: Vector) -> str:
        elements: list[str] = []
        for signal in self.interface.inputs:
            elements += signal.elements
        first = int(np.flatnonzero(self._zeros(u))[0])
        return f"product: {elements[first]} is 0, and y is divided by it; needed another value"
