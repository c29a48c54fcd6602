"""What the standard says of a modelDescription.xml beyond its schema, for FMI 2 and 3; and what is to be known of FMI 1.

FMI 2.0.4 sections 2.2.7 and 2.2.8, FMI 3.0 sections 2.4.7 and 2.4.8. An error is what no importer can rely on; a warning what is
against the standard, and does no harm here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Final, Literal, NamedTuple, TypeAlias
from xml.etree.ElementTree import Element

from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description
from cosim.fmi.reading.dae import MANIFEST
from cosim.fmi.reading.variables import FLOATS, Definitions, major
from cosim.fmi.variable import Variable

Severity: TypeAlias = Literal["error", "warning", "note"]


class Finding(NamedTuple):
    """Something that a check found.

    level: "error", "warning" or "note". where: archive, XML, structure, a variable, a binary, a trial. text: what was found, what
    was needed.
    """

    level: Severity
    where: str
    text: str


_CALCULATED: set[tuple[str, str | None]] = {
    (v, i) for v in ("fixed", "tunable") for i in ("calculated", "approx")
}
_MOVING: set[tuple[str, str | None]] = {
    (v, i) for v in ("discrete", "continuous") for i in ("calculated", "exact", "approx")
}
ALLOWED: Final[Mapping[str, set[tuple[str, str | None]]]] = {
    "parameter": {("fixed", "exact"), ("tunable", "exact")},
    "structuralParameter": {("fixed", "exact"), ("tunable", "exact")},
    "calculatedParameter": _CALCULATED,
    "input": {("discrete", "exact"), ("continuous", "exact")},
    "output": {("constant", "exact")} | _MOVING,
    "local": {("constant", "exact")} | _CALCULATED | _MOVING,
    "independent": {("continuous", None)},
}
_IDENTIFIER = r"(?:[A-Za-z_][A-Za-z_0-9]*|'(?:[^'\\]|\\.)+')(?:\[\d+(?:,\d+)*\])?"
_PATH = rf"{_IDENTIFIER}(?:\.{_IDENTIFIER})*"
STRUCTURED: Final = re.compile(rf"{_PATH}|der\({_PATH}(?:,\d+)?\)")


def findings(root: Element, description: Description, definitions: Definitions) -> list[Finding]:
    """Give everything that is wrong or worth knowing."""
    found = list(_notes(description))
    if major(root) == 1:
        return found + list(_negated(root))
    elements = _elements(root)
    for variable in description.variables:
        where = f"variable {variable.name!r}"
        element = elements.get(variable.alias_of or variable.name, root)
        checks = (_roles, _start, _range, _references)
        found += [
            Finding(level, where, text)
            for check in checks
            for level, text in check(variable, element, definitions)
        ]
    found += [Finding(level, where, text) for where, level, text in _structure(root, description)]
    found += list(_residual_form(description))
    return found + list(_names(root, description))


def _elements(root: Element) -> dict[str, Element]:
    """Give the element with the attributes of each variable's type by name."""
    elements = root.iterfind("ModelVariables/*")
    if major(root) == 3:
        return {element.get("name", ""): element for element in elements}
    return {
        e.get("name", ""): _merged(e, next((c for c in e if c.tag != "Annotations"), e))
        for e in elements
    }


def _merged(outer: Element, inner: Element) -> Element:
    return Element(inner.tag, dict(outer.attrib) | dict(inner.attrib))


Checked: TypeAlias = Iterator[tuple[Severity, str]]


def _roles(variable: Variable, element: Element, definitions: Definitions) -> Checked:
    here = (variable.variability, variable.initial)
    if here not in ALLOWED.get(variable.causality, set()):
        yield (
            "error",
            f"causality {variable.causality}, variability {here[0]} and initial {here[1]} do not go together",
        )
    if element.get("variability") == "continuous" and variable.type not in FLOATS:
        yield (
            "warning",
            f"variability continuous, which a variable of type {element.tag} cannot have",
        )
    if variable.causality == "structuralParameter" and variable.dimensions:
        yield "error", "a structural parameter is no array"


