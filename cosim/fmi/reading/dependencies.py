"""Read what depends on what: ModelStructure of FMI 2 and 3, DirectDependency and counts of FMI 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias
from xml.etree.ElementTree import Element

from cosim.fmi.reading.markup import Attributes
from cosim.fmi.reading.variables import major
from cosim.fmi.variable import Variable

Dependencies: TypeAlias = dict[str, tuple[str, ...] | None]


@dataclass(frozen=True, slots=True)
class Structure:
    """What a file says of its unknowns; see :class:`cosim.fmi.description.Description`."""

    outputs: Dependencies
    derivatives: Dependencies
    initial: Dependencies
    event_indicators: int
    indicators: tuple[str, ...] = ()
    unnamed_states: int = 0


def read_structure(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read the structure of any version."""
    return (_structure_1, _structure_2, _structure_3)[major(root) - 1](root, variables, attributes)


def _structure_1(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read DirectDependency (FMI 1.0 section 3.2): names of inputs; without it an output depends on all of them."""
    outputs: Dependencies = {}
    for element in root.iterfind("ModelVariables/ScalarVariable"):
        direct = element.find("DirectDependency")
        if direct is not None:
            outputs[element.get("name", "")] = tuple(
                (name.text or "").strip() for name in direct.iterfind("Name")
            )
    counts = (
        attributes.integer(root, f"numberOf{what}", root.tag)
        for what in ("EventIndicators", "ContinuousStates")
    )
    indicators, states = (_count(number, attributes) for number in counts)
    return Structure(outputs, {}, {}, indicators, unnamed_states=states)


def _structure_2(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read ModelStructure (FMI 2.0.4 section 2.2.8): variables by position, from 1."""
    names = {number: variable.name for number, variable in enumerate(variables, 1)}
    outputs, derivatives, initial = (
        _unknowns(root, f"{section}/Unknown", "index", names, attributes)
        for section in ("Outputs", "Derivatives", "InitialUnknowns")
    )
    indicators = attributes.integer(root, "numberOfEventIndicators", root.tag)
    return Structure(outputs, derivatives, initial, _count(indicators, attributes))


def _structure_3(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read ModelStructure (FMI 3.0 section 2.4.8): variables by value reference."""
    names = {
        variable.reference: variable.name for variable in variables if variable.alias_of is None
    }
    outputs, derivatives, initial, indicators = (
        _unknowns(root, section, "valueReference", names, attributes)
        for section in ("Output", "ContinuousStateDerivative", "InitialUnknown", "EventIndicator")
    )
    count = sum(
        variable.size
        for variable in variables
        if variable.name in indicators and variable.alias_of is None
    )
    return Structure(outputs, derivatives, initial, count, tuple(indicators))


def _count(number: int | None, attributes: Attributes) -> int:
    if number is not None and not 0 <= number < 2**31:
        attributes.problems.append(f"found a count of {number}, needed one that is not negative")
        return 0
    return number or 0


def _unknowns(
    root: Element, section: str, key: str, names: Mapping[int, str], attributes: Attributes
) -> Dependencies:
    found: Dependencies = {}
    for element in root.iterfind(f"ModelStructure/{section}"):
        where = f"ModelStructure/{section}"
        number = attributes.integer(element, key, where)
        if number is None or number not in names:
            attributes.problems.append(f"{where}: {key}={element.get(key)} is no variable")
            continue
        known = attributes.integers(element, "dependencies", f"{where} {names[number]!r}")
        missing = [str(other) for other in known or () if other not in names]
        if missing:
            attributes.problems.append(
                f"{where} {names[number]!r}: dependencies name no variable: {', '.join(missing)}"
            )
        found[names[number]] = (
            None if known is None else tuple(names[other] for other in known if other in names)
        )
    return found


def name_states(
    derivatives: Dependencies, named: Mapping[str, Variable], problems: list[str]
) -> tuple[str, ...]:
    """Name the states, in the order of the derivatives."""
    states = []
    for name in derivatives:
        state = named[name].derivative_of
        if state is None:
            problems.append(
                f"{name!r} is listed as a derivative, but has no attribute derivative that names its state"
            )
        else:
            states.append(state)
    return tuple(states)
