"""Read the description in an .fmu; refuse what is no FMU.

``archive.py`` checks the archive, ``markup.py`` the XML; ``variables.py``, ``dependencies.py``,
``capabilities.py`` and ``dae.py`` read its parts. The XML is read here and not by fmpy, whose
description misses the directional derivatives and unsigned ranges of FMI 3, its string arrays,
relative quantities, and the dependencies, aliases and start values of FMI 1, and which fails with
whatever its parsing happens to raise.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element

from cosim.errors import FmuError
from cosim.files import expanded
from cosim.fmi.description import Description
from cosim.fmi.reading.archive import ArchiveContents, read_archive
from cosim.fmi.reading.capabilities import read_capabilities
from cosim.fmi.reading.dae import MANIFEST, read_dae
from cosim.fmi.reading.dependencies import name_states, read_structure
from cosim.fmi.reading.markup import Attributes, collector_paused, parse
from cosim.fmi.reading.variables import Definitions, major, read_definitions, read_variables

XML: Final = "modelDescription.xml"
MOST_PROBLEMS: Final = 100  # of one file, in one error


@dataclass(frozen=True, slots=True)
class Archive:
    """An .fmu file, and what was read from it.

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
    warnings : tuple of str
        What is against the standard, and does not keep the FMU from running as it is meant.
    """

    path: Path
    sha256: str
    xml: str
    members: frozenset[str]
    description: Description
    warnings: tuple[str, ...] = ()


def read(path: Path | str, into: Path | None = None) -> Archive:
    """Read an .fmu, and unpack it where a folder is given.

    Parameters
    ----------
    path : Path or str
    into : Path or None
        An empty folder; after an error it holds a part.

    Raises
    ------
    FmuError
        If the file is missing, no zip archive or one that must not be unpacked, without
        modelDescription.xml, or the XML is broken, of an unknown version, or contradicts itself:
        all problems in one report.
    """
    path = expanded(path)
    attributes = Attributes()
    with collector_paused():
        contents = open_archive(path, into)
        root = parse_description(path, contents)
        description, _ = describe_root(root, contents, path.stem, attributes)
    if attributes.problems:
        lines = [f"{path}: {XML}: {problem}" for problem in attributes.problems[:MOST_PROBLEMS]]
        omitted = len(attributes.problems) - len(lines)
        if omitted:
            more = f"{omitted} more problem{'' if omitted == 1 else 's'}"
            lines.append(f"{path}: {XML}: and {more}; 'cosim check' lists all")
        raise FmuError("\n".join(lines))
    xml = contents.wanted[XML].decode("utf-8", "replace")
    warnings = (*contents.warnings, *attributes.warnings)
    return Archive(path, contents.sha256, xml, contents.members, description, warnings)


def open_archive(path: Path, into: Path | None = None) -> ArchiveContents:
    """Return what an .fmu holds; unpack it where a folder is given.

    Raises
    ------
    FmuError
        As ``read``, for all that is wrong with the archive.
    """
    need_file(path)
    contents = read_archive(path, (XML, MANIFEST), into)
    if XML not in contents.wanted:
        raise FmuError(f"{path}: not an FMU, as the archive has no {XML}")
    return contents


def parse_description(path: Path, contents: ArchiveContents) -> Element:
    """Return the root of the XML.

    Raises
    ------
    FmuError
        If it is not well-formed, or its version is not known.
    """
    try:
        root = parse(contents.wanted[XML])
    except ValueError as error:
        raise FmuError(f"{path}: {XML} is not well-formed: {error}") from error
    version = root.get("fmiVersion")
    if version not in ("1.0", "2.0") and not (version or "").startswith("3."):
        raise FmuError(
            f"{path}: unknown FMI version {version!r}; FMI 1.0, 2.0 and 3.0 are supported"
        )
    return root


def need_file(path: Path) -> None:
    """Refuse a path without a file.

    Raises
    ------
    FmuError
        If there is nothing, or a folder.
    """
    if not path.exists():
        raise FmuError(f"{path}: there is no such file")
    if path.is_dir():
        raise FmuError(f"{path}: expected an .fmu file, got a folder")


def describe_root(
    root: Element, contents: ArchiveContents, stem: str, attributes: Attributes
) -> tuple[Description, Definitions]:
    """Read the XML, and the units and types that it defines; problems go to ``attributes``.

    Where there are problems, the result is not to be used. Problems of the manifest of a residual
    form stay with that form: the FMU works without it.
    """
    version = major(root)
    definitions = read_definitions(root, attributes)
    variables = read_variables(root, definitions, attributes)
    structure = read_structure(root, variables, attributes)
    named = {variable.name: variable for variable in variables}
    states, unnamed_states = name_states(structure.derivatives, named, attributes)
    token_name = "instantiationToken" if version == 3 else "guid"
    token = attributes.text(root, token_name, root.tag)
    capabilities = read_capabilities(root, attributes)
    default_step, default_tolerance = _read_experiment(root, attributes)
    dae = None
    if version == 3 and MANIFEST in contents.wanted:
        dae = read_dae(contents.wanted[MANIFEST], variables)
    description = Description(
        name=root.get("modelName") or stem,
        token=token,
        version=root.get("fmiVersion", ""),
        variables=variables,
        states=states,
        dependencies={**structure.outputs, **structure.derivatives},
        initial_dependencies=structure.initial,
        unnamed_states=structure.unnamed_states + unnamed_states,
        capabilities=capabilities,
        event_indicators=structure.event_indicators,
        indicators=structure.indicators,
        clocks=tuple(variable.name for variable in variables if variable.type == "Clock"),
        platforms=_platforms(contents.members),
        local_states=tuple(name for name in states if named[name].causality == "local"),
        default_step=default_step,
        default_tolerance=default_tolerance,
        tool=root.get("generationTool", ""),
        dae=dae,
        scheduled_execution=root.find("ScheduledExecution") is not None,
    )
    return description, definitions


def _read_experiment(root: Element, attributes: Attributes) -> tuple[float | None, float | None]:
    """Return the step size and the tolerance of DefaultExperiment."""
    experiment = root.find("DefaultExperiment")
    if experiment is None:
        return None, None
    step = attributes.optional_number(experiment, "stepSize", "DefaultExperiment")
    tolerance = attributes.optional_number(experiment, "tolerance", "DefaultExperiment")
    return step, tolerance


def _platforms(members: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the folders under ``binaries/`` that hold something."""
    platforms = set()
    for name in members:
        folder, _, path = name.partition("/")
        if folder == "binaries" and "/" in path:
            platforms.add(path.partition("/")[0])
    return tuple(sorted(platforms))
