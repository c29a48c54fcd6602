"""Read units, types and variables of a modelDescription.xml of any FMI version.

FMI 1.0 section 3.2; FMI 2.0.4 sections 2.2.2, 2.2.3 and 2.2.7; FMI 3.0 sections 2.4.3 to 2.4.7.

A second name of FMI 3 (Alias) becomes a variable with the reference of the first. In FMI 1 an
``alias`` is a variable like others that shares its reference, and a ``negatedAlias`` is the
opposite of what the reference has. Of inputs with one reference the first is the input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, cast
from xml.etree.ElementTree import Element

from cosim.errors import listing
from cosim.fmi.reading.clocks import read_timing, with_clocks
from cosim.fmi.reading.markup import Attributes, Value, flag
from cosim.fmi.variable import Initial, Variable, VariableType, is_exact
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
    display_units : mapping of name of a unit to names
    types : mapping of name to Element
        With the attributes that a variable takes where it has none of its own.
    """

    units: Mapping[str, BaseUnit | None] = field(default_factory=dict)
    display_units: Mapping[str, frozenset[str]] = field(default_factory=dict)
    types: Mapping[str, Element] = field(default_factory=dict)


def major(root: Element) -> int:
    """Return the major FMI version, which is known to be 1, 2 or 3."""
    return int(root.get("fmiVersion", "")[0])


# --- units and types ---


def read_definitions(root: Element, attributes: Attributes) -> Definitions:
    """Read UnitDefinitions and TypeDefinitions."""
    version = major(root)
    units: list[tuple[str, BaseUnit | None]] = []
    display_units: dict[str, frozenset[str]] = {}
    if version == 1:
        # The names of base units say what they are; all else is for display.
        for element in root.iterfind("UnitDefinitions/BaseUnit"):
            name = element.get("unit", "")
            units.append((name, base_unit(name)))
    else:
        for element in root.iterfind("UnitDefinitions/Unit"):
            name = element.get("name", "")
            units.append((name, _read_unit(element, attributes)))
            display = element.iterfind("DisplayUnit")
            display_units[name] = frozenset(unit.get("name", "") for unit in display)
    for name in _ambiguous(units):
        attributes.problems.append(f"two units with the name {name!r}")
    types: dict[str, Element] = {}
    for element in root.iterfind("TypeDefinitions/*"):
        typed = element if version == 3 else next(iter(element), element)
        types[element.get("name", "")] = typed
    return Definitions(dict(units), display_units, types)


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


def _ambiguous(units: Sequence[tuple[str, BaseUnit | None]]) -> list[str]:
    """Return the names of units that are defined twice, and not the same each time."""
    definitions = dict(units)
    return list(dict.fromkeys(name for name, unit in units if unit != definitions[name]))


# --- variables ---


def read_variables(
    root: Element, definitions: Definitions, attributes: Attributes
) -> tuple[Variable, ...]:
    """Read ModelVariables, in the order of the file; aliases of FMI 3 stand behind all others."""
    version = major(root)
    reader = _VariableReader(version, definitions, attributes)
    elements = list(root.iterfind("ModelVariables/*"))
    variables = [reader.variable(element) for element in elements]
    if version == 3:
        # All variables come before the first size, which may be a structural parameter's value.
        variables = _with_sizes(variables, elements, attributes)
        variables = with_clocks(variables, reader.clocks, attributes)
    else:
        variables = _with_one_input_each(variables)
    return _with_derivatives(_with_own_names(variables, attributes), reader, attributes)


class _Roles(NamedTuple):
    """What many variables have in common, and is read once."""

    type: VariableType
    causality: str
    variability: str
    initial: Initial | None
    unit: str | None
    base: BaseUnit | None
    minimum: float
    maximum: float
    nominal: float | None
    items: Mapping[str, int]


