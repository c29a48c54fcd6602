"""Merge logs of consecutive spans of one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cosim.arrays import Mask, Nanoseconds
from cosim.errors import LogError, UsageError
from cosim.instants import NANOSECONDS
from cosim.log.contents.environment import WRITTEN
from cosim.log.contents.result import PARTIAL_STATUS
from cosim.log.editing.batches import gathered
from cosim.log.editing.copying import PartEnd, write_log
from cosim.log.editing.cutting import part_text
from cosim.log.editing.pieces import LogPieces, read_pieces
from cosim.log.mcap_file.chunks import MessageBatch
from cosim.log.mcap_file.unfinished import UnfinishedLog
from cosim.log.reading.container import Container
from cosim.log.reading.reader import Log, open_log


@dataclass(frozen=True, slots=True)
class _RunPart:
    """A log, and the first and last row of each component that has any [ns]."""

    log: Log
    pieces: LogPieces
    bounds: Mapping[str, tuple[int, int]]

    @property
    def begin(self) -> int:
        """The first row of all."""
        return min(first for first, _ in self.bounds.values())

    @property
    def end(self) -> int:
        """The last row of all."""
        return max(last for _, last in self.bounds.values())


def merge(paths: Sequence[Path], out: Path, *, force: bool = False) -> Log:
    """Write the rows and messages of logs of consecutive spans to one log; return it.

    Parameters
    ----------
    paths : sequence of Path
        In any order.
    out : Path
    force : bool
        Replace an existing file.

    Raises
    ------
    UsageError
        If there are fewer than two.
    LogError
        If they are not spans of one run, overlap, or rows are missing between them; if the rows of
        one, or of all, are not those that were recorded; if one cannot be read, or ``out`` cannot
        be written or is one of them.
    """
    if len(paths) < 2:
        raise UsageError(f"expected at least two logs to merge, got {len(paths)}")
    target = UnfinishedLog(out, force=force)
    target.check_not_read(paths)
    spans = sorted((_span(path) for path in paths), key=lambda span: span.begin)
    for earlier, later in pairwise(spans):
        _check_same_run(earlier, later)
    _check_consecutive(spans)
    known = next((span.pieces for span in spans if span.pieces.run_result), spans[0].pieces)
    last_row = max(span.end for span in spans)
    text = part_text(spans[0].begin, last_row)
    end = PartEnd(PARTIAL_STATUS, text, known.steps_to(last_row), last_row)

    def checked_end(content_hash: str) -> PartEnd:
        of_run = known.run_result.get("content_hash", content_hash)
        if content_hash != of_run and _has_all_rows(spans, known):
            raise LogError(
                f"{spans[0].log.path} and the parts after it have all rows of the run, but not its "
                f"values: expected the content hash {of_run}, got {content_hash}"
            )
        return end

    return write_log(target, known, _batches(spans), checked_end)


def _span(path: Path) -> _RunPart:
    log = open_log(path)
    bounds = {}
    for name in log.channels:
        times = [time_ns for time_ns, _ in log.blocks(name) if len(time_ns)]
        if times:
            bounds[name] = int(times[0][0]), int(times[-1][-1])
    if not bounds:
        raise LogError(f"{path} has no rows; omit it")
    _check_hash(log)
    return _RunPart(log, read_pieces(log.path), bounds)


def _check_hash(log: Log) -> None:
    """Check that the rows of a log are those that were recorded.

    Raises
    ------
    LogError
        If they are not: what is made of them would get a hash that fits.
    """
    recorded = log.recorded_hash
    if recorded is None:
        return
    found = log.content_hash()
    if found != recorded:
        raise LogError(
            f"{log.path}: rows or signal declarations were changed after they were recorded: "
            f"expected the content hash {recorded}, got {found}"
        )


def _has_all_rows(spans: Sequence[_RunPart], pieces: LogPieces) -> bool:
    """Return whether consecutive parts have as many rows of every component as the run had."""
    end = pieces.run_result.get("end_ns", "")
    if not end.isdecimal():
        return False
    for part in pieces.parts.values():
        bounds = [
            span.bounds[part.channel.name] for span in spans if part.channel.name in span.bounds
        ]
        if not bounds:
            return False
        if bounds[0][0] > pieces.start_ns or pieces.row_after(bounds[-1][1], part) <= int(end):
            return False
    return True


def _check_same_run(a: _RunPart, b: _RunPart) -> None:
    """Check that two logs declare the same, so that their rows are of one run.

    Raises
    ------
    LogError
        If they do not.
    """
    problem = _contradiction(a.pieces, b.pieces)
    if problem:
        raise LogError(
            f"{a.log.path} and {b.log.path} are not parts of the same run: {problem} differs"
        )


def _contradiction(a: LogPieces, b: LogPieces) -> str:
    """Return what two logs declare differently; nothing: they agree."""
    if list(a.channels) != list(b.channels) or list(a.schemas) != list(b.schemas):
        return "the declaration of the channels"
    names = dict.fromkeys([*a.kept_metadata, *b.kept_metadata])
    for name in names:
        if name != WRITTEN and a.kept_metadata.get(name) != b.kept_metadata.get(name):
            return f"the metadata {name!r}"
    contents_a = {item.name: item.data for item in a.kept_attachments}
    contents_b = {item.name: item.data for item in b.kept_attachments}
    for name in dict.fromkeys([*contents_a, *contents_b]):
        if contents_a.get(name) != contents_b.get(name):
            return f"the attachment {name!r}"
    is_other = a.run_result and b.run_result and a.run_result != b.run_result
    return "the result of the run" if is_other else ""


def _check_consecutive(spans: Sequence[_RunPart]) -> None:
    """Check that every component's rows go on where those before end.

    Raises
    ------
    LogError
        If they overlap, or some are missing between.
    """
    pieces = spans[0].pieces
    parts = {part.channel.name: part for part in pieces.parts.values()}
    for name, part in parts.items():
        own = [(span.bounds[name], span.log) for span in spans if name in span.bounds]
        for ((_, last), earlier), ((first, _), later) in pairwise(own):
            where = f"{earlier.path} has rows of {name!r} up to {last / NANOSECONDS} s"
            begins = f"{later.path} begins at {first / NANOSECONDS} s"
            if first <= last:
                raise LogError(f"{where}, {begins}: they overlap; cut one of them first")
            due = pieces.row_after(last, part)
            if first != due:
                raise LogError(
                    f"{where}, {begins}: the rows from {due / NANOSECONDS} s on are missing "
                    "between them"
                )


def _batches(spans: Sequence[_RunPart]) -> Iterator[list[MessageBatch]]:
    def is_wanted(number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        return np.ones(len(time_ns), np.bool_)

    for span in spans:
        yield from gathered(Container(span.log.path).blocks(), span.pieces.dtypes, is_wanted)
