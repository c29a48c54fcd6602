"""Plants of a run in its replay: computed again by their models, or by the FMUs of its log.

An FMU is code. What is taken out of a log, or is found where the log says that it was, is what the
run had, bit for bit, or it is refused. It is copied into a folder of our own under a name that is
its hash: no name that a log has becomes a path. The copy is unpacked as any FMU is
(:mod:`cosim.fmi.reading.archive`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from cosim.core.port import Port
from cosim.core.recording import CompleteRecording
from cosim.errors import FmuError, LogError, UsageError, flag, listing, quoted
from cosim.files import read_bounded
from cosim.log import Attachment, Log
from cosim.log.mcap_file.places import MOST_ATTACHED
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.build_record import RecordedFmu
from cosim.scenario.kinds.plants import FmuKind
from cosim.scenario.record import (
    MEANS,
    component_metadata,
    component_record,
    component_table,
    recorded_warnings,
)
from cosim.scenario.recordings.swap_report import SWAP_WARNINGS
from cosim.temporary import TemporaryFolder

MOST_EMBEDDED: Final = MOST_ATTACHED - 2**12  # bytes; the record of an attachment has a head, too
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


def embedded_name(sha256: str) -> str:
    """Return the name of the attachment that an FMU is, by its hash."""
    return f"{sha256}.fmu"


def embedded_fmus(files: Mapping[str, Path]) -> list[Attachment]:
    """Return FMUs as attachments of a log.

    Parameters
    ----------
    files : mapping of SHA-256 to Path

    Raises
    ------
    FmuError
        If one is too large to be read back, or is not the one any more that was opened.
    """
    attachments = []
    for sha256, path in files.items():
        try:
            size = path.stat().st_size
            if size > MOST_EMBEDDED:
                raise FmuError(
                    f"{path}: has {size} bytes, but a log takes FMUs of at most {MOST_EMBEDDED}; "
                    f"omit {flag('embed')}"
                )
            content = read_bounded(path, MOST_EMBEDDED)
        except OSError as error:
            raise FmuError(f"{path} cannot be read: {error.strerror or error}") from error
        if hashlib.sha256(content).hexdigest() != sha256:
            raise FmuError(f"{path}: changed while it was being read; try again")
        attachments.append(Attachment(embedded_name(sha256), "application/zip", content))
    return attachments


def rerun_specs(
    source: CompleteRecording,
    specs: Mapping[str, Kind],
    swapped: Collection[str],
    *,
    allow_code: bool,
) -> dict[str, Kind]:
    """Return the tables of the plants that are computed again, which then are computable.

    Parameters
    ----------
    source : CompleteRecording
    specs : mapping of component name to Kind
        All.
    swapped : collection of str
        Those that are replaced by others, and computed anyway.
    allow_code : bool

    Raises
    ------
    UsageError
        If there are FMUs and their code is not allowed to run, or a plant was swapped in the run.
    """
    again = {}
    for name, spec in specs.items():
        if spec.is_rerun and name not in swapped:
            again[name] = spec.with_code()
    fmus = [name for name, spec in again.items() if isinstance(spec, FmuKind)]
    if fmus and not allow_code:
        raise UsageError(
            f"{flag('rerun')} runs the code of the FMUs {listing(fmus)}; expected "
            f"{flag('allow_code')}, too"
        )
    for event in source.events():
        name = Port.parse(event.signal).component
        if event.cause == "swap" and name in again:
            raise UsageError(
                f"{flag('rerun')}: {name!r} was swapped during the run, at t = "
                f"{event.time_ns / 1e9} s, which a replay cannot repeat; run the scenario"
            )
    return again


def recorded_fmus(
    source: CompleteRecording, specs: Mapping[str, Kind], resources: ExitStack
) -> dict[str, RecordedFmu]:
    """Return copies of the FMUs that components had in a recorded run, by component.

    Parameters
    ----------
    source : CompleteRecording
    specs : mapping of component name to Kind
        Those that are computed again; the tables of FMUs say where each is, if not in the log.
    resources : ExitStack
        Removes the copies.

    Raises
    ------
    LogError
        If the log does not say which FMU a component had.
    FmuError
        If there is no such FMU, or another one in its place.
    """
    paths = {name: spec.path for name, spec in specs.items() if isinstance(spec, FmuKind)}
    if not paths:
        return {}
    folder = resources.enter_context(TemporaryFolder("fmu"))
    copies = {}
    for name, path in paths.items():
        record = component_record(source, name)
        sha256 = record.sha256
        if sha256 is None or not _SHA256.fullmatch(sha256):
            raise LogError(
                f"{source.label}: SHA-256 of the FMU of {name!r}: expected 64 hexadecimal digits, "
                f"got {quoted(sha256)}"
            )
        copy = folder / embedded_name(sha256)
        copy.write_bytes(_content(source, name, sha256, [path, record.path or path]))
        means = MEANS not in component_metadata(source, name)
        copies[name] = RecordedFmu(copy, record.path or path, means)
    return copies


def _content(source: CompleteRecording, name: str, sha256: str, paths: Collection[str]) -> bytes:
    """Return the bytes of an FMU: those in the log, else those of a file, if they are the same."""
    tried = list(dict.fromkeys(paths))
    # from the working folder; who is in another one has them beside the log, or above it
    folders = source.path.parents[:2] if isinstance(source, Log) else []
    places = [*tried, *(str(folder / path) for folder in folders for path in tried)]
    attached = embedded_name(sha256)
    if attached in source.attachments:
        places = [f"the FMU in {source.label}"]
    others: dict[str, str] = {}  # hashes by place
    for place in places:
        try:
            if attached in source.attachments:
                content = source.attachment(attached)
            else:
                content = read_bounded(Path(place), MOST_EMBEDDED)
        except OSError:
            continue
        found = hashlib.sha256(content).hexdigest()
        if found == sha256:
            return content
        others.setdefault(place, found)
    for place, found in others.items():
        raise FmuError(
            f"the FMU of {name!r}: {place}: expected the SHA-256 {sha256} that the log recorded, "
            f"got {found}; it is not run"
        )
    raise FmuError(
        f"the FMU of {name!r} is neither in the log nor in a readable file: {', '.join(tried)}; "
        f"restore one of them, or record with {flag('embed')} to put the FMU into the log"
    )


def add_recorded_reports(experiment: Experiment, source: CompleteRecording) -> None:
    """Add the recorded swap reports of what is computed again.

    What a plant of the run had replaced is not there any more to be compared with.
    """
    metadata = experiment.built.metadata
    compared = {name for name, text in experiment.built.warnings if text.startswith(SWAP_WARNINGS)}
    again = metadata.keys() - set(experiment.recorded) - compared
    again = {name for name in again if "swap_report" not in metadata[name]}
    for name in again:
        recorded = component_table(source, name)
        if "swap_report" in recorded:
            experiment.built.add_metadata(name, {"swap_report": recorded["swap_report"]})
    for name, text in recorded_warnings(source):
        if name in again and text.startswith(SWAP_WARNINGS):
            experiment.built.warn(name, text)
