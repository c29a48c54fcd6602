"""Product: inputs multiplied and divided, element by element."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Vector
from cosim.blocks.static import CompiledStatic
from cosim.core.signals import Interface, Signal, element_names
from cosim.errors import UsageError
from cosim.native.blocks.functions import product_step


class Product(CompiledStatic):
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
                'product: operations: expected * or / for each input, like "*/" for u1/u2, got '
                f"{operations!r}"
            )
        self.operations = operations
        names = tuple(f"u{i}" for i in range(1, len(operations) + 1))
        inputs = tuple(Signal(name, size) for name in names)
        y = Signal("y", size, unit, "inherited")
        divides = [operation == "/" for operation in operations]
        self._divisors = np.repeat(divides, size)
        interface = Interface(inputs, (y,), {"y": names})
        super().__init__(interface, product_step(divides, size), self._zero)

    def _zero(self, u: Vector) -> str:
        """Name the first input that is 0 and to divide by."""
        zeros = self._divisors & (u == 0.0)
        elements = element_names(self.interface.inputs)
        name = elements[int(zeros.argmax())]
        return f"product: division by zero: {name} is 0"
