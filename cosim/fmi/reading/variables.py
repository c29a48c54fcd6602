"""Read units, types and variables of a modelDescription.xml of any FMI version.

FMI 1.0 section 3.2; FMI 2.0.4 sections 2.2.2, 2.2.3 and 2.2.7; FMI 3.0 sections 2.4.3 to 2.4.7.

A second name of FMI 3 (Alias) becomes a variable with the reference of the first. In FMI 1 an ``alias`` is a variable like others
that shares its reference; a ``negatedAlias`` has the value of another negated, which no call gives, and is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, cast
from xml.etree.ElementTree import Element

from cosim.fmi.reading.markup import Attributes, Value, flag
from cosim.fmi.variable import LARGEST_EXACT, Initial, Variable, VariableType
from cosim.units import BASE, BaseUnit, base_unit

LARGEST_ARRAY: Final = 2**24  # elements
FLOATS: Final = ("Float32", "Float64")
TYPES: Final[Mapping[str, VariableType]] = {  # elements of FMI 3 have the name of their type
    "Real": "Float64", "Integer": "Int32", "Enumeration": "Int32", "Boolean": "Boolean", "String": "String",
}  # fmt: skip
TYPES_3: Final[Mapping[str, VariableType]] = {
    "Float64": "Float64", "Float32": "Float32", "Int8": "Int8", "UInt8": "UInt8", "Int16": "Int16", "UInt16": "UInt16",
    "Int32": "Int32", "UInt32": "UInt32", "Int64": "Int64", "UInt64": "UInt64", "Enumeration": "Int64", "Boolean": "Boolean",
    "String": "String", "Binary": "Binary", "Clock": "Clock",
}  # fmt: skip
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
    """Give the major FMI version, which is known to be 1, 2 or 3."""
    return int(root.get("fmiVersion", "")[0])


def read_definitions(root: Element, attributes: Attributes) -> Definitions:
    """Read UnitDefinitions and TypeDefinitions."""
    version = major(root)
    if version == 1:  # the names of base units say what they are; all else is for display
        units = [
            (u.get("unit", ""), base_unit(u.get("unit", "")))
            for u in root.iterfind("UnitDefinitions/BaseUnit")
        ]
    else:
        units = [
            (u.get("name", ""), _base(u, attributes)) for u in root.iterfind("UnitDefinitions/Unit")
        ]
    for name in _twice(name for name, _ in units):
        attributes.problems.append(f"two units with the name {name!r}")
    types: dict[str, Element] = {}
    for element in root.iterfind("TypeDefinitions/*"):
        inner = element if version == 3 else next(iter(element), element)
        types[element.get("name", "")] = inner
    return Definitions(dict(units), types)


def _base(unit: Element, attributes: Attributes) -> BaseUnit | None:
    found = unit.find("BaseUnit")
    if found is None:
        return None
    where = f"unit {unit.get('name')!r}"
    exponents = tuple(attributes.integer(found, base, where) or 0 for base in BASE)
    factor, offset = (attributes.number(found, name, where) for name in ("factor", "offset"))
    if factor is not None and not (math.isfinite(factor) and factor != 0.0):
        attributes.problems.append(
            f"{where}: factor: found {factor}, needed a finite number that is not 0"
        )
        factor = None
    if offset is not None and not math.isfinite(offset):
        attributes.problems.append(f"{where}: offset: found {offset}, needed a finite number")
        offset = None
    return BaseUnit(exponents, 1.0 if factor is None else factor, offset or 0.0)


def read_variables(
    root: Element, definitions: Definitions, attributes: Attributes
) -> tuple[Variable, ...]:
    """Read ModelVariables, in the order of the file; second names of FMI 3 stand behind all others."""
    version = major(root)
    reader = _Reader(version, definitions, attributes)
    elements = list(root.iterfind("ModelVariables/*"))
    first = _sized([(element, reader.variable(element)) for element in elements], attributes)
    found = [
        variable
        for element, variable in first
        if version > 1 or element.get("alias") != "negatedAlias"
    ]
    found += [
        replace(
            variable,
            name=alias.get("name", ""),
            alias_of=variable.name,
            doc=alias.get("description", variable.doc),
        )
        for element, variable in first
        for alias in element.iterfind("Alias")
    ]
    for name in _twice(variable.name for variable in found):
        attributes.problems.append(f"two variables with the name {name!r}")
    return tuple(_with_states(elements, found, version, attributes))


def _twice(names: Iterator[str]) -> list[str]:
    seen: dict[str, int] = {}
    for name in names:
        seen[name] = seen.get(name, 0) + 1
    return [name for name, count in seen.items() if count > 1]


class _Reader:
    """Reads one variable after the other."""

    def __init__(self, version: int, definitions: Definitions, attributes: Attributes) -> None:
        self._version, self._definitions, self._attributes = version, definitions, attributes

    def variable(self, element: Element) -> Variable:
        """Read a variable, as yet without its size and without what it is the derivative of."""
        attributes, version = self._attributes, self._version
        value = (
            element
            if version == 3
            else next((child for child in element if child.tag in TYPES), element)
        )
        name = attributes.text(element, "name", "a variable")
        where = f"variable {name!r}"
        kind = (TYPES_3 if version == 3 else TYPES).get(value.tag)
        if kind is None:
            attributes.problems.append(f"{where}: its type is none of FMI {version}")
        declared = self._definitions.types.get(value.get("declaredType", ""), Element("none"))
        low, high, nominal = (
            self._number(value, declared, key, where) for key in ("min", "max", "nominal")
        )
        unit = value.get("unit", declared.get("unit"))
        causality, variability, initial = (_roles_1 if version == 1 else _roles)(
            element, value, kind in FLOATS
        )
        return Variable(
            name=name,
            reference=attributes.reference(element, "valueReference", where),
            causality=causality,
            type=kind or "Float64",
            variability=variability,
            initial=initial,
            unit=unit,
            base=self._unit(unit, value, declared),
            start=None if kind in ("String", "Binary", "Clock") else self._start(value, where),
            text=self._text(value, kind, where) if kind in ("String", "Binary") else None,
            minimum=-math.inf if low is None else low,
            maximum=math.inf if high is None else high,
            nominal=nominal,
            items=self._items(declared) if value.tag == "Enumeration" else {},
            inside_steps=self._version < 3 or flag(element, "intermediateUpdate"),
            doc=element.get("description", ""),
        )

    def _number(self, value: Element, declared: Element, key: str, where: str) -> float | None:
        return self._attributes.number(value if key in value.keys() else declared, key, where)

    def _unit(self, unit: str | None, value: Element, declared: Element) -> BaseUnit | None:
        base = self._definitions.units.get(unit or "")
        relative = flag(
            value if value.get("relativeQuantity") is not None else declared, "relativeQuantity"
        )
        return replace(base, offset=0.0) if base and relative else base

    def _start(self, value: Element, where: str) -> tuple[float, ...] | None:
        """Give what float64 can say exactly; an integer beyond that is left to the unit."""
        if value.tag in ("Real", "Boolean", *FLOATS):
            return self._attributes.numbers(value.get("start"), f"{where}: start")
        found = self._attributes.integers(value, "start", where)
        return (
            None
            if found is None or any(abs(n) > LARGEST_EXACT for n in found)
            else tuple(map(float, found))
        )

    def _items(self, declared: Element) -> dict[str, int]:
        """Give the items of an enumeration; in FMI 1 they count from 1."""
        items = declared.findall("Item")
        if self._version == 1:
            return {item.get("name", ""): number for number, item in enumerate(items, 1)}
        where = f"type {declared.get('name', 'Enumeration')!r}: item"
        return {
            item.get("name", ""): self._attributes.integer(item, "value", where) or 0
            for item in items
        }

    def _text(self, value: Element, kind: str, where: str) -> tuple[str, ...] | None:
        found = (
            (value.get("start"),)
            if self._version < 3
            else tuple(start.get("value") for start in value.iterfind("Start"))
        )
        texts = tuple(text for text in found if text is not None)
        if kind == "Binary" and not all(_is_hexadecimal(text) for text in texts):
            self._attributes.problems.append(
                f"{where}: start: needed hexadecimal digits, two for every byte"
            )
            return None
        return texts or None


def _is_hexadecimal(text: str) -> bool:
    try:
        bytes.fromhex(text)
    except ValueError:
        return False
    return True


def _roles(element: Element, value: Element, is_real: bool) -> tuple[str, str, Initial | None]:
    """Give causality, variability and initial, the standard's where the file says none (FMI 2.0.4 section 2.2.7)."""
    causality, parameter = (
        element.get("causality", "local"),
        ("parameter", "calculatedParameter", "structuralParameter"),
    )
    usual = "continuous" if is_real else "discrete"
    variability = element.get("variability") or (
        "fixed" if value is element and causality in parameter else usual
    )
    if not is_real and variability == "continuous":  # the default of FMI 2, whatever the type
        variability = "discrete"
    initial = element.get("initial")
    if initial is None and causality != "independent":
        initial = "calculated" if causality in CALCULATED and variability != "constant" else "exact"
    return (
        causality,
        variability,
        cast(Initial, initial) if initial in ("exact", "approx", "calculated") else None,
    )


