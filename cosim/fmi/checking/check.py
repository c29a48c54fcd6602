"""Everything that is wrong with an FMU, at once: archive, XML, schema, structure, binaries, and trials in child processes."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from cosim.errors import FmuError
from cosim.fmi.binary.headers import built_for
from cosim.fmi.checking.binaries import functions, machine_of
from cosim.fmi.checking.structure import Finding, Severity, findings
from cosim.fmi.child_process import MISSING_FUNCTION, TIMEOUT, attempt
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description, InterfaceType
from cosim.fmi.platforms import ARCHITECTURE, SUFFIX, SYSTEM, folders
from cosim.fmi.reading.markup import Attributes
from cosim.fmi.reading.model_description import XML, describe_root, need_file, open_description
from cosim.fmi.reading.variables import major, read_definitions

__all__ = ["Finding", "Severity", "check"]

MOST: Final = 100  # findings of the schema
HEAD: Final = 4096  # bytes of a binary that are looked at
SCHEMAS: Final = {
    1: "fmi1/fmiModelDescription.xsd",
    2: "fmi2/fmi2ModelDescription.xsd",
    3: "fmi3/fmi3ModelDescription.xsd",
}


def check(path: Path | str, *, timeout: float = TIMEOUT) -> tuple[Finding, ...]:
    """Find everything that is wrong with an FMU.

    Parameters
    ----------
    path : Path or str
    timeout : float
        Of each trial [s].

    Returns
    -------
    tuple of Finding
        Errors first.

    Raises
    ------
    FmuError
        If there is no such file; all else is a finding.
    """
    path = Path(path)
    need_file(path)
    with TemporaryDirectory(prefix="cosim-check-") as temporary:
        folder = Path(temporary)
        try:
            root, contents = open_description(path, folder)
        except FmuError as error:
            return (
                Finding("error", "archive" if XML not in str(error) else "XML", _bare(path, error)),
            )
        problems: list[str] = []
        description = describe_root(root, contents, path.stem, problems)
        raw = contents.wanted[XML]
        found = [Finding("error", "XML", problem) for problem in problems] + _schema(
            raw, major(root)
        )
        found += findings(root, description, read_definitions(root, Attributes([])))
        if not any(finding.level in ("error", "warning") for finding in found):
            found += _second_opinion(raw)
        found += _binaries(folder, description)
        if not any(
            finding.level == "error" and finding.where in ("XML", "binary") for finding in found
        ):
            found += _trials(path, folder, description, timeout)
    order = ("error", "warning", "note")
    return tuple(sorted(dict.fromkeys(found), key=lambda finding: order.index(finding.level)))


def _bare(path: Path, error: Exception) -> str:
    """Leave the path out of a message: it is the same in all."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")


# --- what the file says ---


def _schema(raw: bytes, version: int) -> list[Finding]:
    """Validate by the schema of the standard, which fmpy brings along."""
    from lxml import etree

    package = importlib.util.find_spec("fmpy")
    assert package is not None
    assert package.origin is not None
    schema = etree.XMLSchema(file=str(Path(package.origin).parent / "schema" / SCHEMAS[version]))
    try:
        document = etree.fromstring(
            raw, etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
        )
    except etree.XMLSyntaxError as error:  # stricter than the parser that it passed
        return [Finding("error", "XML", f"not well-formed: {error}")]
    schema.validate(document)
    found = [
        Finding("error", "schema", f"line {entry.line}: {entry.message}")
        for entry in schema.error_log
    ]
    more = (
        [Finding("error", "schema", f"and {len(found) - MOST} more")] if len(found) > MOST else []
    )
    return found[:MOST] + more


def _second_opinion(raw: bytes) -> list[Finding]:
    """Ask fmpy's validator where nothing else was found."""
    from fmpy.model_description import read_model_description
    from fmpy.validation import validate_model_description

    with TemporaryDirectory(prefix="cosim-xml-") as folder:
        (file := Path(folder) / XML).write_bytes(raw)
        try:
            found = read_model_description(str(file), validate=False)
            problems = validate_model_description(
                found, validate_variable_names=False, validate_model_structure=True
            )
        except Exception as error:  # fmpy raises what its parsing happens to raise
            problems = [f"cannot read it: {type(error).__name__}: {error}"]
    return [Finding("warning", "fmpy", problem) for problem in problems]


# --- binaries ---


def _binaries(folder: Path, description: Description) -> list[Finding]:
    """Compare every binary with the folder it is in; find the one for this machine."""
    found = []
    mine = folders(description.version)
    for platform in description.platforms:
        machine = machine_of(platform)
        if machine is None:
            found.append(
                Finding("warning", "binary", f"binaries/{platform} is no platform of the standard")
            )
            continue
        for identifier in sorted({able.identifier for able in description.capabilities.values()}):
            suffix = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}[machine[1]]
            file = folder / "binaries" / platform / f"{identifier}{suffix}"
            level: Severity = "error" if platform in mine else "warning"
            found += [
                Finding(level, "binary", text) for text in _wrong_binary(file, platform, machine)
            ]
    there = [name for name in mine if name in description.platforms]
    if not there:
        text = f"none for this machine ({ARCHITECTURE}-{SYSTEM}); there is: {', '.join(description.platforms) or 'none'}"
        found.append(Finding("error", "binary", text))
    return found


def _wrong_binary(file: Path, platform: str, machine: tuple[str, str]) -> Iterator[str]:
    name = f"binaries/{platform}/{file.name}"
    if not file.is_file():
        yield f"{name} is missing"
        return
    with file.open("rb") as opened:
        built = built_for(opened.read(HEAD))
    if built is None:
        yield f"{name} is no shared library"
    elif built[1] != machine[1] or built[0] not in (machine[0], "any"):
        yield f"{name} is for {'-'.join(built)}; needed {'-'.join(machine)}"


# --- trials ---


def _trials(path: Path, folder: Path, description: Description, timeout: float) -> list[Finding]:
    found = []
    for interface_type in description.capabilities:
        problems = _try_symbols(folder, description, interface_type, timeout)
        where = f"binary, {INTERFACE_TYPE_NAMES[interface_type]}"
        found += [Finding("error", where, problem) for problem in problems]
        if any(
            not problem.startswith(MISSING_FUNCTION) for problem in problems
        ):  # a function that nobody calls may be missing
            continue
        run = attempt("run", str(path.resolve()), interface_type, timeout=timeout)
        found += [
            Finding(
                "error", f"trial run, {INTERFACE_TYPE_NAMES[interface_type]}", _of(path, problem)
            )
            for problem in run
        ]
        if not run and description.capabilities[interface_type].saves_state:
            back = attempt("rollback", str(path.resolve()), interface_type, timeout=timeout)
            found += [
                Finding(
                    "error",
                    f"trial save and restore, {INTERFACE_TYPE_NAMES[interface_type]}",
                    _of(path, problem),
                )
                for problem in back
            ]
    return found


def _of(path: Path, problem: str) -> str:
    return problem.replace(f"{path.resolve()}: ", "")


def _try_symbols(
    folder: Path, description: Description, interface_type: InterfaceType, timeout: float
) -> tuple[str, ...]:
    library = f"{description.capabilities[interface_type].identifier}{SUFFIX}"
    places = (folder / "binaries" / name / library for name in folders(description.version))
    file = next((place for place in places if place.is_file()), None)
    return (
        ()
        if file is None
        else attempt("symbols", str(file), *functions(description, interface_type), timeout=timeout)
    )