class _VariableReader:
    """Reads one variable after the other.

    Attributes
    ----------
    derivatives : dict of position to int
        The attribute ``derivative`` of the variables that have it, by their positions from 0.
    clocks : dict of position to tuple of int
        The attribute ``clocks`` (FMI 3), likewise.
    version : int
    """

    def __init__(self, version: int, definitions: Definitions, attributes: Attributes) -> None:
        self.derivatives: dict[int, int] = {}
        self.clocks: dict[int, tuple[int, ...]] = {}
        self.version = version
        self._definitions = definitions
        self._attributes = attributes
        self._roles: dict[tuple[str | None, ...], _Roles] = {}
        self._count = 0

    def variable(self, element: Element) -> Variable:
        """Read a variable, as yet without its size and without what it is the derivative of."""
        version = self.version
        attributes = self._attributes
        typed = typed_element(element, version)
        name = attributes.text(element, "name", "a variable")
        where = f"variable {name!r}"
        roles = self._roles_of(element, typed, where)
        derivative = attributes.integer(typed, "derivative", where)
        if derivative is not None and version > 1:
            self.derivatives[self._count] = derivative
        if version == 3:
            clocks = attributes.integers(element, "clocks", where)
            if clocks:
                self.clocks[self._count] = clocks
        self._count += 1
        start = None
        text = None
        timing = None
        if roles.type in ("String", "Binary"):
            text = self._text(typed, roles.type, where)
        elif roles.type == "Clock":
            declared = self._declared(element)
            timing = read_timing(element, declared, attributes, where)
        else:
            start = self._start(typed, roles, where)
        return Variable(
            name=name,
            reference=attributes.reference(element, "valueReference", where),
            causality=roles.causality,
            type=roles.type,
            variability=roles.variability,
            initial=roles.initial,
            unit=roles.unit,
            base=roles.base,
            start=start,
            text=text,
            minimum=roles.minimum,
            maximum=roles.maximum,
            nominal=roles.nominal,
            items=roles.items,
            inside_steps=version < 3 or flag(element, "intermediateUpdate"),
            negated=version == 1 and element.get("alias") == "negatedAlias",
            timing=timing,
            doc=element.get("description", ""),
        )

    def _roles_of(self, element: Element, typed: Element, where: str) -> _Roles:
        """Return what the attributes say that many variables share; ``where`` names the first."""
        get = typed.get
        key = (
            *(typed.tag, element.get("causality"), element.get("variability")),
            *(element.get("initial"), get("declaredType"), get("unit"), get("relativeQuantity")),
            *(get("min"), get("max"), get("nominal"), get("fixed")),
            "" if self.version == 1 and get("start") is not None else None,
        )
        roles = self._roles.get(key)
        if roles is None:
            roles = self._read_roles(element, typed, where)
            self._roles[key] = roles
        return roles

    def _read_roles(self, element: Element, typed: Element, where: str) -> _Roles:
        version = self.version
        known_type = (TYPES_3 if version == 3 else TYPES).get(typed.tag)
        if known_type is None:
            self._attributes.problems.append(f"{where}: its type is none of FMI {version}")
        declared = self._declared(typed)
        minimum = self._limit(typed, declared, "min", where)
        maximum = self._limit(typed, declared, "max", where)
        unit = typed.get("unit", declared.get("unit"))
        read = _read_roles_1 if version == 1 else _read_roles
        causality, variability, initial = read(element, typed, known_type in FLOATS)
        return _Roles(
            type=known_type or "Float64",
            causality=causality,
            variability=variability,
            initial=initial,
            unit=unit,
            base=self._base(unit, typed, declared),
            minimum=-math.inf if minimum is None else minimum,
            maximum=math.inf if maximum is None else maximum,
            nominal=self._limit(typed, declared, "nominal", where),
            items=self._items(declared) if typed.tag == "Enumeration" else {},
        )

    def _declared(self, typed: Element) -> Element:
        """Return the type that a variable declares; an empty one where it declares none."""
        return self._definitions.types.get(typed.get("declaredType", ""), Element("none"))

    def _limit(self, typed: Element, declared: Element, key: str, where: str) -> float | None:
        """Return min, max or nominal; one that is no number is left out, with a warning."""
        source = declared if typed.get(key) is None else typed
        return self._attributes.optional_number(source, key, where)

    def _base(self, unit: str | None, typed: Element, declared: Element) -> BaseUnit | None:
        """Return what a unit is in SI; a relative quantity has no offset."""
        base = self._definitions.units.get(unit or "")
        source = declared if typed.get("relativeQuantity") is None else typed
        if base is not None and flag(source, "relativeQuantity"):
            return replace(base, offset=0.0)
        return base

    def _start(self, typed: Element, roles: _Roles, where: str) -> tuple[float, ...] | None:
        """Return start values that float64 carries exactly; any other is left to the FMU."""
        start = typed.get("start")
        if start is None:
            return None
        values = self._start_values(start, typed, roles, where)
        if values is not None and self.version < 3 and len(values) != 1:
            _check_start_count(values, 1, where, self._attributes)
        return values

    def _start_values(
        self, start: str, typed: Element, roles: _Roles, where: str
    ) -> tuple[float, ...] | None:
        if roles.type in (*FLOATS, "Boolean"):
            values = self._attributes.numbers(start, f"{where}: start")
            if values is not None and any(map(math.isnan, values)):
                self._attributes.report(f"{where}: start", "nan", "a number")
                return None
            return values
        numbers = self._attributes.integers(typed, "start", where)
        if numbers is None or not all(map(is_exact, numbers)):
            return None
        return tuple(map(float, numbers))

    def _items(self, declared: Element) -> dict[str, int]:
        """Return the items of an enumeration; in FMI 1 they count from 1."""
        where = f"type {declared.get('name', 'Enumeration')!r}: item"
        items: dict[str, int] = {}
        for position, item in enumerate(declared.findall("Item"), 1):
            value = position
            if self.version > 1:
                value = self._attributes.integer(item, "value", where) or 0
            items[item.get("name", "")] = value
        return items

    def _text(
        self, typed: Element, variable_type: VariableType, where: str
    ) -> tuple[str, ...] | None:
        if self.version < 3:
            values = [typed.get("start")]
        else:
            values = [start.get("value") for start in typed.iterfind("Start")]
        texts = tuple(text for text in values if text is not None)
        if variable_type == "Binary" and not all(_is_hexadecimal(text) for text in texts):
            self._attributes.problems.append(
                f"{where}: start: expected hexadecimal digits, two for each byte"
            )
            return None
        return texts or None


