"""The numbers that an instance is linearized for: elements of its states, inputs and outputs.

They are found by the names that users give.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import FmuError, nearest
from cosim.fmi.description import Description
from cosim.fmi.driving.initialization import StartValue
from cosim.fmi.references import ReferenceMap, VectorElement
from cosim.fmi.variable import Variable

NO_REFERENCE: Final = -1  # the value reference of what has none: the states of FMI 1


@dataclass(frozen=True, slots=True)
class Element:
    """One number of a variable, and the port that it belongs to."""

    name: str
    port: str
    variable: Variable
    index: int

    @property
    def key(self) -> tuple[str, int, bool, int]:
        """The same for aliases (FMI 2.0.4 section 2.2.7: equal value references)."""
        variable = self.variable
        return variable.type, variable.reference, variable.negated, self.index

    @property
    def is_continuous(self) -> bool:
        """Whether it is real and continuous."""
        variable = self.variable
        return variable.signal_type == "real" and variable.variability == "continuous"

    @property
    def is_variable(self) -> bool:
        """Whether it is all of a variable that has a name."""
        return self.variable.size == 1 and self.variable.reference != NO_REFERENCE

    def check_start(self, label: str, value: StartValue) -> float:
        """Return a start value of this element.

        Raises
        ------
        FmuError
            If it is no finite number, or outside the range.
        """
        low = self.variable.minimum
        high = self.variable.maximum
        if isinstance(value, int | float) and math.isfinite(value) and low <= value <= high:
            return value
        expected = f"{low} to {high}"
        if math.isinf(low) and math.isinf(high):
            expected = "a finite number"
        raise FmuError(f"{label}: start value of {self.name!r}: expected {expected}, got {value!r}")


def elements_of(port: str, variable: Variable) -> Iterator[Element]:
    """Yield the elements of a variable of a port; one of several has its number behind the name."""
    for i in range(variable.size):
        element = Element(f"{variable.name}[{i}]", port, variable, i)
        yield replace(element, name=variable.name) if element.is_variable else element


@dataclass(frozen=True, slots=True)
class Selection:
    """What an instance is linearized for, among all its states and inputs."""

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
    ) -> Selection:
        """Select what is named; None: all that are real and continuous."""
        label = description.name
        all_states = _all_states(description)
        all_inputs = _all_ports(description, "input")
        all_outputs = _all_ports(description, "output")
        # among the outputs are states that are read with them; these are selected by name only
        own_outputs = [e for e in all_outputs if e.variable.causality == "output"]
        selected_states = all_states
        selected_inputs = _continuous(all_inputs)
        selected_outputs = _continuous(own_outputs)
        if states is not None:
            selected_states = _find(label, "state", all_states, states)
        if inputs is not None:
            selected_inputs = _find(label, "input", all_inputs, inputs)
        if outputs is not None:
            selected_outputs = _find(label, "output", all_outputs, outputs)
        return Selection(all_states, all_inputs, selected_states, selected_inputs, selected_outputs)

    @property
    def columns(self) -> tuple[Element, ...]:
        """States, then inputs."""
        return self.states + self.inputs

    @property
    def notes(self) -> tuple[str, ...]:
        """What is constant although it might vary."""
        notes = []
        discrete = ", ".join(e.name for e in self.all_inputs if not e.is_continuous)
        if discrete:
            reason = "only inputs that are real and continuous can be linearized for"
            notes.append(f"{discrete} held constant: {reason}")
        held = ", ".join(e.name for e in self.all_states if e not in self.states)
        if held:
            reason = "not among the states that were named"
            notes.append(f"{held} held at the operating point: {reason}")
        return tuple(notes)


def _all_states(description: Description) -> tuple[Element, ...]:
    variables = [description[name] for name in description.states]
    if description.unnamed_states:
        variables.append(Variable("state", NO_REFERENCE, "local", size=description.unnamed_states))
    ports = {}
    for signal, group in description.ports("output"):
        for variable in group:
            ports[variable.name] = signal.name
    elements: list[Element] = []
    for variable in variables:
        elements += elements_of(ports.get(variable.name, variable.name), variable)
    return tuple(elements)


def _all_ports(description: Description, causality: str) -> tuple[Element, ...]:
    elements: list[Element] = []
    for signal, group in description.ports(causality):
        for variable in group:
            elements += elements_of(signal.name, variable)
    return tuple(elements)


def _continuous(elements: Sequence[Element]) -> tuple[Element, ...]:
    return tuple(element for element in elements if element.is_continuous)


def _find(
    label: str, what: str, elements: Sequence[Element], names: Sequence[str]
) -> tuple[Element, ...]:
    """Return the elements that are named by element, variable or port."""
    selected: list[Element] = []
    for name in names:
        matches = [e for e in elements if name in (e.name, e.variable.name)]
        if not matches:
            matches = [e for e in elements if name == e.port]
        if not matches:
            advice = nearest(name, [e.name for e in elements])
            raise FmuError(f"{label}: no {what} {name!r}; {advice}")
        _check_continuous(label, what, name, matches)
        names_before = {e.name for e in selected}
        if any(e.name in names_before for e in matches):
            raise FmuError(f"{label}: {what} {name!r} is named twice")
        selected += matches
    return tuple(selected)


def _check_continuous(label: str, what: str, name: str, elements: Sequence[Element]) -> None:
    for element in elements:
        if element.is_continuous:
            continue
        variable = element.variable
        properties = f"type {variable.type}, variability {variable.variability}"
        raise FmuError(
            f"{label}: {what} {name!r} cannot be linearized for: expected a real, continuous "
            f"variable, got {properties}"
        )


def derivative_of(description: Description, state: Element) -> Element:
    """Return the derivative of a state element.

    Raises
    ------
    FmuError
        If no variable is its derivative.
    """
    state_name = state.variable.name
    derivatives = [v for v in description.variables if v.derivative_of == state_name]
    if not derivatives:
        raise FmuError(
            f"{description.name}: no variable is the derivative of {state.name!r}; "
            "use central differences"
        )
    # the one that ModelStructure names, where several are
    declared = [v for v in derivatives if v.name in description.dependencies]
    variable = (declared or derivatives)[0]
    return Element(f"der({state.name})", "", variable, state.index)


def references_of(elements: Sequence[Element]) -> tuple[ReferenceMap, NDArray[np.intp]]:
    """Return the distinct variables of some elements, and where these stand in their values."""
    references = ReferenceMap.of_distinct(element.variable for element in elements)
    columns = references.columns_of(VectorElement(e.variable, e.index) for e in elements)
    return references, columns
