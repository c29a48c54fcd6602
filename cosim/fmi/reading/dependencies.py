"""Read what depends on what: ModelStructure of FMI 2 and 3, DirectDependency of FMI 1."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from cosim.errors import listing, quoted, shortened
from cosim.fmi.description import VariableDependencies
from cosim.fmi.reading.markup import Attributes, integers, whole
from cosim.fmi.reading.variables import major
from cosim.fmi.variable import Variable


@dataclass(frozen=True, slots=True)
class Structure:
    """What a file says of its unknowns; see :class:`cosim.fmi.description.Description`."""

    outputs: VariableDependencies
    derivatives: VariableDependencies
    initial: VariableDependencies
    event_indicators: int
    indicators: tuple[str, ...] = ()
    unnamed_states: int = 0


def read_structure(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read the structure of any version."""
    version = major(root)
    if version == 1:
        return _structure_1(root, attributes)
    if version == 2:
        return _structure_2(root, variables, attributes)
    return _structure_3(root, variables, attributes)


def _structure_1(root: Element, attributes: Attributes) -> Structure:
    """Read DirectDependency (FMI 1.0 section 3.2), the names of inputs; without it, all of them."""
    outputs: dict[str, tuple[str, ...]] = {}
    for element in root.iterfind("ModelVariables/ScalarVariable"):
        direct = element.find("DirectDependency")
        if direct is not None:
            inputs = [(name.text or "").strip() for name in direct.iterfind("Name")]
            # The first variable keeps a name that several have.
            outputs.setdefault(element.get("name", ""), tuple(inputs))
    indicators = _count(root, "numberOfEventIndicators", attributes)
    states = _count(root, "numberOfContinuousStates", attributes)
    return Structure(outputs, {}, {}, indicators, unnamed_states=states)


def _structure_2(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read ModelStructure (FMI 2.0.4 section 2.2.8): variables by position, from 1."""
    names = {number: variable.name for number, variable in enumerate(variables, 1)}
    reader = _UnknownsReader(root, "index", names, attributes)
    outputs = reader.unknowns("Outputs/Unknown")
    derivatives = reader.derivatives("Derivatives/Unknown")
    initial = reader.unknowns("InitialUnknowns/Unknown")
    indicators = _count(root, "numberOfEventIndicators", attributes)
    return Structure(outputs, derivatives, initial, indicators)


def _structure_3(
    root: Element, variables: tuple[Variable, ...], attributes: Attributes
) -> Structure:
    """Read ModelStructure (FMI 3.0 section 2.4.8): variables by value reference."""
    first_names = [variable for variable in variables if variable.alias_of is None]
    names = {variable.reference: variable.name for variable in first_names}
    reader = _UnknownsReader(root, "valueReference", names, attributes)
    outputs = reader.unknowns("Output")
    derivatives = reader.derivatives("ContinuousStateDerivative")
    initial = reader.unknowns("InitialUnknown")
    indicators = reader.unknowns("EventIndicator")
    count = sum(variable.size for variable in first_names if variable.name in indicators)
    return Structure(outputs, derivatives, initial, count, tuple(indicators))


def _count(root: Element, key: str, attributes: Attributes) -> int:
    number = attributes.integer(root, key, root.tag)
    if number is not None and not 0 <= number < 2**31:
        attributes.problems.append(f"expected a count from 0 to {2**31 - 1}, got {number}")
        return 0
    return number or 0


class _UnknownsReader:
    """Reads the sections of ModelStructure.

    Parameters
    ----------
    root : Element
    key : str
        Attribute that says which variable an unknown is.
    names : mapping of int to str
        Names of the variables by the values of that attribute.
    attributes : Attributes
    """

    def __init__(
        self, root: Element, key: str, names: Mapping[int, str], attributes: Attributes
    ) -> None:
        self._root = root
        self._key = key
        self._names = names
        self._attributes = attributes

    def derivatives(self, section: str) -> VariableDependencies:
        """Return the derivatives, as ``unknowns``; each must be a variable, as they are counted."""
        return self._read(section, self._attributes.problems)

    def unknowns(self, section: str) -> VariableDependencies:
        """Return the unknowns of a section, and what each depends on."""
        return self._read(section, self._attributes.warnings)

    def _read(self, section: str, findings: list[str]) -> VariableDependencies:
        where = f"ModelStructure/{section}"
        unknowns: dict[str, tuple[str, ...] | None] = {}
        for element in self._root.iterfind(where):
            name = self._names.get(self._number(element))
            if name is None:
                found = shortened(element.get(self._key, ""))
                findings.append(f"{where}: {self._key}={found} is no variable")
                continue
            which = f"{where} {name!r}"
            dependencies = known_names(element, self._names, which, self._attributes)
            if unknowns.setdefault(name, dependencies) != dependencies:
                unknowns[name] = None  # listed twice, with two meanings
        return unknowns

    def _number(self, element: Element) -> int:
        """Return which variable an unknown is; -1, which is none, where that is no number."""
        with suppress(ValueError):
            return whole(element.get(self._key, ""))
        return -1


def known_names(
    element: Element, names: Mapping[int, str], where: str, attributes: Attributes
) -> tuple[str, ...] | None:
    """Return the names of what an unknown depends on; None: not declared, or not clearly."""
    text = element.get("dependencies")
    if text is None:
        return None
    try:
        numbers = integers(text)
    except ValueError:
        attributes.warnings.append(f"{where}: dependencies: expected integers, got {quoted(text)}")
        return None
    missing = [str(number) for number in numbers if number not in names]
    if missing:
        attributes.warnings.append(f"{where}: dependencies name no variable: {listing(missing)}")
        return None
    return tuple(names[number] for number in numbers)


def name_states(
    derivatives: VariableDependencies, named: Mapping[str, Variable], attributes: Attributes
) -> tuple[tuple[str, ...], int]:
    """Return the names of the states, in the order of the derivatives.

    A derivative that names no state has one all the same. Where there is such a one, no state is
    named, as the order would be lost: returned are no names, and the number of state elements.
    """
    states = []
    unnamed = []
    for name in derivatives:
        state = named[name].derivative_of
        if state is None:
            unnamed.append(name)
        else:
            states.append(state)
    if not unnamed:
        return tuple(states), 0
    attributes.warnings.append(
        f"{listing(unnamed)}: listed as a derivative, without an attribute derivative that names "
        "its state; so no state is known by its name, and none is recorded as one"
    )
    return (), sum(named[name].size for name in derivatives)