def _start(variable: Variable, element: Element, definitions: Definitions) -> Checked:
    given = element.get("start") is not None or element.find("Start") is not None
    needed = variable.initial in ("exact", "approx") or variable.variability == "constant"
    if needed and not given and variable.type != "Clock":
        yield (
            "error",
            f"has no start value, which causality {variable.causality} with initial {variable.initial} needs",
        )
    if given and (variable.initial == "calculated" or variable.causality == "independent"):
        yield "warning", "has a start value, which nothing uses: it is calculated"
    if variable.start is None:
        return
    if any(math.isnan(value) for value in variable.start):
        yield "error", "start value: found nan, needed a number"
    outside = [
        value for value in variable.start if value < variable.minimum or value > variable.maximum
    ]
    if outside:
        yield (
            "error",
            f"start value: found {outside[0]:g}, needed {variable.minimum:g} to {variable.maximum:g}",
        )
    items = variable.items.values()
    if items and not set(variable.start) <= {float(item) for item in items}:
        yield (
            "error",
            f"start value: found {variable.start[0]:g}, needed one of {', '.join(map(str, items))}",
        )


def _range(variable: Variable, element: Element, definitions: Definitions) -> Checked:
    if not variable.minimum <= variable.maximum:
        yield "error", f"min {variable.minimum:g} is above max {variable.maximum:g}"
    if variable.nominal is not None and not (
        math.isfinite(variable.nominal) and variable.nominal != 0.0
    ):
        yield (
            "warning",
            f"nominal: found {variable.nominal:g}, needed a finite number that is not 0",
        )


def _references(variable: Variable, element: Element, definitions: Definitions) -> Checked:
    declared = element.get("declaredType")
    if declared is not None and declared not in definitions.types:
        yield "error", f"declaredType {declared!r} is not defined"
    if element.tag == "Enumeration" and not variable.items:
        yield "error", "is an enumeration without items"
    if variable.unit is not None and variable.unit not in definitions.units:
        yield (
            "warning",
            f"unit {variable.unit!r} is not defined in UnitDefinitions; it is understood by its name",
        )


def _structure(root: Element, description: Description) -> Iterator[tuple[str, Severity, str]]:
    """Check ModelStructure: who is listed, and what may be depended on."""
    version = major(root)
    sections = {
        "outputs": ("Outputs/Unknown", "Output"),
        "derivatives": ("Derivatives/Unknown", "ContinuousStateDerivative"),
        "initial unknowns": ("InitialUnknowns/Unknown", "InitialUnknown"),
    }
    names: Mapping[str, str]
    if version == 2:
        names = {str(number): v.name for number, v in enumerate(description.variables, 1)}
    else:
        names = {str(v.reference): v.name for v in description.variables if v.alias_of is None}
    expected = _expected(description, root)
    for where, paths in sections.items():
        path = f"ModelStructure/{paths[version - 2]}"
        unknowns = root.findall(path)
        listed = [
            names.get(u.get("index" if version == 2 else "valueReference", "").strip(), "")
            for u in unknowns
        ]
        if len(set(listed)) < len(listed):
            twice = sorted({name for name in listed if listed.count(name) > 1})
            yield where, "error", f"listed twice: {', '.join(twice)}"
        for unknown in unknowns:
            kinds, known = unknown.get("dependenciesKind"), unknown.get("dependencies")
            if kinds is not None and (known is None or len(kinds.split()) != len(known.split())):
                yield where, "error", "dependenciesKind needs as many entries as dependencies"
        if where in expected:
            yield from _listing(where, set(listed) - {""}, expected[where])
    yield from _knowns(description)
    for name in description.states:
        if description[name].type not in FLOATS or description[name].variability != "continuous":
            yield f"variable {name!r}", "error", "is a state, and so must be real and continuous"


def _expected(description: Description, root: Element) -> dict[str, set[str]]:
    variables = [v for v in description.variables if v.alias_of is None]
    clocked = {
        element.get("name")
        for element in root.iterfind("ModelVariables/*")
        if element.get("clocks") is not None
    }
    derivatives = {
        name for name in description.dependencies if description[name].derivative_of is not None
    }
    start = {*description.states, *derivatives} & {
        v.name for v in variables if v.initial in ("approx", "calculated")
    }
    for v in variables:
        of_output = (
            v.causality == "output"
            and v.initial in ("approx", "calculated")
            and v.name not in clocked
        )
        if of_output or v.causality == "calculatedParameter":
            start.add(v.name)
    return {
        "outputs": {v.name for v in variables if v.causality == "output"},
        "initial unknowns": start,
    }


