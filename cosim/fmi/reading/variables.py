"""Read units, types and variables of a modelDescription.xml of any FMI version.

FMI 1.0 section 3.2; FMI 2.0.4 sections 2.2.2, 2.2.3 and 2.2.7; FMI 3.0 sections 2.4.3 to 2.4.7.

A second name of FMI 3 (Alias) becomes a variable with the reference of the first. In FMI 1 an
``alias`` is a variable like others that shares its reference; a ``negatedAlias`` has the value of
another negated, which no call returns, and is left out.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, cast
from xml.etree.ElementTree import Element

from cosim.fmi.reading.markup import Attributes, Value, flag
from cosim.fmi.variable import LARGEST_EXACT, Initial, Variable, VariableType
from cosim.units import BASE, BaseUnit, base_unit

LARGEST_ARRAY: Final = 2**24  # elements
LENGTH: Final = f"a number or a structural parameter with one, at most {LARGEST_ARRAY} elements"
FLOATS: Final = ("Float32", "Float64")
TYPES: Final[Mapping[str, VariableType]] = {  # of FMI 1 and 2, by the name of the element
    "Real": "Float64",
    "Integer": "Int32",
    "Enumeration": "Int32",
    "Boolean": "Boolean",
    "String": "String",
}
TYPES_3: Final[Mapping[str, VariableType]] = {
    "Float64": "Float64",
    "Float32": "Float32",
    "Int8": "Int8",
    "UInt8": "UInt8",
    "Int16": "Int16",
    "UInt16": "UInt16",
    "Int32": "Int32",
    "UInt32": "UInt32",
    "Int64": "Int64",
    "UInt64": "UInt64",
    "Enumeration": "Int64",
    "Boolean": "Boolean",
    "String": "String",
    "Binary": "Binary",
    "Clock": "Clock",
}
PARAMETERS: Final = ("parameter", "calculatedParameter", "structuralParameter")
CALCULATED: Final = ("calculatedParameter", "output", "local")


@dataclass(frozen=True, slots=True)
class Definitions:
    """What variables refer to.

    Parameters
    ----------
    units : mapping of name to BaseUnit or None
        None: the file does not say what it is.
    types : mapping of name to Element
        With the attributes that a variable takes where it has none of its own.
    """

    units: Mapping[str, BaseUnit | None] = field(default_factory=dict)
    types: Mapping[str, Element] = field(default_factory=dict)


def major(root: Element) -> int:
    """Return the major FMI version, which is known to be 1, 2 or 3."""
    return int(root.get("fmiVersion", "")[0])


# --- units and types ---


def read_definitions(root: Element, attributes: Attributes) -> Definitions:
    """Read UnitDefinitions and TypeDefinitions."""
    version = major(root)
    units: list[tuple[str, BaseUnit | None]] = []
    if version == 1:
        # The names of base units say what they are; all else is for display.
        for element in root.iterfind("UnitDefinitions/BaseUnit"):
            name = element.get("unit", "")
            units.append((name, base_unit(name)))
    else:
        for element in root.iterfind("UnitDefinitions/Unit"):
            units.append((element.get("name", ""), _read_unit(element, attributes)))
    for name in _duplicates(name for name, _ in units):
        attributes.problems.append(f"two units with the name {name!r}")
    types: dict[str, Element] = {}
    for element in root.iterfind("TypeDefinitions/*"):
        typed = element if version == 3 else next(iter(element), element)
        types[element.get("name", "")] = typed
    return Definitions(dict(units), types)


def _read_unit(unit: Element, attributes: Attributes) -> BaseUnit | None:
    base = unit.find("BaseUnit")
    if base is None:
        return None
    where = f"unit {unit.get('name')!r}"
    exponents = tuple(attributes.integer(base, name, where) or 0 for name in BASE)
    factor = attributes.number(base, "factor", where)
    offset = attributes.number(base, "offset", where)
    if factor is None:
        factor = 1.0
    elif factor == 0.0 or not math.isfinite(factor):
        attributes.report(f"{where}: factor", factor, "a finite number that is not 0")
        factor = 1.0
    if offset is not None and not math.isfinite(offset):
        attributes.report(f"{where}: offset", offset, "a finite number")
        offset = None
    return BaseUnit(exponents, factor, offset or 0.0)


def _duplicates(names: Iterable[str]) -> list[str]:
    counts: dict[str, int] = {}
    for name in names:
        counts[name] = counts.get(name, 0) + 1
    return [name for name, count in counts.items() if count > 1]


# --- variables ---


def read_variables(
    root: Element, definitions: Definitions, attributes: Attributes
) -> tuple[Variable, ...]:
    """Read ModelVariables, in the order of the file; aliases of FMI 3 stand behind all others."""
    version = major(root)
    reader = _VariableReader(version, definitions, attributes)
    elements = list(root.iterfind("ModelVariables/*"))
    # All variables come before the first size, which may be a structural parameter's value.
    without_sizes = [reader.variable(element) for element in elements]
    by_reference = {variable.reference: variable for variable in without_sizes}
    variables: list[Variable] = []
    aliases: list[Variable] = []
    for element, without_size in zip(elements, without_sizes, strict=True):
        variable = _with_size(without_size, element, by_reference, attributes)
        if version > 1 or element.get("alias") != "negatedAlias":
            variables.append(variable)
        aliases += _aliases(variable, element)
    variables += aliases
    for name in _duplicates(variable.name for variable in variables):
        attributes.problems.append(f"two variables with the name {name!r}")
    if version == 1:
        return tuple(variables)
    return _with_derivatives(variables, elements, version, attributes)


class _VariableReader:
    """Reads one variable after the other."""

    def __init__(self, version: int, definitions: Definitions, attributes: Attributes) -> None:
        self._version = version
        self._definitions = definitions
        self._attributes = attributes

    def variable(self, element: Element) -> Variable:
        """Read a variable, as yet without its size and without what it is the derivative of."""
        version = self._version
        attributes = self._attributes
        typed = _typed(element, version, TYPES)
        name = attributes.text(element, "name", "a variable")
        where = f"variable {name!r}"
        known_type = (TYPES_3 if version == 3 else TYPES).get(typed.tag)
        if known_type is None:
            attributes.problems.append(f"{where}: its type is none of FMI {version}")
        variable_type = known_type or "Float64"
        declared_type = typed.get("declaredType", "")
        declared = self._definitions.types.get(declared_type, Element("none"))
        minimum = self._number(typed, declared, "min", where)
        maximum = self._number(typed, declared, "max", where)
        nominal = self._number(typed, declared, "nominal", where)
        unit = typed.get("unit", declared.get("unit"))
        roles = _roles_1 if version == 1 else _roles
        causality, variability, initial = roles(element, typed, known_type in FLOATS)
        reference = attributes.reference(element, "valueReference", where)
        text = self._text(typed, variable_type, where)
        start = self._start(typed, variable_type, where)
        items = self._items(declared) if typed.tag == "Enumeration" else {}
        return Variable(
            name=name,
            reference=reference,
            causality=causality,
            type=variable_type,
            variability=variability,
            initial=initial,
            unit=unit,
            base=self._base(unit, typed, declared),
            start=start,
            text=text,
            minimum=-math.inf if minimum is None else minimum,
            maximum=math.inf if maximum is None else maximum,
            nominal=nominal,
            items=items,
            inside_steps=version < 3 or flag(element, "intermediateUpdate"),
            doc=element.get("description", ""),
        )

    def _number(self, typed: Element, declared: Element, key: str, where: str) -> float | None:
        source = declared if typed.get(key) is None else typed
        return self._attributes.number(source, key, where)

    def _base(self, unit: str | None, typed: Element, declared: Element) -> BaseUnit | None:
        """Return what a unit is in SI; a relative quantity has no offset."""
        base = self._definitions.units.get(unit or "")
        source = declared if typed.get("relativeQuantity") is None else typed
        if base is not None and flag(source, "relativeQuantity"):
            return replace(base, offset=0.0)
        return base

    def _start(
        self, typed: Element, variable_type: VariableType, where: str
    ) -> tuple[float, ...] | None:
        """Return start values that float64 carries exactly; any other is left to the FMU."""
        if variable_type in ("String", "Binary", "Clock"):
            return None
        if typed.tag in ("Real", "Boolean", *FLOATS):
            return self._attributes.numbers(typed.get("start"), f"{where}: start")
        numbers = self._attributes.integers(typed, "start", where)
        if numbers is None:
            return None
        if any(abs(number) > LARGEST_EXACT for number in numbers):
            return None
        return tuple(float(number) for number in numbers)

    def _items(self, declared: Element) -> dict[str, int]:
        """Return the items of an enumeration; in FMI 1 they count from 1."""
        where = f"type {declared.get('name', 'Enumeration')!r}: item"
        items: dict[str, int] = {}
        for position, item in enumerate(declared.findall("Item"), 1):
            value = position
            if self._version > 1:
                value = self._attributes.integer(item, "value", where) or 0
            items[item.get("name", "")] = value
        return items

    def _text(
        self, typed: Element, variable_type: VariableType, where: str
    ) -> tuple[str, ...] | None:
        if variable_type not in ("String", "Binary"):
            return None
        if self._version < 3:
            values = [typed.get("start")]
        else:
            values = [start.get("value") for start in typed.iterfind("Start")]
        texts = tuple(text for text in values if text is not None)
        if variable_type == "Binary" and not all(_is_hexadecimal(text) for text in texts):
            self._attributes.problems.append(
                f"{where}: start: needed hexadecimal digits, two for every byte"
            )
            return None
        return texts or None


def _typed(element: Element, version: int, tags: Container[str]) -> Element:
    """Return the element with the attributes of a variable's type: before FMI 3, a child."""
    if version == 3:
        return element
    return next((child for child in element if child.tag in tags), element)


