"""Read what an .fmu says about itself; refuse what is no FMU.

``archive.py`` judges the archive, ``markup.py`` the XML; ``variables.py``, ``dependencies.py``, ``capabilities.py`` and
``dae.py`` read its parts. The XML is read here and not by
fmpy, whose description misses the directional derivatives and unsigned ranges of FMI 3, its string arrays, relative quantities,
and the dependencies, aliases and start values of FMI 1, and which fails with whatever its parsing happens to raise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element

from cosim.errors import FmuError
from cosim.fmi.description import Description
from cosim.fmi.reading.archive import ArchiveContents, look
from cosim.fmi.reading.capabilities import read_capabilities
from cosim.fmi.reading.dae import MANIFEST, read_dae
from cosim.fmi.reading.dependencies import name_states, read_structure
from cosim.fmi.reading.markup import Attributes, parse
from cosim.fmi.reading.variables import major, read_definitions, read_variables

XML: Final = "modelDescription.xml"


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
    root, contents = open_description(path, into)
    problems: list[str] = []
    description = describe_root(root, contents, path.stem, problems)
    if problems:
        raise FmuError("\n".join(f"{path}: {XML}: {problem}" for problem in problems))
    return Archive(
        path,
        contents.sha256,
        contents.wanted[XML].decode("utf-8", "replace"),
        contents.members,
        description,
    )


def open_description(path: Path, into: Path | None = None) -> tuple[Element, ArchiveContents]:
    """Give the root of the XML of a version that is known, and what the archive holds.

    Raises
    ------
    FmuError
        As ``read``, except for what contradicts itself.
    """
    need_file(path)
    contents = look(path, (XML, MANIFEST), into)
    if XML not in contents.wanted:
        raise FmuError(f"{path}: not an FMU, as the archive has no {XML}")
    try:
        root = parse(contents.wanted[XML])
    except ValueError as error:
        raise FmuError(f"{path}: {XML} is not well-formed: {error}") from error
    version = root.get("fmiVersion")
    if version is None or not (version in ("1.0", "2.0") or version.startswith("3.")):
        raise FmuError(
            f"{path}: unknown FMI version {version!r}; FMI 1.0, 2.0 and 3.0 are supported"
        )
    return root, contents


def need_file(path: Path) -> None:
    """Refuse what is no file.

    Raises
    ------
    FmuError
        If there is nothing, or a folder.
    """
    if not path.is_file():
        raise FmuError(
            f"{path}: there is no such file"
            if not path.exists()
            else f"{path}: needed an .fmu file, found a folder"
        )


def describe_root(
    root: Element, contents: ArchiveContents, stem: str, problems: list[str]
) -> Description:
    """Read the XML; what is wrong goes to ``problems``, and the description is then not to be used.

    What is wrong with the manifest of a residual form is told with that: the FMU is what it is without it.
    """
    attributes = Attributes(problems)
    version = major(root)
    variables = read_variables(root, read_definitions(root, attributes), attributes)
    structure = read_structure(root, variables, attributes)
    named = {variable.name: variable for variable in variables}
    states = name_states(structure.derivatives, named, problems)
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
        capabilities=read_capabilities(root, attributes),
        event_indicators=structure.event_indicators,
        indicators=structure.indicators,
        clocks=tuple(v.name for v in variables if v.type == "Clock"),
        platforms=tuple(
            sorted(
                {
                    name.split("/")[1]
                    for name in contents.members
                    if name.startswith("binaries/") and name.count("/") > 1
                }
            )
        ),
        read=tuple(name for name in states if named[name].causality == "local"),
        default_step=attributes.number(experiment, "stepSize", "DefaultExperiment"),
        default_tolerance=attributes.number(experiment, "tolerance", "DefaultExperiment"),
        tool=root.get("generationTool", ""),
        dae=read_dae(contents.wanted[MANIFEST], variables)
        if version == 3 and MANIFEST in contents.wanted
        else None,
    )
