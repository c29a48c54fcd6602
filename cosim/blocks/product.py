"""Product: inputs multiplied and divided, element by element."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix
from cosim.blocks.static import Static
from cosim.core.signals import Interface, Signal, element_names
from cosim.errors import UsageError


class Product(Static):
    """``y = u1 u2 ...``, or divided by some of them, element by element.

    Not defined where an input to divide by is 0.

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
        self._size = size
        super().__init__(Interface(inputs, (y,), {"y": names}), self._at, self._first_zero)

    def _at(self, u: Matrix) -> Matrix:
        """Return y, shape (K, size), for inputs of shape (K, n_u)."""
        y = np.ones((len(u), self._size))
        # a result beyond all numbers is named by the master, as with every component
        with np.errstate(over="ignore", invalid="ignore"):
            for i, operation in enumerate(self.operations):
                factor = u[:, i * self._size : (i + 1) * self._size]
                y = y * factor if operation == "*" else y / factor
        return y

    def _first_zero(self, u: Matrix) -> tuple[int, str] | None:
        """Return the first row with an input that is 0 and to divide by."""
        divides = [operation == "/" for operation in self.operations]
        zeros = np.repeat(divides, self._size) & (u == 0.0)
        refused = zeros.any(axis=1)
        if not refused.any():
            return None
        first = int(refused.argmax())
        elements = element_names(self.interface.inputs)
        name = elements[int(zeros[first].argmax())]
        return first, f"product: {name} is 0, and y is divided by it; needed another value"
