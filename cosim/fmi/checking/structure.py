"""Check what the standard requires of a modelDescription.xml beyond its schema.

For FMI 2 and 3: FMI 2.0.4 sections 2.2.7 and 2.2.8, FMI 3.0 sections 2.4.7 and 2.4.8. Of FMI 1 only
what a user should know. An error is what no importer can rely on; a warning what is against the
standard, and does no harm here: what ModelStructure does not say is taken as unknown.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Final, Literal, NamedTuple, TypeAlias
from xml.etree.ElementTree import Element

from cosim.errors import listing
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description
from cosim.fmi.reading.dae import MANIFEST
from cosim.fmi.reading.variables import FLOATS, Definitions, major, typed_element
from cosim.fmi.variable import Variable

MOST_NAMES: Final = 100  # of variables in one finding

Severity: TypeAlias = Literal["error", "warning", "note"]


class Finding(NamedTuple):
    """Something that a check found.

    Parameters
    ----------
    level : {"error", "warning", "note"}
    where : str
        Archive, XML, structure, a variable, a binary, a trial.
    text : str
        What was found, what was expected.
    """

    level: Severity
    where: str
    text: str


VariableProblems: TypeAlias = Iterator[tuple[Severity, str]]
Combination: TypeAlias = tuple[str, str | None]  # variability, initial

_CALCULATED: Final[set[Combination]] = {
    ("fixed", "calculated"),
    ("fixed", "approx"),
    ("tunable", "calculated"),
    ("tunable", "approx"),
}
_SIGNAL: Final[set[Combination]] = {
    ("discrete", "calculated"),
    ("discrete", "exact"),
    ("discrete", "approx"),
    ("continuous", "calculated"),
    ("continuous", "exact"),
    ("continuous", "approx"),
}
ALLOWED: Final[Mapping[str, set[Combination]]] = {
    "parameter": {("fixed", "exact"), ("tunable", "exact")},
    "structuralParameter": {("fixed", "exact"), ("tunable", "exact")},
    "calculatedParameter": _CALCULATED,
    "input": {("discrete", "exact"), ("continuous", "exact")},
    "output": {("constant", "exact")} | _SIGNAL,
    "local": {("constant", "exact")} | _CALCULATED | _SIGNAL,
    "independent": {("continuous", None)},
}
"""By causality."""

NOTHING: Final[frozenset[Combination]] = frozenset()

SECTIONS: Final[Mapping[str, Mapping[int, str]]] = {
    "outputs": {2: "Outputs/Unknown", 3: "Output"},
    "derivatives": {2: "Derivatives/Unknown", 3: "ContinuousStateDerivative"},
    "initial unknowns": {2: "InitialUnknowns/Unknown", 3: "InitialUnknown"},
}
"""Of ModelStructure: the elements by major version."""

NO_INITIAL: Final = ("input", "independent")
ALWAYS_KNOWN: Final = ("input", "independent", "parameter", "structuralParameter")
NEVER_KNOWN: Final = "neither an input, a parameter, a state nor the time"
NEVER_KNOWN_INITIALLY: Final = (
    "neither an input, a parameter, a start value that is exact nor the time"
)

_IDENTIFIER = r"(?:[A-Za-z_][A-Za-z_0-9]*|'(?:[^'\\]|\\.)+')(?:\[\d+(?:,\d+)*\])?"
_PATH = rf"{_IDENTIFIER}(?:\.{_IDENTIFIER})*"
CONTROL: Final = re.compile("[\0-\x1f]")
STRUCTURED_NAME: Final = re.compile(rf"{_PATH}|der\({_PATH}(?:,\d+)?\)")


def check_structure(
    root: Element, description: Description, definitions: Definitions
) -> list[Finding]:
    """Return everything that is wrong or worth knowing."""
    findings = list(_check_support(description))
    if major(root) == 1:
        return findings
    elements = list(root.iterfind("ModelVariables/*"))
    # Aliases of FMI 3 stand behind all elements, and have none of their own.
    for variable, element in zip(description.variables, elements, strict=False):
        typed = typed_element(element, major(root))
        problems = chain(
            _check_variable(variable, element, typed),
            _check_definitions(variable, typed, definitions),
        )
        findings += [Finding(level, _where(variable.name), text) for level, text in problems]
    findings += _check_model_structure(root, description)
    findings += _check_residual_form(description)
    findings += _check_names(root, description)
    findings += _check_value_references(root, description)
    return findings


def _where(name: str | None) -> str:
    return f"variable {name!r}"


# --- variables ---


def _check_variable(variable: Variable, element: Element, typed: Element) -> VariableProblems:
    """Check one variable; ``typed`` has the attributes of its type."""
    yield from _check_causality(variable, element, typed)
    yield from _check_start_presence(variable, typed)
    if variable.start is not None:
        yield from _check_start_values(variable, variable.start)
    yield from _check_range(variable)


def _check_causality(variable: Variable, element: Element, typed: Element) -> VariableProblems:
    causality = variable.causality
    variability = variable.variability
    initial = variable.initial
    if causality in NO_INITIAL and element.get("initial") is not None:
        yield "warning", f"has the attribute initial, which causality {causality} must not have"
        initial = None if causality == "independent" else "exact"
    if (variability, initial) not in ALLOWED.get(causality, NOTHING):
        yield (
            "error",
            f"causality {causality}, variability {variability} and initial {initial} do not go "
            "together",
        )
    if variable.type not in FLOATS and element.get("variability") == "continuous":
        text = f"variability continuous, which a variable of type {typed.tag} cannot have"
        yield "warning", text
    if causality == "structuralParameter" and variable.dimensions:
        yield "error", "a structural parameter is no array"


def _check_start_presence(variable: Variable, element: Element) -> VariableProblems:
    causality = variable.causality
    initial = variable.initial
    has_start = element.get("start") is not None or element.find("Start") is not None
    needs_start = initial in ("exact", "approx") or variable.variability == "constant"
    if needs_start and not has_start and variable.type != "Clock":
        text = f"has no start value, which causality {causality} with initial {initial} needs"
        yield "error", text
    if has_start and (initial == "calculated" or causality == "independent"):
        yield "warning", "has a start value, which nothing uses: it is calculated"


def _check_start_values(variable: Variable, start: Sequence[float]) -> VariableProblems:
    low = variable.minimum
    high = variable.maximum
    outside = [value for value in start if value < low or value > high]
    if outside:
        yield "error", f"start value: expected {low:g} to {high:g}, got {outside[0]:g}"
    items = variable.items.values()
    if items and not set(start) <= {float(item) for item in items}:
        expected = ", ".join(map(str, items))
        yield "error", f"start value: expected one of {expected}, got {start[0]:g}"


def _check_range(variable: Variable) -> VariableProblems:
    low = variable.minimum
    high = variable.maximum
    nominal = variable.nominal
    if not low <= high:
        yield "error", f"min {low:g} is above max {high:g}"
    if nominal is not None and not 0.0 < nominal < math.inf:
        yield "warning", f"nominal: expected a finite number > 0, got {nominal:g}"


def _check_definitions(
    variable: Variable, element: Element, definitions: Definitions
) -> VariableProblems:
    declared_type = element.get("declaredType")
    if declared_type is not None and declared_type not in definitions.types:
        yield "error", f"declaredType {declared_type!r} is not defined"
    if element.tag == "Enumeration" and not variable.items:
        yield "error", "is an enumeration without items"
    unit = variable.unit
    if unit is not None and unit not in definitions.units:
        yield (
            "warning",
            f"unit {unit!r} is not defined in UnitDefinitions; it is understood by its name",
        )
    display_unit = element.get("displayUnit")
    if display_unit is not None and display_unit not in definitions.display_units.get(
        unit or "", ()
    ):
        yield "warning", f"displayUnit {display_unit!r} is not defined in unit {unit!r}"


# --- ModelStructure ---


def _check_model_structure(root: Element, description: Description) -> Iterator[Finding]:
    """Check ModelStructure: which variables are listed, and what they may depend on."""
    version = major(root)
    attribute = "index" if version == 2 else "valueReference"
    names = _names_by_key(version, description)
    expected = _expected_unknowns(description)
    for section, paths in SECTIONS.items():
        unknowns = root.findall(f"ModelStructure/{paths[version]}")
        listed = [names.get(unknown.get(attribute, "").strip(), "") for unknown in unknowns]
        counts = Counter(listed)
        duplicates = sorted(name for name, count in counts.items() if count > 1 and name)
        if duplicates:
            yield Finding("warning", section, f"listed twice: {listing(duplicates, MOST_NAMES)}")
        yield from _check_dependency_kinds(section, unknowns)
        if section in expected:
            yield from _compare_listed(section, set(listed) - {""}, expected[section])
    yield from _check_dependencies(description)
    yield from _check_states(description)


def _check_states(description: Description) -> Iterator[Finding]:
    for name in description.states:
        state = description[name]
        if state.type not in FLOATS or state.variability != "continuous":
            yield Finding("error", _where(name), "is a state, and so must be real and continuous")


def _names_by_key(version: int, description: Description) -> Mapping[str, str]:
    """Return names by what ModelStructure refers with: indices in FMI 2, value references in 3."""
    if version == 2:
        return {str(index): v.name for index, v in enumerate(description.variables, 1)}
    return {str(v.reference): v.name for v in description.variables if v.alias_of is None}


def _check_dependency_kinds(section: str, unknowns: Sequence[Element]) -> Iterator[Finding]:
    for unknown in unknowns:
        kinds = unknown.get("dependenciesKind")
        dependencies = unknown.get("dependencies")
        if kinds is None:
            continue
        if dependencies is None or len(kinds.split()) != len(dependencies.split()):
            text = "dependenciesKind needs as many entries as dependencies"
            yield Finding("warning", section, text)


def _expected_unknowns(description: Description) -> dict[str, set[str]]:
    """Return the variables that the standard wants listed, by section."""
    variables = [v for v in description.variables if v.alias_of is None]
    clocked = {v.name for v in variables if v.clocks or v.type == "Clock"}
    outputs = {v.name for v in variables if v.causality == "output"}
    dynamic = set(description.states)
    for name in description.dependencies:
        if description[name].derivative_of is not None:
            dynamic.add(name)
    candidates = dynamic | (outputs - clocked)
    initial_unknowns: set[str] = set()
    for variable in variables:
        is_computed = variable.initial in ("approx", "calculated")
        if is_computed and variable.name in candidates:
            initial_unknowns.add(variable.name)
        if variable.causality == "calculatedParameter":
            initial_unknowns.add(variable.name)
    return {"outputs": outputs, "initial unknowns": initial_unknowns}


def _compare_listed(section: str, listed: set[str], expected: set[str]) -> Iterator[Finding]:
    missing = sorted(expected - listed)
    if missing:
        text = f"not listed: {listing(missing, MOST_NAMES)}"
        yield Finding("warning", section, text)
    surplus = sorted(listed - expected)
    if surplus:
        reason = "and no output" if section == "outputs" else "although known initially"
        text = f"listed, {reason}: {listing(surplus, MOST_NAMES)}"
        yield Finding("warning", section, text)


def _check_dependencies(description: Description) -> Iterator[Finding]:
    """Check what outputs, derivatives and initial unknowns depend on."""
    known = set(description.states)
    known_initially: set[str] = set()
    for variable in description.variables:
        always_known = variable.causality in ALWAYS_KNOWN
        if always_known or variable.variability == "discrete":
            known.add(variable.name)
        if always_known or variable.initial == "exact":
            known_initially.add(variable.name)
    yield from _compare_dependencies(description.dependencies, known, NEVER_KNOWN)
    yield from _compare_dependencies(
        description.initial_dependencies, known_initially, NEVER_KNOWN_INITIALLY
    )


def _compare_dependencies(
    dependencies: Mapping[str, Sequence[str] | None], known: set[str], reason: str
) -> Iterator[Finding]:
    for name, needed in dependencies.items():
        unknown = [other for other in needed or () if other not in known and other != name]
        if unknown:
            text = f"depends on {listing(unknown)}: {reason}"
            yield Finding("warning", _where(name), text)


def _check_residual_form(description: Description) -> Iterator[Finding]:
    """Check the manifest of FMI-LS-DAE.

    The FMU runs without it, but not in the form that the manifest promises.
    """
    dae = description.dae
    if dae is None:
        return
    for problem in dae.problems:
        yield Finding("error", MANIFEST, problem)
    if not dae.problems and not (dae.algebraic and dae.residuals):
        text = "lists no AlgebraicVariables or no Residual, so that the residual form is not known"
        yield Finding("warning", MANIFEST, text)


# --- names ---


def _check_names(root: Element, description: Description) -> Iterator[Finding]:
    structured = root.get("variableNamingConvention") == "structured"
    for variable in description.variables:
        if CONTROL.search(variable.name):
            text = "has a control character in its name"
            yield Finding("warning", _where(variable.name), text)
        elif structured and not STRUCTURED_NAME.fullmatch(variable.name):
            text = "is no name of the structured naming convention that the file announces"
            yield Finding("warning", _where(variable.name), text)


def _check_value_references(root: Element, description: Description) -> Iterator[Finding]:
    """Check what FMI 3 requires beyond FMI 2: one independent variable, own value references."""
    if major(root) < 3:
        return
    count = sum(variable.causality == "independent" for variable in description.variables)
    if count != 1:
        text = f"{count} independent variables; FMI 3 needs exactly one, the time"
        yield Finding("warning", "structure", text)
    owners: dict[int, str] = {}
    for variable in description.variables:
        reference = variable.reference
        owner = owners.setdefault(reference, variable.name)
        if variable.alias_of is None and owner != variable.name:
            text = f"has the value reference {reference} of {owner!r}; FMI 3 needs one for each"
            yield Finding("error", _where(variable.name), text)


# --- what to know before a run ---


def _check_support(description: Description) -> Iterator[Finding]:
    """Yield what limits a run of the FMU here."""
    if not description.capabilities:
        yield Finding("error", "XML", description.missing_interface)
    elif description.scheduled_execution:
        text = "scheduled execution, which is not supported, beside what is"
        yield Finding("note", "XML", text)
    undeclared = _undeclared_feedthrough(description)
    has_inputs = any(variable.causality == "input" for variable in description.variables)
    if undeclared and has_inputs:
        names = listing(undeclared, MOST_NAMES)
        text = f"the file does not say on which inputs these depend directly: {names}"
        yield Finding("note", "structure", text)
    has_cs = "cs" in description.capabilities
    if description.clocks and has_cs and not description.capabilities["cs"].event_mode:
        names = listing(description.clocks, MOST_NAMES)
        text = f"clocks, which are not activated without event mode (hasEventMode): {names}"
        yield Finding("warning", "co-simulation", text)
    for interface_type, capabilities in description.capabilities.items():
        where = INTERFACE_TYPE_NAMES[interface_type]
        if capabilities.needs_tool:
            text = "needs the tool that made it, or its libraries, to run"
            yield Finding("note", where, text)
        if capabilities.once_per_process:
            yield Finding("note", where, "can be instantiated only once in a process")


def _undeclared_feedthrough(description: Description) -> list[str]:
    """Return the outputs whose dependencies the file does not list; a state has none."""
    names = []
    for variable in description.variables:
        is_output = variable.causality == "output" and variable.alias_of is None
        if not is_output or not variable.is_signal or variable.name in description.states:
            continue
        if description.dependencies.get(variable.name) is None:
            names.append(variable.name)
    return names
