"""Read what an .fmu says about itself; refuse what is no FMU.

``archive.py`` judges the archive, ``markup.py`` the XML, ``variables.py`` reads the variables. The XML is read here and not by
fmpy, whose description misses the directional derivatives and unsigned ranges of FMI 3, its string arrays, relative quantities,
and the dependencies, aliases and start values of FMI 1, and which fails with whatever its parsing happens to raise.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias
from xml.etree.ElementTree import Element

from cosim.errors import FmuError
from cosim.fmi.archive import look
from cosim.fmi.description import Capabilities, Description, Mode, Variable
from cosim.fmi.markup import Attributes, flag, parse
from cosim.fmi.variables import major, read_definitions, read_variables

XML: Final = "modelDescription.xml"
IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
ELEMENTS: Final[Mapping[Mode, str]] = {"me": "ModelExchange", "cs": "CoSimulation"}

Dependencies: TypeAlias = dict[str, tuple[str, ...] | None]


@dataclass(frozen=True, slots=True)
class Archive:
    """An .fmu file that was looked into.

    Parameters
    ----------
    path : Path
    sha256 : str
        Of the file, in hexadecimal.
    xml : str
        Its modelDescription.xml.
    members : frozenset of str
        Names of the files in it.
    description : Description
    """

    path: Path
    sha256: str
    xml: str
    members: frozenset[str]
    description: Description


def read(path: Path | str, into: Path | None = None) -> Archive:
    """Look into an .fmu, and unpack it where a folder is given.

    Parameters
    ----------
    path : Path or str
    into : Path or None
        An empty folder; after an error it holds a part.

    Raises
    ------
    FmuError
        If the file is missing, no zip archive or one that must not be unpacked, without modelDescription.xml, or the XML is
        broken, of an unknown version, or contradicts itself: all that is wrong with it in one report.
    """
    path = Path(path)
    root, members, sha256, raw = open_description(path, into)
    problems: list[str] = []
    description = describe_root(root, members, path.stem, problems)
    if problems:
        raise FmuError("\n".join(f"{path}: {XML}: {problem}" for problem in problems))
    return Archive(path, sha256, raw.decode("utf-8", "replace"), members, description)


def open_description(path: Path, into: Path | None = None) -> tuple[Element, frozenset[str], str, bytes]:
    """Give the root of the XML of a version that is known, the names of the files, the file's sum and the XML as it is.

    Raises
    ------
    FmuError
        As ``read``, except for what contradicts itself.
    """
    if not path.is_file():
        raise FmuError(f"{path}: there is no such file" if not path.exists() else f"{path}: needed an .fmu file, found a folder")
    contents = look(path, XML, into)
    if contents.wanted is None:
        raise FmuError(f"{path}: not an FMU, as the archive has no {XML}")
    try:
        root = parse(contents.wanted)
    except ValueError as error:
        raise FmuError(f"{path}: {XML} is not well-formed: {error}") from error
    version = root.get("fmiVersion")
    if version is None or not (version in ("1.0", "2.0") or version.startswith("3.")):
        raise FmuError(f"{path}: unknown FMI version {version!r}; FMI 1.0, 2.0 and 3.0 are supported")
    return root, contents.members, contents.sha256, contents.wanted


def describe_root(root: Element, members: frozenset[str], stem: str, problems: list[str]) -> Description:
    """Read the XML; what is wrong goes to ``problems``, and the description is then not to be used."""
    attributes = Attributes(problems)
    version = major(root)
    variables = read_variables(root, read_definitions(root, attributes), attributes)
    structure = (_structure_1, _structure_2, _structure_3)[version - 1](root, variables, attributes)
    named = {variable.name: variable for variable in variables}
    states = _states(structure.derivatives, named, problems)
    experiment = root.find("DefaultExperiment")
    experiment = Element("none") if experiment is None else experiment
    return Description(
        name=root.get("modelName") or stem,
        token=attributes.text(root, "instantiationToken" if version == 3 else "guid", root.tag),
        version=root.get("fmiVersion", ""),
        variables=variables,
        states=states,
        dependencies=structure.outputs | structure.derivatives,
        initial_dependencies=structure.initial,
        unnamed_states=structure.unnamed_states,
        capabilities=_capabilities(root, attributes),
        event_indicators=structure.event_indicators,
        indicators=structure.indicators,
        clocks=tuple(v.name for v in variables if v.type == "Clock"),
        platforms=tuple(sorted({name.split("/")[1] for name in members if name.startswith("binaries/") and name.count("/") > 1})),
        read=tuple(name for name in states if named[name].causality == "local"),
        default_step=attributes.number(experiment, "stepSize", "DefaultExperiment"),
        default_tolerance=attributes.number(experiment, "tolerance", "DefaultExperiment"),
        tool=root.get("generationTool", ""),
    )


# --- what depends on what ---


@dataclass(frozen=True, slots=True)
class _Structure:
    outputs: Dependencies
    derivatives: Dependencies
    initial: Dependencies
    event_indicators: int
    indicators: tuple[str, ...] = ()
    unnamed_states: int = 0


def _structure_1(root: Element, variables: tuple[Variable, ...], attributes: Attributes) -> _Structure:
    """Read DirectDependency (FMI 1.0 section 3.2): names of inputs; without it an output depends on all of them."""
    outputs: Dependencies = {}
    for element in root.iterfind("ModelVariables/ScalarVariable"):
        direct = element.find("DirectDependency")
        if direct is not None:
            outputs[element.get("name", "")] = tuple((name.text or "").strip() for name in direct.iterfind("Name"))
    counts = (attributes.integer(root, f"numberOf{what}", root.tag) for what in ("EventIndicators", "ContinuousStates"))
    indicators, states = (_count(number, attributes) for number in counts)
    return _Structure(outputs, {}, {}, indicators, unnamed_states=states)


def _structure_2(root: Element, variables: tuple[Variable, ...], attributes: Attributes) -> _Structure:
    """Read ModelStructure (FMI 2.0.4 section 2.2.8): variables by position, from 1."""
    names = {number: variable.name for number, variable in enumerate(variables, 1)}
    outputs, derivatives, initial = (
        _unknowns(root, f"{section}/Unknown", "index", names, attributes)
        for section in ("Outputs", "Derivatives", "InitialUnknowns")
    )
    indicators = attributes.integer(root, "numberOfEventIndicators", root.tag)
    return _Structure(outputs, derivatives, initial, _count(indicators, attributes))


def _structure_3(root: Element, variables: tuple[Variable, ...], attributes: Attributes) -> _Structure:
    """Read ModelStructure (FMI 3.0 section 2.4.8): variables by value reference."""
    names = {variable.reference: variable.name for variable in variables if variable.alias_of is None}
    outputs, derivatives, initial, indicators = (
        _unknowns(root, section, "valueReference", names, attributes)
        for section in ("Output", "ContinuousStateDerivative", "InitialUnknown", "EventIndicator")
    )
    count = sum(variable.size for variable in variables if variable.name in indicators and variable.alias_of is None)
    return _Structure(outputs, derivatives, initial, count, tuple(indicators))


def _count(number: int | None, attributes: Attributes) -> int:
    if number is not None and not 0 <= number < 2**31:
        attributes.problems.append(f"found a count of {number}, needed one that is not negative")
        return 0
    return number or 0


def _unknowns(root: Element, section: str, key: str, names: Mapping[int, str], attributes: Attributes) -> Dependencies:
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
            attributes.problems.append(f"{where} {names[number]!r}: dependencies name no variable: {', '.join(missing)}")
        found[names[number]] = None if known is None else tuple(names[other] for other in known if other in names)
    return found


def _states(derivatives: Dependencies, named: Mapping[str, Variable], problems: list[str]) -> tuple[str, ...]:
    """Name the states, in the order of the derivatives."""
    states = []
    for name in derivatives:
        state = named[name].derivative_of
        if state is None:
            problems.append(f"{name!r} is listed as a derivative, but has no attribute derivative that names its state")
        else:
            states.append(state)
    return tuple(states)


# --- what it can do ---


def _capabilities(root: Element, attributes: Attributes) -> dict[Mode, Capabilities]:
    version = major(root)
    found: dict[Mode, Capabilities] = {}
    if version == 1:
        identifier = _identifier(root, attributes)
        implementation = root.find("Implementation")
        if implementation is None:
            return {"me": Capabilities(identifier)}
        return {"cs": _capabilities_1(implementation, identifier)}
    for mode, tag in ELEMENTS.items():
        element = root.find(tag)
        if element is not None:
            able = _capabilities_2 if version == 2 else _capabilities_3
            found[mode] = able(element, _identifier(element, attributes), mode, attributes)
    return found


def _identifier(element: Element, attributes: Attributes) -> str:
    """Give the modelIdentifier; it becomes part of a path, and "../x" must not."""
    found = element.get("modelIdentifier")
    if found is None:
        attributes.problems.append(f"{element.tag}: the attribute modelIdentifier is missing")
    elif not IDENTIFIER.fullmatch(found) or not found.isascii():
        attributes.problems.append(f"{element.tag}: modelIdentifier {found!r} is no identifier of C")
    return found or ""


def _capabilities_1(implementation: Element, identifier: str) -> Capabilities:
    found = implementation.find("*/Capabilities")
    element = Element("none") if found is None else found
    return Capabilities(
        identifier,
        interpolates_inputs=flag(element, "canInterpolateInputs"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=implementation.find("CoSimulation_Tool") is not None,
    )


def _capabilities_2(element: Element, identifier: str, mode: Mode, attributes: Attributes) -> Capabilities:
    return Capabilities(
        identifier,
        directional_derivatives=flag(element, "providesDirectionalDerivative"),
        saves_state=flag(element, "canGetAndSetFMUstate"),
        serializes_state=flag(element, "canSerializeFMUstate"),
        interpolates_inputs=flag(element, "canInterpolateInputs"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        completed_step=mode == "me" and not flag(element, "completedIntegratorStepNotNeeded"),
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=flag(element, "needsExecutionTool"),
    )


def _capabilities_3(element: Element, identifier: str, mode: Mode, attributes: Attributes) -> Capabilities:
    step = attributes.number(element, "fixedInternalStepSize", element.tag)
    if step is not None and not 0.0 < step < float("inf"):
        attributes.problems.append(f"{element.tag}: fixedInternalStepSize: found {step}, needed a positive number")
    return Capabilities(
        identifier,
        directional_derivatives=flag(element, "providesDirectionalDerivatives"),
        adjoint_derivatives=flag(element, "providesAdjointDerivatives"),
        saves_state=flag(element, "canGetAndSetFMUState"),
        serializes_state=flag(element, "canSerializeFMUState"),
        interpolates_inputs=flag(element, "providesIntermediateUpdate"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        fixed_step=step,
        event_mode=flag(element, "hasEventMode"),
        early_return=flag(element, "mightReturnEarlyFromDoStep"),
        completed_step=mode == "me" and flag(element, "needsCompletedIntegratorStep"),
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=flag(element, "needsExecutionTool"),
    )
