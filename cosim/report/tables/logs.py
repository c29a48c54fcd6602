"""What is said of logs: how one is verified, recovered, in which files it is, how two differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeGuard

from cosim.core.recorded.signals import warning_texts
from cosim.instants import NANOSECONDS
from cosim.log import Log
from cosim.log.files import part_paths
from cosim.log.preamble import PARTIAL, PARTIAL_STATUS
from cosim.report.printable import print_notice
from cosim.report.tables.console import Section, Shown, new_table
from cosim.scenario.record import component_record

if TYPE_CHECKING:
    from cosim.core.recorded.run import RecordedRun
    from cosim.log.difference import EventsDifference, LogDifference
    from cosim.log.recovering import RecoveredLog
    from cosim.report.verification import Verification

_MOST_INTERVALS: Final = 8  # of a component that are shown


def show_verification(verification: Verification, path: Path, *, quiet: bool) -> Shown:
    """Show what a replay proves of its log; what is wrong goes to stderr."""
    yield verification.to_dict()
    if verification.passed:
        yield from [] if quiet else [f"{path}: {line}" for line in verification.lines]
        return
    for problem in verification.problems:
        print_notice(f"{path}: {problem}")
    if verification.difference.same_rows and not verification.contradictions:
        return
    for key, (recorded, current) in verification.environment.items():
        print_notice(f"note: {key} was {recorded}, is {current}")
    for name in verification.source.channels:
        bits = component_record(verification.source, name).bits
        if bits is not None:
            print_notice(f"note: {name}: {bits}")


def show_recovery(recovery: RecoveredLog) -> Shown:
    """Show the rows of each component that are there, and the times of those that are lost."""
    content = recovery.to_dict()
    yield content
    table = []
    for name, rows in content["components"].items():
        lost = rows["lost"]
        shown = [f"{one['rows']} from {one['from']} s to {one['to']} s" for one in lost]
        omitted = len(lost) - _MOST_INTERVALS
        if omitted > 0:
            count = sum(one["rows"] for one in lost[_MOST_INTERVALS:])
            plural = "" if omitted == 1 else "s"
            shown[_MOST_INTERVALS:] = [f"{count} in {omitted} more interval{plural}"]
        table.append((name, str(rows["rows"]), "; ".join(shown) or "0"))
    yield new_table("", ("component", "rows", "lost"), table)
    if not recovery.end_is_known:
        yield f"any rows after {content['end']} s are lost, too: the file has no end"
    if not recovery.has_all_messages:
        yield "messages, events or substeps are lost, too, or their number is unknown"
    if recovery.lost_records:
        lost_count = recovery.lost_records
        yield f"metadata records and attachments lost, too: {lost_count}; a replay may need them"
    if not recovery.has_scenario:
        yield "the scenario is lost: the log can be read, but not replayed"
    log = recovery.log
    whole_ns = recovery.whole_until_ns
    if log.status == PARTIAL_STATUS and whole_ns is not None and not log.begins_late:
        whole = whole_ns / NANOSECONDS
        cut = f"with '--to {whole}', 'cosim cut' makes a log that can be replayed"
        yield f"no row is lost up to {whole} s: {cut}"
    yield ended(log)


def ended(log: Log) -> str:
    """Return where a log is, and how its run ended."""
    return f"{log.path}: {', '.join(filter(None, (log.status, log.reason)))}"


def is_rotated(recording: object) -> TypeGuard[Log]:
    """Return whether a recording is the last file of several."""
    return (
        isinstance(recording, Log)
        and recording.status == PARTIAL_STATUS
        and len(part_paths(recording.path)) > 1
    )


def show_rotated(last: Log, wall: Mapping[str, float]) -> Shown:
    """Show how a run ended and which files it wrote; none of them is the whole.

    Parameters
    ----------
    last : Log
        The last of them.
    wall : mapping of name to float
        Wall times [s].
    """
    whole = last.metadata.get(PARTIAL, {})
    content: Section = {
        "logs": [str(path) for path in part_paths(last.path)],
        "status": whole.get("status", ""),
        "reason": whole.get("reason", ""),
        "steps": last.steps,
        "end": last.end_ns / NANOSECONDS,
        "content_hash": whole.get("content_hash", ""),
    }
    yield {**content, "results": dict(last.results), "wall": dict(wall)}
    for text in warning_texts(last.warnings):
        print_notice(f"warning: {text}")
    rows = [
        ("status", ", ".join(filter(None, (content["status"], content["reason"])))),
        ("steps", f"{last.steps}, up to {content['end']} s"),
        ("content hash", content["content_hash"]),
        *(("log", path) for path in content["logs"]),
    ]
    yield new_table("", ("", ""), rows)
    yield (
        "each file has a part of the run; 'cosim merge' joins them, and 'cosim replay' of the "
        "last one replays the run"
    )


def opened_recording(path: Path) -> RecordedRun:
    """Open a recording; of a file of another tool print what is to be known of how it was read."""
    from cosim.scenario.data_files.recording_file import open_recording  # which knows tables, too

    opened = open_recording(path)
    if opened.left_out is not None:
        for warning in opened.warnings:
            print_notice(warning.text)
    return opened


def show_difference(difference: LogDifference) -> Shown:
    """Show how far two logs are apart."""
    yield difference.to_dict()
    columns = ["signal", "", "tolerance", "max |a - b|", "max |a|", "ratio", "first outside"]
    rows = []
    for row in difference.rows:
        outside = ""
        if row.first is not None:
            time = row.first.time_ns / 1e9
            outside = f"{row.first.signal} at {time} s: {', '.join(row.first.texts)}"
        numbers = (row.tolerance, row.largest, row.scale, row.ratio)
        texts = ["" if number is None else f"{number:.3g}" for number in numbers]
        rows.append([row.signal, row.status, *texts, outside])
    if not difference.tol:  # of single signals
        for cells in (columns, *rows):
            del cells[2]
    yield new_table("", columns, rows)
    yield from _notes(difference)


def _notes(difference: LogDifference) -> Iterator[str]:
    """Yield where and what was not compared, and how the events compare."""
    where = "where both have values" if difference.tube is None else "at instants of a within b"
    for row in difference.rows:
        in_a, in_b, both = row.rows
        expected = in_a if difference.tube else max(in_a, in_b)
        if row.status in ("equal", "within", "other times") and both < expected:
            yield (
                f"note: compared only {where}: {row.signal} at {both} instants ({in_a} in a, "
                f"{in_b} in b)"
            )
            break
    for text in difference.not_compared:
        yield f"note: not compared: {text}"
    if all(row.status in ("only in a", "only in b") for row in difference.rows):
        yield "note: no signal of a has the name of one of b; '--map SIGNAL=NAME' pairs them"
    if any(difference.events.events):
        yield _events_text(difference.events)
    if any(row.largest > 0.0 and row.signal.endswith(".delta") for row in difference.rows):
        yield (
            "note: a reconstructed disturbance amplifies rounding errors of y by filter_rate; "
            "give it its own --tol"
        )


def _events_text(difference: EventsDifference) -> str:
    """Return how the jumps compare, in words."""
    in_a, in_b = difference.events
    text = f"events: {in_a} in a, {in_b} in b: "
    first = difference.first
    if first is None:
        return f"{text}{'equal' if difference.equal else 'within the tolerance'}"
    jumps = []
    for jump in (first.a, first.b):
        jumps.append("no jump" if jump is None else f"{jump.cause} {jump.value!r}")
    return (
        f"{text}{difference.outside} of {difference.jumps} jumps differ; first "
        f"{first.signal} at {first.time_ns / 1e9} s: {', '.join(jumps)}"
    )
