"""Check an FMU and report all problems at once: archive, XML, schema, structure, binaries, trials.

What runs foreign code does so in child processes.
"""

from __future__ import annotations

import pickle
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element

from cosim.errors import FmuError
from cosim.files import expanded
from cosim.fmi.binary.headers import built_for
from cosim.fmi.bundled import bundled
from cosim.fmi.checking.binaries import machine_of, required_functions
from cosim.fmi.checking.structure import Finding, Severity, check_structure
from cosim.fmi.child_process import TIMEOUT, TrialProblem, attempt, try_fmu
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description, InterfaceType
from cosim.fmi.driving.initialization import Starts, check_start, resized
from cosim.fmi.platforms import ARCHITECTURE, SUFFIX, SYSTEM, cure, folders
from cosim.fmi.reading.archive import ArchiveContents
from cosim.fmi.reading.markup import Attributes, collector_paused
from cosim.fmi.reading.model_description import (
    XML,
    Archive,
    describe_root,
    need_file,
    open_archive,
    parse_description,
)
from cosim.fmi.reading.variables import Definitions, major
from cosim.temporary import TemporaryFolder

__all__ = ["Finding", "Severity", "check"]

NO_STARTS: Final[Starts] = {}
MAX_SCHEMA_FINDINGS: Final = 100
HEAD_SIZE: Final = 4096  # bytes of a binary that are looked at
LEVELS: Final[tuple[Severity, ...]] = ("error", "warning", "note")
SCHEMAS: Final = {
    1: "fmi1/fmiModelDescription.xsd",
    2: "fmi2/fmi2ModelDescription.xsd",
    3: "fmi3/fmi3ModelDescription.xsd",
}
SUFFIXES: Final = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}


def check(
    path: Path | str, *, start: Starts = NO_STARTS, timeout: float = TIMEOUT
) -> tuple[Finding, ...]:
    """Find everything that is wrong with an FMU.

    Parameters
    ----------
    path : Path or str
    start : mapping of variable name to StartValue
        Start values for the trials.
    timeout : float
        Of each trial [s].

    Returns
    -------
    tuple of Finding
        Errors first.

    Raises
    ------
    FmuError
        If there is no such file, or a start value is wrong; all else is a finding.
    """
    path = expanded(path)
    need_file(path)
    with TemporaryFolder("check") as temporary, collector_paused():
        folder = temporary / "unpacked"
        folder.mkdir()
        where = "archive"
        try:
            contents = open_archive(path, folder)
            where = "XML"
            root = parse_description(path, contents)
        except FmuError as error:
            return (Finding("error", where, _without_path(path, error)),)
        description, definitions, findings = _describe(path, root, contents)
        findings += _check_binaries(path, folder, description, contents.members)
        if any(_prevents_trials(finding) for finding in findings):
            findings += _check_description(root, contents, description, definitions)
        else:
            check_start(resized(description, start), start)
            given = Path(temporary) / "given"
            given.write_bytes(_trial_input(path, contents, description, start))
            # The trials are other processes, and need not be waited for.
            with ThreadPoolExecutor(max_workers=1) as pool:
                trials = pool.submit(_run_trials, path, folder, description, given, timeout)
                findings += _check_description(root, contents, description, definitions)
                findings += trials.result()
    unique = dict.fromkeys(findings)
    return tuple(sorted(unique, key=lambda finding: LEVELS.index(finding.level)))


def _trial_input(
    path: Path, contents: ArchiveContents, description: Description, start: Starts
) -> bytes:
    """Return what the trials need to know: they do not read the description again."""
    reduced = description.reduced(start)
    archive = Archive(path.resolve(), contents.sha256, "", contents.members, reduced)
    return pickle.dumps((archive, dict(start)))