def _is_hexadecimal(text: str) -> bool:
    try:
        bytes.fromhex(text)
    except ValueError:
        return False
    return True


def _roles(element: Element, typed: Element, is_real: bool) -> tuple[str, str, Initial | None]:
    """Return causality, variability and initial, with their defaults (FMI 2.0.4 section 2.2.7)."""
    causality = element.get("causality", "local")
    variability = element.get("variability")
    if not variability:
        # Only in FMI 3, where the element itself has the type, are parameters fixed by default.
        is_fixed = typed is element and causality in PARAMETERS
        variability = "fixed" if is_fixed else "continuous"
    if variability == "continuous" and not is_real:
        # FMI 2 has this default whatever the type.
        variability = "discrete"
    return causality, variability, _initial(element, causality, variability)


def _initial(element: Element, causality: str, variability: str) -> Initial | None:
    initial = element.get("initial")
    if initial in ("exact", "approx", "calculated"):
        return cast(Initial, initial)
    if initial is not None or causality == "independent":
        return None
    is_calculated = causality in CALCULATED and variability != "constant"
    return "calculated" if is_calculated else "exact"


def _roles_1(element: Element, typed: Element, is_real: bool) -> tuple[str, str, Initial | None]:
    """Return in words of FMI 2 what FMI 1 says otherwise (parameter, internal, none, fixed)."""
    causality = element.get("causality", "internal")
    if causality in ("internal", "none"):
        causality = "local"
    variability = element.get("variability", "continuous")
    if variability == "parameter":
        return "parameter", "fixed", "exact"
    if not is_real and variability == "continuous":
        variability = "discrete"
    if variability == "constant" or causality == "input":
        return causality, variability, "exact"
    if typed.get("start") is None:
        return causality, variability, "calculated"
    is_guess = typed.get("fixed", "true") in ("false", "0")
    return causality, variability, "approx" if is_guess else "exact"