def typed_element(element: Element, version: int) -> Element:
    """Return the element with the attributes of a variable's type: before FMI 3, a child."""
    if version < 3:
        for child in element:
            if child.tag in TYPES:
                return child
    return element


def _is_hexadecimal(text: str) -> bool:
    try:
        bytes.fromhex(text)
    except ValueError:
        return False
    return True


def _read_roles(element: Element, typed: Element, is_real: bool) -> tuple[str, str, Initial | None]:
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


def _read_roles_1(
    element: Element, typed: Element, is_real: bool
) -> tuple[str, str, Initial | None]:
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


def _with_sizes(
    variables: Sequence[Variable], elements: Sequence[Element], attributes: Attributes
) -> list[Variable]:
    """Return the variables of FMI 3 with their sizes, and then their aliases."""
    by_reference = {variable.reference: variable for variable in variables}
    sized = []
    aliases: list[Variable] = []
    for without_size, element in zip(variables, elements, strict=True):
        variable = without_size
        if len(element) or variable.start is not None:
            variable = _with_size(without_size, element, by_reference, attributes)
            aliases += _aliases(variable, element)
        sized.append(variable)
    return sized + aliases


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
            attributes.report(f"{where}: Dimension", "none" if length is None else length, LENGTH)
            length = 1
        dimensions.append(length if parameter is None else parameter)
        size *= length
    start = _repeated(variable.start, size)
    text = _repeated(variable.text, size)
    if len(attributes.problems) == problems_before:
        _check_start_count(start, size, where, attributes)
        _check_start_count(text, size, where, attributes)
    if not dimensions:
        return variable
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


def _with_one_input_each(variables: list[Variable]) -> list[Variable]:
    """Return the variables; of several inputs with one reference, as aliases of the first.

    Each would be set to a value of its own. One that is not negated goes before the others.
    """
    inputs = [variable for variable in variables if variable.causality == "input"]
    inputs.sort(key=lambda variable: variable.negated)
    first_of = {(variable.type, variable.reference): variable for variable in reversed(inputs)}
    if len(first_of) == len(inputs):
        return variables
    completed = []
    for variable in variables:
        first = first_of.get((variable.type, variable.reference), variable)
        is_second = variable.causality == "input" and first is not variable
        completed.append(replace(variable, alias_of=first.name) if is_second else variable)
    return completed


def _with_own_names(variables: Sequence[Variable], attributes: Attributes) -> Sequence[Variable]:
    """Return the variables with names that no other has: of two with one name, the first keeps it.

    The others get a number: ``x#2``. One with the type and the reference of the first is the same
    variable, and so an alias.
    """
    first_of = {variable.name: variable for variable in reversed(variables)}
    if len(first_of) == len(variables):
        return variables
    names = set(first_of)
    renamed: list[Variable] = []
    shown = []
    for variable in variables:
        first = first_of[variable.name]
        if variable is first:
            renamed.append(variable)
            continue
        number = 2
        while f"{variable.name}#{number}" in names:
            number += 1
        name = f"{variable.name}#{number}"
        names.add(name)
        shown.append(repr(name))
        same = (variable.type, variable.reference) == (first.type, first.reference)
        alias_of = variable.alias_of or (first.name if same else None)
        renamed.append(replace(variable, name=name, alias_of=alias_of))
    attributes.warnings.append(
        f"variables have a name that another has before them, and are called: {listing(shown)}"
    )
    return renamed


def _with_derivatives(
    variables: Sequence[Variable], reader: _VariableReader, attributes: Attributes
) -> tuple[Variable, ...]:
    """Return the variables with the states that they are derivatives of.

    FMI 2 names a state by its position from 1, FMI 3 by its value reference, which is that of the
    first name and of its aliases.
    """
    if not reader.derivatives:
        return tuple(variables)
    if reader.version == 2:
        names = {position: variable.name for position, variable in enumerate(variables, 1)}
    else:
        # Reversed, so that the first name wins: aliases stand behind all others.
        names = {variable.reference: variable.name for variable in reversed(variables)}
    states: dict[str, str] = {}
    for position, number in reader.derivatives.items():
        name = variables[position].name
        if number in names:
            states[name] = names[number]
        else:
            where = f"variable {name!r}"
            attributes.problems.append(f"{where}: derivative={number} is no variable")
    completed = []
    for variable in variables:
        state = states.get(variable.alias_of or variable.name)
        completed.append(variable if state is None else replace(variable, derivative_of=state))
    return tuple(completed)