def _without_path(path: Path, error: Exception) -> str:
    """Return a message without the path: it is the same in all."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")


def _prevents_trials(finding: Finding) -> bool:
    return finding.level == "error" and finding.where in ("XML", "binary")


# --- the description ---


def _describe(
    path: Path, root: Element, contents: ArchiveContents
) -> tuple[Description, Definitions, list[Finding]]:
    """Return the description, the units and types in it, and what is wrong with reading it."""
    attributes = Attributes()
    description, definitions = describe_root(root, contents, path.stem, attributes)
    findings = [Finding("error", "XML", problem) for problem in attributes.problems]
    findings += [Finding("warning", "archive", text) for text in contents.warnings]
    findings += [Finding("warning", "XML", text) for text in attributes.warnings]
    return description, definitions, findings


def _check_description(
    root: Element, contents: ArchiveContents, description: Description, definitions: Definitions
) -> list[Finding]:
    """Return what the schema and the rules beyond it forbid."""
    # lxml lets other threads run while it validates
    with ThreadPoolExecutor(max_workers=1) as pool:
        validation = pool.submit(_validate_schema, contents.wanted[XML], major(root))
        findings = check_structure(root, description, definitions)
        return [*validation.result(), *findings]


def _validate_schema(xml: bytes, version: int) -> list[Finding]:
    """Validate with the schema of the standard, which comes with fmpy."""
    from lxml import etree

    schema = etree.XMLSchema(file=str(bundled("schema", SCHEMAS[version])))
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
    try:
        document = etree.fromstring(xml, parser)
    except etree.XMLSyntaxError as error:  # stricter than the parser that it passed
        return [Finding("error", "XML", f"not well-formed: {error}")]
    schema.validate(document)
    texts = [f"line {entry.line}: {entry.message}" for entry in schema.error_log]
    if len(texts) > MAX_SCHEMA_FINDINGS:
        omitted = len(texts) - MAX_SCHEMA_FINDINGS
        texts = [*texts[:MAX_SCHEMA_FINDINGS], f"and {omitted} more"]
    return [Finding("error", "schema", text) for text in texts]


# --- binaries ---


def _check_binaries(
    path: Path, folder: Path, description: Description, members: Collection[str]
) -> Iterator[Finding]:
    """Compare every binary with the folder it is in; find the one for this machine."""
    native_platforms = folders(description.version)
    capabilities = description.capabilities.values()
    identifiers = sorted({can.identifier for can in capabilities})
    for platform in description.platforms:
        machine = machine_of(platform)
        if machine is None:
            text = f"binaries/{platform} is no platform of the standard"
            yield Finding("warning", "binary", text)
            continue
        level: Severity = "error" if platform in native_platforms else "warning"
        for identifier in identifiers:
            file = folder / "binaries" / platform / f"{identifier}{SUFFIXES[machine[1]]}"
            for problem in _binary_problems(file, platform, machine):
                yield Finding(level, "binary", problem)
    if not any(platform in description.platforms for platform in native_platforms):
        platforms = ", ".join(description.platforms) or "none"
        text = f"none for this machine ({ARCHITECTURE}-{SYSTEM}); available: {platforms}; "
        text += cure(path, members)
        yield Finding("error", "binary", text)


def _binary_problems(file: Path, platform: str, machine: tuple[str, str]) -> Iterator[str]:
    name = f"binaries/{platform}/{file.name}"
    if not file.is_file():
        yield f"{name} is missing"
        return
    with file.open("rb") as opened:
        built = built_for(opened.read(HEAD_SIZE))
    if built is None:
        yield f"{name} is no shared library"
        return
    architecture, system = machine
    built_architecture, built_system = built
    if built_system != system or built_architecture not in (architecture, "any"):
        yield f"{name} is for {'-'.join(built)}; expected {'-'.join(machine)}"


# --- trials ---


def _run_trials(
    path: Path, folder: Path, description: Description, given: Path, timeout: float
) -> list[Finding]:
    findings = []
    for interface_type, capabilities in description.capabilities.items():
        name = INTERFACE_TYPE_NAMES[interface_type]
        problems = _try_symbols(folder, description, interface_type, timeout)
        findings += [Finding("error", f"binary, {name}", problem.text) for problem in problems]
        # It may run all the same where all that is wrong is a missing function: nobody may call it.
        if any(problem.kind != "missing function" for problem in problems):
            continue
        problems = try_fmu("run", path, interface_type, given=given, timeout=timeout)
        found = _findings(f"trial run, {name}", problems)
        if capabilities.saves_state and not any(finding.level == "error" for finding in found):
            problems = try_fmu("rollback", path, interface_type, given=given, timeout=timeout)
            others = [problem for problem in problems if problem.kind != "step"]  # as in the run
            found += _findings(f"trial save and restore, {name}", others)
        findings += found
    return findings


def _findings(where: str, problems: Iterable[TrialProblem]) -> list[Finding]:
    """Return what trials show; without what is refused, or is not exact, an FMU runs."""
    levels: dict[str, Severity] = {"step": "note", "refused": "warning", "inexact": "warning"}
    findings = []
    for problem in problems:
        findings.append(Finding(levels.get(problem.kind, "error"), where, problem.text))
    return findings


def _try_symbols(
    folder: Path, description: Description, interface_type: InterfaceType, timeout: float
) -> tuple[TrialProblem, ...]:
    """Look the required functions up in the binary for this machine."""
    library = f"{description.capabilities[interface_type].identifier}{SUFFIX}"
    names = required_functions(description, interface_type)
    for platform in folders(description.version):
        file = folder / "binaries" / platform / library
        if file.is_file():
            return attempt("symbols", str(file), *names, timeout=timeout)
    return ()
