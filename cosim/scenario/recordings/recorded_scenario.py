"""What a log has for its replay: its scenario, all rows of its run, and the FMUs of its plants.

An FMU is code. What is taken out of a log, or is found where the log says that it was, is what the
run had, bit for bit, or it is refused. It is copied into a folder of our own under a name that is
its hash: no name that a log has becomes a path. The copy is unpacked as any FMU is
(:mod:`cosim.fmi.reading.archive`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeGuard

from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.run import SCENARIO_FILE, RecordedRun
from cosim.errors import FmuError, LogError, UsageError, command, flag, listing, quoted
from cosim.files import read_bounded
from cosim.log import Log
from cosim.log.metadata import json_table
from cosim.log.preamble import PARTIAL_STATUS
from cosim.scenario.building.build import read
from cosim.scenario.document.document import Document
from cosim.scenario.kinds import KINDS, Kind
from cosim.scenario.kinds.build_record import RecordedFmu
from cosim.scenario.kinds.plants import FmuKind
from cosim.scenario.record import (
    MEANS,
    component_metadata,
    component_record,
    recorded_window,
    replay_origin,
    run_metadata,
)
from cosim.scenario.recordings.log_contents import MOST_EMBEDDED, embedded_name
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.temporary import TemporaryFolder

_LARGE: Final = 2**25  # bytes of rows
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


def is_large(source: RecordedRun) -> TypeGuard[Log]:
    """Return whether the rows of a log take much memory."""
    return isinstance(source, Log) and source.row_bytes > _LARGE


# --- its scenario ---


def recorded_document(log: RecordedRun) -> Document:
    """Return the scenario of a log.

    Raises
    ------
    LogError
        If the log carries none.
    """
    edits = run_metadata(log).get("edits")
    if SCENARIO_FILE not in log.attachments or edits is None:
        raise LogError(
            f"the log has no {SCENARIO_FILE}; expected a log written by {command('run')}"
        )
    try:
        text = log.attachment(SCENARIO_FILE).decode()
        what = f"{log.label}: its scenario"
        document = Document.recorded(text, edits, Path.cwd(), what)
        return replace(document, foreign_kinds=_foreign_kinds(log))
    except ValueError as error:
        raise LogError(f"{log.label}: its scenario cannot be understood: {error}") from error


def _foreign_kinds(log: RecordedRun) -> frozenset[str]:
    """Return the kinds of a log that are not cosim's: those of its components of a user's class.

    The packages that declared them need not be installed where the log is read.
    """
    kinds = set()
    for name in declared_channels(log.channels):
        texts = component_metadata(log, name)
        # the texts of thousands of components take long to be checked
        if '"code"' in texts.get("metadata", "") and component_record(log, name).code is not None:
            kinds.add(str(json_table(texts.get("table", "{}")).get("kind")))
    return frozenset(kinds.difference(KINDS))


def recorded_stop(log: RecordedRun) -> float:
    """Return where the scenario of a log ends [s], which its run need not have reached.

    Raises
    ------
    LogError
        If the log carries none.
    ScenarioError
        If that is no TOML.
    """
    scenario, _ = read(recorded_document(log))
    return scenario.file.scenario.stop


# --- its rows ---


def check_rows(source: RecordedRun) -> None:
    """Check that a log has all rows from the start of its run to its end.

    Nothing can be computed without those before, and a replay goes on to the end.

    Raises
    ------
    LogError
        If it is a window of a replay, has no step, is a part of a log that leaves rows out, or ends
        elsewhere than its rows.
    """
    window = recorded_window(source)
    if window is not None:
        raise LogError(
            f"{source.label}: a replay that starts at {window[0]} s and ends at {window[1]} s "
            f"only; expected a log from the start of its run, such as {replay_origin(source).log}"
        )
    if source.steps == 0:
        raise LogError("the log has no step to replay; it has no more than its initial row")
    is_partial = source.status == PARTIAL_STATUS
    begin_ns = source.grid.start_ns
    end_ns = source.end_ns
    for name in list(source.channels)[: None if is_partial else 1]:
        period = source.channels[name].period
        count = first_ns = last_ns = 0
        for time_ns, _ in source.blocks(name):
            if len(time_ns):
                first_ns = first_ns if count else int(time_ns[0])
                last_ns = int(time_ns[-1])
                count += len(time_ns)
        needed = source.steps // period + 1
        is_to_end = 0 <= end_ns - last_ns < period * source.step_ns
        if (count, first_ns) != (needed, begin_ns) or not is_to_end:
            way_out = ""
            if is_partial:
                way_out = (
                    f"; it is partial, {source.reason}: 'cosim merge' joins parts, 'cosim cut "
                    "--to' keeps what is complete"
                )
            found = f"{count}, from {first_ns / 1e9} s to {last_ns / 1e9} s" if count else "none"
            raise LogError(
                f"{source.label}: a replay requires all rows from {begin_ns / 1e9} s to "
                f"{end_ns / 1e9} s, {needed} of {name!r}, got {found}{way_out}"
            )


def load_rows(source: RecordedRun, components: Sequence[str]) -> None:
    """Read the rows of components in one pass over the file.

    Of a large log only those are read that share chunks with others: of them every part would take
    all of its chunks.
    """
    if is_large(source):
        components = [name for name in components if source.shares_chunks(name)]
    if components:  # none would be all
        source.load(*components)


# --- its FMUs ---


def rerun_plants(
    source: RecordedRun,
    specs: Mapping[str, Kind],
    request: ReplayRequest,
    resources: ExitStack,
) -> tuple[dict[str, Kind], dict[str, RecordedFmu]]:
    """Return the tables of the plants that are computed again, and copies of the FMUs they had.

    Parameters
    ----------
    source : RecordedRun
    specs : mapping of component name to Kind
        All; the tables of FMUs say where each is, if not in the log.
    request : ReplayRequest
        Those that it swaps are computed anyway.
    resources : ExitStack
        Removes the copies.

    Raises
    ------
    UsageError
        If there are FMUs and their code is not allowed to run, or a plant was swapped in the run.
    LogError
        If the log does not say which FMU a component had.
    FmuError
        If there is no such FMU, or another one in its place.
    """
    again = {}
    for name, spec in specs.items():
        if spec.is_rerun and name not in request.swaps:
            again[name] = spec.with_code()
    paths = {name: spec.path for name, spec in again.items() if isinstance(spec, FmuKind)}
    if paths and not request.allow_code:
        raise UsageError(
            f"{flag('rerun')} runs the code of the FMUs {listing([*paths])}; expected "
            f"{flag('allow_code')}, too"
        )
    for event in source.events():
        name = Port.parse(event.signal).component
        if event.cause == "swap" and name in again:
            raise UsageError(
                f"{flag('rerun')}: {name!r} was swapped during the run, at t = "
                f"{event.time_ns / 1e9} s, which a replay cannot repeat; run the scenario"
            )
    copies = {}
    if paths:
        folder = resources.enter_context(TemporaryFolder("fmu"))
        copies = {name: _recorded_fmu(source, name, path, folder) for name, path in paths.items()}
    return again, copies


def _recorded_fmu(source: RecordedRun, name: str, path: str, folder: Path) -> RecordedFmu:
    """Return a copy of the FMU of a component: that in the log, else the same in a file."""
    record = component_record(source, name)
    sha256 = record.sha256
    if sha256 is None or not _SHA256.fullmatch(sha256):
        raise LogError(
            f"{source.label}: SHA-256 of the FMU of {name!r}: expected 64 hexadecimal digits, got "
            f"{quoted(sha256)}"
        )
    paths = list(dict.fromkeys([path, record.path or path]))
    others: dict[str, str] = {}  # hashes by place
    for place, content in _fmus_found(source, sha256, paths):
        found = hashlib.sha256(content).hexdigest()
        if found == sha256:
            copy = folder / embedded_name(sha256)
            copy.write_bytes(content)
            means = MEANS not in component_metadata(source, name)
            return RecordedFmu(copy, record.path or path, means)
        others.setdefault(place, found)
    for place, found in others.items():
        raise FmuError(
            f"the FMU of {name!r}: {place}: expected the SHA-256 {sha256} that the log recorded, "
            f"got {found}; it is not run"
        )
    raise FmuError(
        f"the FMU of {name!r} is neither in the log nor in a readable file: {', '.join(paths)}; "
        f"restore one of them, or record with {flag('embed')} to put the FMU into the log"
    )


def _fmus_found(
    source: RecordedRun, sha256: str, paths: Sequence[str]
) -> Iterator[tuple[str, bytes]]:
    """Yield the content of what may be an FMU, and where it is: in the log, or else in files."""
    attached = embedded_name(sha256)
    if attached in source.attachments:
        yield f"the FMU in {source.label}", source.attachment(attached)
        return
    # from the working folder; who is in another one has them beside the log, or above it
    folders = source.path.parents[:2] if isinstance(source, Log) else []
    for place in [*paths, *(str(folder / path) for folder in folders for path in paths)]:
        with suppress(OSError):
            yield place, read_bounded(Path(place), MOST_EMBEDDED)