def _with_size(
    variable: Variable,
    element: Element,
    by_reference: Mapping[int, Variable],
    attributes: Attributes,
) -> Variable:
    """Return a variable with its dimensions, and with a single start value for all its elements."""
    where = f"variable {variable.name!r}"
    problems_before = len(attributes.problems)
    dimensions: list[int | str] = []
    size = 1
    for dimension in element.iterfind("Dimension"):
        length, parameter = _length(dimension, by_reference, f"{where}: Dimension", attributes)
        if length is None or not 0 < size * length <= LARGEST_ARRAY:
            attributes.report(f"{where}: Dimension", f"size {length}", LENGTH)
            length = 1
        dimensions.append(length if parameter is None else parameter)
        size *= length
    start = _repeated(variable.start, size)
    text = _repeated(variable.text, size)
    if len(attributes.problems) == problems_before:
        _check_start_count(start, size, where, attributes)
        _check_start_count(text, size, where, attributes)
    return replace(variable, dimensions=tuple(dimensions), size=size, start=start, text=text)


def _length(
    dimension: Element, by_reference: Mapping[int, Variable], where: str, attributes: Attributes
) -> tuple[int | None, str | None]:
    """Return the length of a dimension, and the name of the structural parameter that sets it."""
    length = attributes.integer(dimension, "start", where)
    reference = attributes.integer(dimension, "valueReference", where)
    parameter = None if reference is None else by_reference.get(reference)
    if parameter is None:
        return length, None
    if parameter.start:
        value = parameter.start[0]
        length = int(value) if math.isfinite(value) else None
    return length, parameter.name


def _check_start_count(
    values: tuple[object, ...] | None, size: int, where: str, attributes: Attributes
) -> None:
    if values is not None and len(values) != size:
        count = len(values)
        elements = "elements" if size > 1 else "element"
        attributes.problems.append(f"{where}: has {count} start values for {size} {elements}")


def _repeated(values: tuple[Value, ...] | None, size: int) -> tuple[Value, ...] | None:
    if values is None or len(values) != 1:
        return values
    return values * size


def _aliases(variable: Variable, element: Element) -> list[Variable]:
    """Return the other names of a variable."""
    aliases = []
    for alias in element.iterfind("Alias"):
        name = alias.get("name", "")
        doc = alias.get("description", variable.doc)
        aliases.append(replace(variable, name=name, alias_of=variable.name, doc=doc))
    return aliases


def _with_derivatives(
    variables: Sequence[Variable],
    elements: Sequence[Element],
    version: int,
    attributes: Attributes,
) -> tuple[Variable, ...]:
    """Return the variables with the states that they are derivatives of.

    FMI 2 names a state by its position from 1, FMI 3 by its value reference, which is that of the
    first name and of its aliases.
    """
    if version == 2:
        names = {position: variable.name for position, variable in enumerate(variables, 1)}
    else:
        # Reversed, so that the first name wins: aliases stand behind all others.
        names = {variable.reference: variable.name for variable in reversed(variables)}
    states: dict[str, str] = {}
    # Aliases have no element of their own, and end what is longer.
    for element, variable in zip(elements, variables, strict=False):
        where = f"variable {variable.name!r}"
        number = attributes.integer(_typed(element, version, ("Real",)), "derivative", where)
        if number is None:
            continue
        if number in names:
            states[variable.name] = names[number]
        else:
            attributes.problems.append(f"{where}: derivative={number} is no variable")
    completed = []
    for variable in variables:
        state = states.get(variable.alias_of or variable.name)
        completed.append(variable if state is None else replace(variable, derivative_of=state))
    return tuple(completed)
