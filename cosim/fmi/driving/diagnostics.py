"""What a run shows about an FMU that its user should know."""

from __future__ import annotations

import math
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import listing
from cosim.fmi.binary.messages import Message
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable

ROUNDING: Final = 1e-15  # relative


@final
class Diagnostics:
    """Warnings about an FMU, at most one on each topic, kept until they are fetched."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._topics: set[str] = set()  # of all warnings so far
        self._new: list[tuple[str, Message]] = []  # with their topics
        self._count = 0  # of all warnings so far

    def add(self, t: float | None, topic: str, warning: str, category: str = "") -> None:
        """Add a warning, unless there was one on that topic before.

        ``t`` [s] is when; None: that is not known. ``category``: what programs know it by.
        """
        if topic not in self._topics:
            self._topics.add(topic)
            self._count += 1
            message = Message(t, "warning", category, f"{self._name}: {warning}")
            self._new.append((topic, message))

    def discard(self) -> None:
        """Forget all warnings, so that each may come again."""
        self._topics.clear()
        self._new.clear()

    def drain(self) -> list[Message]:
        """Return the warnings since the last call."""
        messages = [message for _, message in self._new]
        self._new = []
        return messages

    def save(self) -> int:
        """Return what the warnings up to now are known by."""
        return self._count

    def restore(self, state: int) -> None:
        """Forget the warnings since then; those that were fetched were shown, and stay known."""
        first = max(0, len(self._new) - (self._count - state))
        self._topics.difference_update(topic for topic, _ in self._new[first:])
        del self._new[first:]
        self._count = state


@final
class InputLimits:
    """Finds values of inputs that their FMU does not allow: by min and max, or an enumeration.

    Values are looked at as rows of many communication points, once they are final.

    Parameters
    ----------
    name : str
        Names the FMU in warnings.
    inputs : ReferenceMap
    """

    def __init__(self, name: str, inputs: ReferenceMap) -> None:
        limited = [
            (column, element.variable)
            for column, element in enumerate(inputs.elements)
            if _is_limited(element.variable)
        ]
        self.diagnostics = Diagnostics(name)
        self._variables = [variable for _, variable in limited]
        self._columns = np.array([column for column, _ in limited], np.intp)
        lowest = np.array([variable.minimum for variable in self._variables])
        highest = np.array([variable.maximum for variable in self._variables])
        # What gains and units make of a value at its limit may be a few roundings beyond it.
        self._lowest = lowest - ROUNDING * np.abs(lowest)
        self._highest = highest + ROUNDING * np.abs(highest)

    @property
    def are_there(self) -> bool:
        """Whether any input has a limit."""
        return len(self._columns) > 0

    def check(self, t: Vector, u: Matrix) -> None:
        """Warn, once an input, of values at ``t`` [s], shape (n,), in ``u``, shape (n, n_u)."""
        values = u[:, self._columns]
        outside = (values < self._lowest) | (values > self._highest)
        for place, variable in enumerate(self._variables):
            if variable.items:
                outside[:, place] |= ~np.isin(values[:, place], list(variable.items.values()))
        for place in np.flatnonzero(outside.any(axis=0)).tolist():
            row = int(outside[:, place].argmax())
            variable = self._variables[place]
            self.diagnostics.add(
                float(t[row]),
                variable.name,
                f"input {variable.name!r} is driven with {float(values[row, place])!r}; expected "
                f"{_allowed(variable)}, as the FMU declares",
            )


def _is_limited(variable: Variable) -> bool:
    return bool(variable.items) or variable.minimum > -math.inf or variable.maximum < math.inf


def _allowed(variable: Variable) -> str:
    if variable.items:
        return listing([f"{number} ({item})" for item, number in variable.items.items()])
    if variable.maximum == math.inf:
        return f"at least {variable.minimum!r} (min)"
    if variable.minimum == -math.inf:
        return f"at most {variable.maximum!r} (max)"
    return f"{variable.minimum!r} to {variable.maximum!r} (min, max)"