def _roles_1(element: Element, value: Element, is_real: bool) -> tuple[str, str, Initial | None]:
    """Say in the words of FMI 2 what FMI 1 says with ``parameter``, ``internal``, ``none`` and ``fixed``."""
    causality = {"internal": "local", "none": "local"}.get(
        found := element.get("causality", "internal"), found
    )
    variability = element.get("variability", "continuous")
    if variability == "parameter":
        return "parameter", "fixed", "exact"
    if not is_real and variability == "continuous":
        variability = "discrete"
    if variability == "constant" or causality == "input":
        return causality, variability, "exact"
    if value.get("start") is None:
        return causality, variability, "calculated"
    return (
        causality,
        variability,
        "approx" if value.get("fixed", "true") in ("false", "0") else "exact",
    )


def _sized(
    first: list[tuple[Element, Variable]], attributes: Attributes
) -> list[tuple[Element, Variable]]:
    """Give arrays their sizes, and one start value to all their elements where there is but one."""
    by_reference = {variable.reference: variable for _, variable in first}
    found = []
    for element, variable in first:
        dimensions: list[int | str] = []
        size, known = 1, len(attributes.problems)
        for dimension in element.iterfind("Dimension"):
            where = f"variable {variable.name!r}: Dimension"
            length, reference = (
                attributes.integer(dimension, key, where) for key in ("start", "valueReference")
            )
            parameter = None if reference is None else by_reference.get(reference)
            if parameter is not None and parameter.start:
                length = int(parameter.start[0]) if math.isfinite(parameter.start[0]) else None
            if length is None or not 0 < length <= LARGEST_ARRAY or size * length > LARGEST_ARRAY:
                needed = f"needed a number or a structural parameter with one, at most {LARGEST_ARRAY} elements"
                attributes.problems.append(f"{where}: found size {length}, {needed}")
                length = 1
            dimensions.append(parameter.name if parameter is not None else length)
            size *= length
        start, text = _spread(variable.start, size), _spread(variable.text, size)
        attributes.problems += [
            f"variable {variable.name!r}: has {len(values)} start values for {size} element{'s' * (size > 1)}"
            for values in (start, text)
            if values is not None and len(values) != size and len(attributes.problems) == known
        ]
        found.append(
            (
                element,
                replace(variable, dimensions=tuple(dimensions), size=size, start=start, text=text),
            )
        )
    return found


def _spread(values: tuple[Value, ...] | None, size: int) -> tuple[Value, ...] | None:
    return values * size if values is not None and len(values) == 1 else values


def _with_states(
    elements: list[Element], found: list[Variable], version: int, attributes: Attributes
) -> list[Variable]:
    """Name the states of derivatives: FMI 2 by position from 1, FMI 3 by value reference."""
    if version == 1:
        return found
    names = (
        dict(enumerate((v.name for v in found), 1))
        if version == 2
        else {v.reference: v.name for v in reversed(found)}
    )
    states: dict[str, str] = {}
    for element, variable in zip(elements, found, strict=False):
        value = (
            element
            if version == 3
            else next((child for child in element if child.tag == "Real"), element)
        )
        number = attributes.integer(value, "derivative", f"variable {variable.name!r}")
        if number is not None and number not in names:
            attributes.problems.append(
                f"variable {variable.name!r}: derivative={number} is no variable"
            )
        elif number is not None:
            states[variable.name] = names[number]
    of = [states.get(variable.alias_of or variable.name) for variable in found]
    return [
        v if state is None else replace(v, derivative_of=state)
        for v, state in zip(found, of, strict=True)
    ]