def _listing(
    where: str, listed: set[str], expected: set[str]
) -> Iterator[tuple[str, Severity, str]]:
    level: Severity = "error" if where == "outputs" else "warning"
    if missing := expected - listed:
        yield where, level, f"not listed: {', '.join(sorted(missing))}"
    if where == "outputs" and (extra := listed - expected):
        yield where, level, f"listed, and no output: {', '.join(sorted(extra))}"
    elif extra := listed - expected:
        yield where, level, f"listed, and known at the start: {', '.join(sorted(extra))}"


def _knowns(description: Description) -> Iterator[tuple[str, Severity, str]]:
    """Check what outputs, derivatives and initial unknowns depend on."""
    always = ("input", "independent", "parameter", "structuralParameter")
    later = {
        v.name
        for v in description.variables
        if v.causality in always or v.variability == "discrete"
    } | set(description.states)
    first = {v.name for v in description.variables if v.causality in always or v.initial == "exact"}
    for dependencies, known, when in (
        (description.dependencies, later, "neither an input, a parameter, a state nor the time"),
        (
            description.initial_dependencies,
            first,
            "neither an input, a parameter, a start value that is exact nor the time",
        ),
    ):
        for name, needs in dependencies.items():
            wrong = [need for need in needs or () if need not in known and need != name]
            if wrong:
                yield f"variable {name!r}", "warning", f"depends on {', '.join(wrong)}: {when}"


def _residual_form(description: Description) -> Iterator[Finding]:
    """Check the manifest of FMI-LS-DAE: the FMU runs without it, but not in the form that it promises."""
    dae = description.dae
    if dae is None:
        return
    for problem in dae.problems:
        yield Finding("error", MANIFEST, problem)
    if not dae.problems and not (dae.algebraic and dae.residuals):
        yield Finding(
            "warning",
            MANIFEST,
            "lists no AlgebraicVariables or no Residual, so that the residual form is not known",
        )


def _names(root: Element, description: Description) -> Iterator[Finding]:
    structured = root.get("variableNamingConvention") == "structured"
    for variable in description.variables:
        where = f"variable {variable.name!r}"
        if any(letter < " " for letter in variable.name):
            yield Finding("warning", where, "has a control character in its name")
        elif structured and not STRUCTURED.fullmatch(variable.name):
            yield Finding(
                "warning",
                where,
                "is no name of the structured naming convention that the file announces",
            )
    if major(root) < 3:
        return
    clocks = sum(v.causality == "independent" for v in description.variables)
    if clocks != 1:
        yield Finding(
            "warning",
            "structure",
            f"{clocks} independent variables; FMI 3 needs exactly one, the time",
        )
    owners: dict[int, str] = {}
    for variable in description.variables:
        other = owners.setdefault(variable.reference, variable.name)
        if variable.alias_of is None and other != variable.name:
            text = f"has the value reference {variable.reference} of {other!r}; FMI 3 needs one for each"
            yield Finding("error", f"variable {variable.name!r}", text)


def _notes(description: Description) -> Iterator[Finding]:
    """Say what is to be known before a run."""
    if not description.capabilities:
        yield Finding(
            "error", "XML", "neither model exchange nor co-simulation; needed one of them"
        )
    outputs = (
        v.name
        for v in description.variables
        if v.causality == "output" and v.is_signal and v.alias_of is None
    )
    unknown = [
        name
        for name in outputs
        if name not in description.states and description.dependencies.get(name) is None
    ]
    if unknown and any(v.causality == "input" for v in description.variables):
        yield Finding(
            "note",
            "structure",
            f"the file does not say on which inputs these depend directly: {', '.join(unknown)}",
        )
    if description.clocks:
        yield Finding(
            "warning",
            "structure",
            f"clocks, which are not supported: {', '.join(description.clocks)}",
        )
    for interface_type, able in description.capabilities.items():
        if able.needs_tool:
            yield Finding(
                "note",
                INTERFACE_TYPE_NAMES[interface_type],
                "needs the tool that made it, or its libraries, to run",
            )
        if able.once_per_process:
            yield Finding(
                "note",
                INTERFACE_TYPE_NAMES[interface_type],
                "can be instantiated only once in a process",
            )


def _negated(root: Element) -> Iterator[Finding]:
    for element in root.iterfind("ModelVariables/ScalarVariable"):
        if element.get("alias") == "negatedAlias":
            port = element.get("causality") in ("input", "output")
            text = (
                "is another variable negated (negatedAlias); no call gives that, and it is left out"
            )
            yield Finding("warning" if port else "note", f"variable {element.get('name')!r}", text)
