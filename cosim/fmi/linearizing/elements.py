"""The numbers that a unit is linearized for: elements of its states, inputs and outputs, found by the names that users give."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import FmuError, nearest
from cosim.fmi.description import Description
from cosim.fmi.driving.initialization import StartValue
from cosim.fmi.references import ReferenceMap, VectorElement
from cosim.fmi.variable import Variable

NOWHERE: Final = -1  # the value reference of what has none: the states of FMI 1


@dataclass(frozen=True, slots=True)
class Element:
    """One number of a variable, and the port that it belongs to."""

    name: str
    port: str
    variable: Variable
    index: int

    @property
    def key(self) -> tuple[str, int, int]:
        """The same for aliases (FMI 2.0.4 section 2.2.7: equal value references)."""
        return self.variable.type, self.variable.reference, self.index

    @property
    def moves(self) -> bool:
        """Whether it is real and continuous."""
        return self.variable.kind == "real" and self.variable.variability == "continuous"

    @property
    def whole(self) -> bool:
        """Whether it is all of a variable that has a name."""
        return self.variable.size == 1 and self.variable.reference != NOWHERE

    def checked(self, label: str, value: StartValue) -> float:
        """Refuse what is no finite number, or outside the range."""
        low, high = self.variable.minimum, self.variable.maximum
        if not (isinstance(value, int | float) and math.isfinite(value) and low <= value <= high):
            needed = (
                "a finite number" if math.isinf(low) and math.isinf(high) else f"{low} to {high}"
            )
            raise FmuError(
                f"{label}: start value of {self.name!r}: found {value!r}, needed {needed}"
            )
        return value


def elements_of(port: str, variable: Variable) -> Iterator[Element]:
    """Take a variable of a port apart; an element of several has its number behind the name."""
    alone = variable.size == 1 and variable.reference != NOWHERE
    for i in range(variable.size):
        yield Element(variable.name if alone else f"{variable.name}[{i}]", port, variable, i)


@dataclass(frozen=True, slots=True)
class Chosen:
    """What a unit is linearized for, among all its states and inputs."""

    all_states: tuple[Element, ...]
    all_inputs: tuple[Element, ...]
    states: tuple[Element, ...]
    inputs: tuple[Element, ...]
    outputs: tuple[Element, ...]

    @staticmethod
    def of(
        description: Description,
        *,
        states: Sequence[str] | None,
        inputs: Sequence[str] | None,
        outputs: Sequence[str] | None,
    ) -> Chosen:
        """Find what is named."""
        label = description.name
        unnamed = Variable("state", NOWHERE, "local", size=description.unnamed_states)
        variables = [
            *map(description.__getitem__, description.states),
            *([unnamed] if unnamed.size else []),
        ]
        all_states = tuple(e for v in variables for e in elements_of(v.name.rpartition("[")[0], v))
        all_inputs, all_outputs = (
            tuple(
                e
                for signal, group in description.ports(causality)
                for v in group
                for e in elements_of(signal.name, v)
            )
            for causality in ("input", "output")
        )
        shown = [e for e in all_outputs if e.moves and e.variable.causality == "output"]
        return Chosen(
            all_states,
            all_inputs,
            states=_select(label, "state", all_states, states, all_states),
            inputs=_select(label, "input", all_inputs, inputs, [e for e in all_inputs if e.moves]),
            outputs=_select(label, "output", all_outputs, outputs, shown),
        )

    @property
    def columns(self) -> tuple[Element, ...]:
        """States, then inputs."""
        return self.states + self.inputs

    @property
    def notes(self) -> tuple[str, ...]:
        """What does not move although it might."""
        still = [e.name for e in self.all_inputs if not e.moves]
        held = [e.name for e in self.all_states if e not in self.states]
        notes = {
            "held constant: only inputs that are real and continuous can be linearized for": still,
            "held at the operating point: not among the states that were named": held,
        }
        return tuple(f"{', '.join(names)} {why}" for why, names in notes.items() if names)


def _select(
    label: str,
    what: str,
    there: Sequence[Element],
    wanted: Sequence[str] | None,
    default: Sequence[Element],
) -> tuple[Element, ...]:
    if wanted is None:
        return tuple(default)
    found: list[Element] = []
    for name in wanted:
        own = [e for e in there if name in (e.name, e.variable.name)] or [
            e for e in there if name == e.port
        ]
        still = next((e for e in own if not e.moves), None)
        if not own:
            raise FmuError(f"{label}: no {what} {name!r}; {nearest(name, [e.name for e in there])}")
        if still is not None:
            how = f"type {still.variable.type}, variability {still.variable.variability}"
            raise FmuError(
                f"{label}: {what} {name!r} cannot be linearized for: found {how}, needed a real and continuous one"
            )
        if any(e.name == other.name for e in own for other in found):
            raise FmuError(f"{label}: {what} {name!r} is named twice; needed each once")
        found += own
    return tuple(found)


def derivative_of(description: Description, state: Element) -> Element:
    """Find the derivative of a state element."""
    mine = [v for v in description.variables if v.derivative_of == state.variable.name]
    mine.sort(
        key=lambda v: v.name not in description.dependencies
    )  # the one that ModelStructure names
    if not mine:
        raise FmuError(
            f"{description.name}: no variable is the derivative of {state.name!r}; use central differences"
        )
    return Element(f"der({state.name})", "", mine[0], state.index)


def references_of(elements: Sequence[Element]) -> tuple[ReferenceMap, NDArray[np.intp]]:
    """Return the variables of some elements, each once, and where the elements stand in their values."""
    references = ReferenceMap.of_distinct(e.variable for e in elements)
    return references, references.columns_of(VectorElement(e.variable, e.index) for e in elements)
