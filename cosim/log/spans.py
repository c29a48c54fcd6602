"""Spans of a run: cut out of its log, merged to one, or opened as one where it was rotated.

The result is a log like any other. If it lacks rows of the run, its status is ``partial``, with the
reason, and the result of the whole run, as far as it is known, is the metadata record
``cosim.partial``: parts that are merged to all rows are the log of the run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import final

import numpy as np

from cosim.arrays import Mask, Nanoseconds
from cosim.core.recorded.run import RecordedWindow, span_ns
from cosim.errors import LogError, UsageError
from cosim.instants import NANOSECONDS, Seconds
from cosim.log.container import Container
from cosim.log.files import OwnFile, UnfinishedLog, check_not_read, part_paths
from cosim.log.layout import Part
from cosim.log.metadata import WRITTEN
from cosim.log.pieces import LogPieces, gathered, write_log
from cosim.log.preamble import PARTIAL_STATUS, ResultItems
from cosim.log.reader import Log, open_log
from cosim.temporary import TemporaryFolder


def cut(
    path: Path,
    start: Seconds | None,
    stop: Seconds | None,
    out: Path,
    *,
    names: tuple[str, str] = ("start", "stop"),
    force: bool = False,
) -> Log:
    """Write the rows in ``start <= t <= stop`` to a log, with their messages; return it.

    A message between two communication points goes with the rows after it, as the substeps do that
    lead there. Only chunks that have any of that time are read.

    Parameters
    ----------
    path : Path
    start, stop : float, Decimal or None
        [s]. None: from the first row on, up to the last one.
    out : Path
    names : tuple of str
        What the times are called in messages.
    force : bool
        Replace an existing file.

    Raises
    ------
    UsageError
        If ``start`` is after ``stop``.
    LogError
        If the log cannot be read, has no row in that time, or ``out`` cannot be written or is that
        log.
    """
    first_ns, last_ns = span_ns(start, stop, names)
    check_not_read(out, [path])
    target = UnfinishedLog(out, force=force)
    log = open_log(path)
    file = Container(log.path)
    pieces = LogPieces.of(file)
    span = _CutSpan(pieces, first_ns, last_ns)

    def end(_: str) -> ResultItems:
        if span.first_row is None:
            raise LogError(f"{RecordedWindow(log, first_ns, last_ns).label}: no rows in this span")
        return pieces.end_of_span(span.first_row, span.last_row)

    blocks = file.blocks(first_ns=span.messages_ns[0], last_ns=last_ns)
    return write_log(target, pieces, gathered(blocks, pieces.dtypes, span.has), end)


@final
class _CutSpan:
    """Says which messages are in a span of time, and keeps which rows of it there are."""

    def __init__(self, pieces: LogPieces, first_ns: int | None, last_ns: int | None) -> None:
        grid = pieces.grid
        self._rows_ns = (first_ns, last_ns)
        self.messages_ns = (
            None if first_ns is None else grid.stamp(grid.number(first_ns - 1)) + 1,
            None if last_ns is None else grid.stamp(grid.number(last_ns)),
        )
        self.first_row: int | None = None
        self.last_row = 0

    def has(self, number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        """Return which of some messages are in it."""
        first_ns, last_ns = self._rows_ns if contents is None else self.messages_ns
        inside = np.ones(len(time_ns), np.bool_)
        if first_ns is not None:
            inside &= time_ns >= first_ns
        if last_ns is not None:
            inside &= time_ns <= last_ns
        if contents is None and inside.any():
            own = time_ns[inside]
            first = int(own.min())
            self.first_row = first if self.first_row is None else min(first, self.first_row)
            self.last_row = max(int(own.max()), self.last_row)
        return inside


# --- several to one ---


@dataclass(frozen=True, slots=True)
class _RunPart:
    """A log, and the first and last row of each component that has any [ns]."""

    log: Log
    file: Container
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
    check_not_read(out, paths)
    target = UnfinishedLog(out, force=force)
    parts = sorted((_part(path) for path in paths), key=lambda part: part.begin)
    for earlier, later in pairwise(parts):
        problem = _contradiction(earlier.pieces, later.pieces)
        if problem:
            raise LogError(
                f"{earlier.log.path} and {later.log.path} are not parts of the same run: {problem} "
                "differs"
            )
    _check_consecutive(parts)
    known = next((part.pieces for part in parts if part.pieces.run_result), parts[0].pieces)

    def end(content_hash: str) -> ResultItems:
        of_run = known.run_result.get("content_hash", content_hash)
        if content_hash != of_run and _has_all_rows(parts, known):
            raise LogError(
                f"{parts[0].log.path} and the parts after it have all rows of the run, but not its "
                f"values: expected the content hash {of_run}, got {content_hash}"
            )
        return known.end_of_span(parts[0].begin, max(part.end for part in parts))

    def is_wanted(number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        return np.ones(len(time_ns), np.bool_)

    blocks = (gathered(part.file.blocks(), part.pieces.dtypes, is_wanted) for part in parts)
    return write_log(target, known, chain.from_iterable(blocks), end)


def _part(path: Path) -> _RunPart:
    log = open_log(path)
    bounds: dict[str, tuple[int, int]] = {}
    for name, time_ns, _ in log.blocks_of(list(log.channels)):
        if len(time_ns):
            first, _ = bounds.get(name, (int(time_ns[0]), 0))
            bounds[name] = first, int(time_ns[-1])
    if not bounds:
        raise LogError(f"{path} has no rows; omit it")
    recorded = log.recorded_hash
    found = recorded if recorded is None else log.content_hash()
    if found != recorded:  # what is made of them would get a hash that fits
        raise LogError(
            f"{log.path}: rows or signal declarations were changed after they were recorded: "
            f"expected the content hash {recorded}, got {found}"
        )
    file = Container(log.path)
    return _RunPart(log, file, LogPieces.of(file), bounds)


def _row_after(pieces: LogPieces, time_ns: int, part: Part) -> int:
    """Return where a component has its next row [ns]."""
    return pieces.grid.stamp(pieces.grid.number(time_ns) + part.channel.period)


def _has_all_rows(parts: Sequence[_RunPart], pieces: LogPieces) -> bool:
    """Return whether consecutive parts have as many rows of every component as the run had."""
    end = pieces.run_result.get("end_ns", "")
    if not end.isdecimal():
        return False
    for part in pieces.parts.values():
        name = part.channel.name
        bounds = [own.bounds[name] for own in parts if name in own.bounds]
        if not bounds or bounds[0][0] > pieces.start_ns:
            return False
        if _row_after(pieces, bounds[-1][1], part) <= int(end):
            return False
    return True


def _contradiction(a: LogPieces, b: LogPieces) -> str:
    """Return what two logs declare differently; nothing: they agree."""
    if list(a.channels) != list(b.channels) or list(a.schemas) != list(b.schemas):
        return "the declaration of the channels"
    for name in dict.fromkeys([*a.kept_metadata, *b.kept_metadata]):
        if name != WRITTEN and a.kept_metadata.get(name) != b.kept_metadata.get(name):
            return f"the metadata {name!r}"
    for name in dict.fromkeys([*a.kept_attachments, *b.kept_attachments]):
        one, other = (own.kept_attachments.get(name) for own in (a, b))
        if one is None or other is None or one.data != other.data:
            return f"the attachment {name!r}"
    is_other = a.run_result and b.run_result and a.run_result != b.run_result
    return "the result of the run" if is_other else ""


def _check_consecutive(parts: Sequence[_RunPart]) -> None:
    """Check that every component's rows go on where those before end.

    Raises
    ------
    LogError
        If they overlap, or some are missing between.
    """
    pieces = parts[0].pieces
    for name, declared in {part.channel.name: part for part in pieces.parts.values()}.items():
        own = [(part.bounds[name], part.log) for part in parts if name in part.bounds]
        for ((_, last), earlier), ((first, _), later) in pairwise(own):
            where = f"{earlier.path} has rows of {name!r} up to {last / NANOSECONDS} s"
            begins = f"{later.path} begins at {first / NANOSECONDS} s"
            if first <= last:
                raise LogError(f"{where}, {begins}: they overlap; cut one of them first")
            due = _row_after(pieces, last, declared)
            if first != due:
                raise LogError(
                    f"{where}, {begins}: the rows from {due / NANOSECONDS} s on are missing "
                    "between them"
                )


def open_joined(log: Path | str | Log) -> Log:
    """Open a log; a file of one that was rotated together with those before it.

    They are merged into a temporary file, which is called as the last of them.

    Raises
    ------
    UsageError
        As from :func:`open_log`.
    LogError
        If a file before it is missing or not of the same run, or one cannot be read.
    """
    last = log if isinstance(log, Log) else open_log(log)
    paths = part_paths(last.path)
    is_later_part = last.status in {PARTIAL_STATUS, "unfinished"} and last.begins_late
    if len(paths) == 1 or not is_later_part:
        return last
    for number, path in enumerate(paths[:-1], start=1):
        if not path.exists():
            raise LogError(
                f"{last.path} is part {len(paths)} of its log, which needs the earlier parts "
                f"beside it; part {number} is missing: {path}"
            )
    try:
        with TemporaryFolder("parts") as folder:
            joined = merge(paths, folder / "joined.mcap")
            own = OwnFile(joined.path)
            own.hold(last.path)
            return Log(last.path, own)
    except OSError as error:
        raise LogError(f"{last.path} cannot be joined: {error.strerror or error}") from error
