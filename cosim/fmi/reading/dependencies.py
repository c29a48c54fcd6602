"""Read what depends on what: ModelStructure of FMI 2 and 3, DirectDependency of FMI 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from cosim.fmi.description import VariableDependencies
from cosim.fmi.reading.markup import Attributes
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
    outputs = {}
    for element in root.iterfind("ModelVariables/ScalarVariable"):
        direct = element.find("DirectDependency")
        if direct is not None:
            inputs = [(name.text or "").strip() for name in direct.iterfind("Name")]
            outputs[element.get("name", "")] = tuple(inputs)
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
    derivatives = reader.unknowns("Derivatives/Unknown")
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
    derivatives = reader.unknowns("ContinuousStateDerivative")
    initial = reader.unknowns("InitialUnknown")
    indicators = reader.unknowns("EventIndicator")
    count = sum(variable.size for variable in first_names if variable.name in indicators)
    return Structure(outputs, derivatives, initial, count, tuple(indicators))


def _count(root: Element, key: str, attributes: Attributes) -> int:
    number = attributes.integer(root, key, root.tag)
    if number is not None and not 0 <= number < 2**31:
        attributes.problems.append(f"found a count of {number}, needed one that is not negative")
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

    def unknowns(self, section: str) -> VariableDependencies:
        """Return the unknowns of a section, and what each depends on."""
        where = f"ModelStructure/{section}"
        unknowns = {}
        for element in self._root.iterfind(where):
            number = self._attributes.integer(element, self._key, where)
            if number is None or number not in self._names:
                found = element.get(self._key)
                self._attributes.problems.append(f"{where}: {self._key}={found} is no variable")
                continue
            name = self._names[number]
            which = f"{where} {name!r}"
            unknowns[name] = known_names(element, self._names, which, self._attributes)
        return unknowns


def known_names(
    element: Element, names: Mapping[int, str], where: str, attributes: Attributes
) -> tuple[str, ...] | None:
    """Return the names of what an unknown depends on; None: not declared."""
    numbers = attributes.integers(element, "dependencies", where)
    if numbers is None:
        return None
    missing = [str(number) for number in numbers if number not in names]
    if missing:
        attributes.problems.append(f"{where}: dependencies name no variable: {', '.join(missing)}")
    return tuple(names[number] for number in numbers if number in names)


def name_states(
    derivatives: VariableDependencies, named: Mapping[str, Variable], problems: list[str]
) -> tuple[str, ...]:
    """Return the names of the states, in the order of the derivatives."""
    states = []
    for name in derivatives:
        state = named[name].derivative_of
        if state is None:
            problems.append(
                f"{name!r} is listed as a derivative, but has no attribute derivative "
                "that names its state"
            )
        else:
            states.append(state)
    return tuple(states)
