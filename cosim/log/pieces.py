"""A log written from the pieces and messages of other logs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from typing import Any, Final, TypeAlias

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from cosim.arrays import Mask, Nanoseconds
from cosim.errors import LogError
from cosim.instants import Grid
from cosim.log.chunks import MessageBatch, Workers, separate_chunks
from cosim.log.container import Container, OtherRecord, scan
from cosim.log.files import UnfinishedLog
from cosim.log.layout import Part, read_parts, record_dtype
from cosim.log.live_file import LiveFile
from cosim.log.mcap_records import FileHead, RecordGroup, attachment_group, record_header
from cosim.log.metadata import json_table, library_name, recorded_start_ns, verify_checksum
from cosim.log.preamble import (
    PARTIAL,
    PARTIAL_STATUS,
    RESULT,
    RESULT_FILE,
    WHOLE,
    ResultItems,
    result_record,
    span_text,
)
from cosim.log.reader import Log
from cosim.log.rows import record_times

OF_THE_END: Final = (RESULT, PARTIAL)  # metadata that a part has of its own
# Returns which messages of a channel are wanted, by their times and records.
MessageFilter: TypeAlias = Callable[[int, Nanoseconds, list[bytes] | None], Mask]
_Chosen: TypeAlias = tuple[bytes, Nanoseconds, Nanoseconds]  # records, their times, their sizes

_LOG_TIME: Final = slice(6, 14)  # of a message record's content
_GATHERED_BYTES: Final = 2**22


@dataclass(frozen=True)
class LogPieces:
    """Everything but rows and messages, as it stands in a file.

    Parameters
    ----------
    schemas : sequence of Schema
    channels : sequence of Channel
    parts : mapping of channel id to Part
        Those of components.
    metadata : mapping of name to items
        With their checksums.
    attachments : sequence of Attachment
    """

    schemas: Sequence[records.Schema]
    channels: Sequence[records.Channel]
    parts: Mapping[int, Part]
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Sequence[records.Attachment]

    @staticmethod
    def of(file: Container) -> LogPieces:
        """Read the pieces of a file, of those channels whose schemas are there.

        Raises
        ------
        LogError
            If one is damaged, or no channel is of a component.
        """
        schemas = file.schemas()
        channels = [own for own in file.channels().values() if own.schema_id in schemas]
        used = {channel.schema_id for channel in channels}
        metadata = {item.name: item.metadata for item in file.metadata()}
        attachments = [file.attachment(span) for span in file.attachments().values()]
        if not any("cosim.component" in channel.metadata for channel in channels):
            raise LogError(
                f"{file.path}: no intact channel of a component, neither in the head of the file "
                "nor in its summary, so the rows cannot be interpreted"
            )
        return LogPieces(
            [schema for number, schema in sorted(schemas.items()) if number in used],
            sorted(channels, key=lambda channel: int(channel.id)),
            read_parts(file.path, {channel.id: channel for channel in channels}),
            metadata,
            attachments,
        )

    @cached_property
    def dtypes(self) -> dict[int, np.dtype[np.void]]:
        """The dtypes of message records of components by channel id."""
        return {number: record_dtype(part.size) for number, part in self.parts.items()}

    @property
    def run_result(self) -> dict[str, str]:
        """How the whole run ended, with its content hash; empty: that is not known."""
        for name in (PARTIAL, RESULT):
            if name in self.metadata:
                result = verify_checksum(name, self.metadata[name])
                return {} if result.get("status") == PARTIAL_STATUS else result
        return {}

    @property
    def start_ns(self) -> int:
        """Where the rows of the run begin [ns]; 0 if that is not recorded."""
        return recorded_start_ns(self.metadata) or 0

    @property
    def grid(self) -> Grid:
        """The communication points of the run."""
        return Grid(self.start_ns, next(iter(self.parts.values())).step_ns)

    @property
    def kept_metadata(self) -> dict[str, Mapping[str, str]]:
        """The metadata that every part of the run has."""
        names = [name for name in self.metadata if name not in OF_THE_END]
        return {name: self.metadata[name] for name in names}

    @property
    def kept_attachments(self) -> dict[str, records.Attachment]:
        """The attachments that every part of the run has."""
        return {item.name: item for item in self.attachments if item.name != RESULT_FILE}

    @property
    def result_file(self) -> bytes | None:
        """What was recorded of the end of the run; None: nothing."""
        contents = [item.data for item in self.attachments if item.name == RESULT_FILE]
        return contents[-1] if contents else None

    def end_of(self, status: str, reason: str, last_row_ns: int) -> ResultItems:
        """Return how a part ends, which has rows up to an instant [ns]."""
        steps = max(self.grid.number(last_row_ns), 0)
        return {"status": status, "reason": reason, "steps": steps, "end_ns": last_row_ns}

    def end_of_span(self, first_row_ns: int, last_row_ns: int) -> ResultItems:
        """Return how a part ends that has the rows of a span of time [ns]."""
        reason = f"the part {span_text(first_row_ns, last_row_ns)}"
        return self.end_of(PARTIAL_STATUS, reason, last_row_ns)


def write_log(
    target: UnfinishedLog,
    pieces: LogPieces,
    batches: Iterable[list[MessageBatch]],
    end: Callable[[str], ResultItems],
) -> Log:
    """Write a log, and return it.

    Where its rows turn out to be all those of the run, it ends as that did.

    Parameters
    ----------
    target : UnfinishedLog
    pieces : LogPieces
    batches : iterable of list of MessageBatch
    end : callable
        Is called with the content hash when all messages are written; returns how a part ends.

    Raises
    ------
    LogError
        If a file exists there and is to stay, or it cannot be written.
    """
    target.check_free()
    head = FileHead(library=library_name())
    head.copy(pieces.schemas, pieces.channels)
    for name, items in pieces.kept_metadata.items():
        head.metadata(name, dict(items))
    for item in pieces.kept_attachments.values():
        head.attachment(item.name, item.media_type, item.data)
    try:
        file = LiveFile(target.create(), head.data, head.summary())
        with closing(Workers()) as workers:
            for group in batches:
                file.commit(separate_chunks(group, "zstd", workers))
        file.keep_tail()
        content_hash = Log(target.path, target.own).content_hash()
        for group_of_end in _end_groups(pieces, end(content_hash), content_hash):
            file.commit(group_of_end)
        file.close()
        target.publish()
        return Log(target.path, target.own)
    except OSError as error:
        raise LogError(f"{target.path} cannot be written: {error.strerror or error}") from error
    finally:
        target.discard()


def _end_groups(pieces: LogPieces, end: ResultItems, content_hash: str) -> list[RecordGroup]:
    """Return the records that tell of the end: those of the run, where all its rows are here."""
    of_run = pieces.run_result
    is_part = PARTIAL in pieces.metadata
    text = pieces.result_file
    values: dict[str, Any] = {}
    with suppress(ValueError):  # what cannot be read loses no row
        values = {} if text is None else json_table(text)
    if of_run.get("content_hash") == content_hash:
        if text is None or is_part:
            whole = values.get(WHOLE)
            counts = {key: of_run.get(key, "") for key in ("steps", "end_ns")}
            numbers = {key: int(count) for key, count in counts.items() if count.isdecimal()}
            text = _json({**(whole if isinstance(whole, dict) else values), **of_run, **numbers})
        return [
            result_record(RESULT, of_run),
            attachment_group(RESULT_FILE, "application/json", text),
        ]
    items = {**end, "content_hash": content_hash}
    groups = [result_record(RESULT, items)]
    if of_run:
        groups.append(result_record(PARTIAL, of_run))
    if not is_part:  # they are of the whole run, whose last row is another one
        values = {WHOLE: values} if of_run and values else {}
    groups.append(attachment_group(RESULT_FILE, "application/json", _json({**values, **items})))
    return groups


def _json(items: Mapping[str, Any]) -> bytes:
    return json.dumps(items, indent=2).encode()


# --- messages ---


def gathered(
    blocks: Iterable[bytes | memoryview],
    dtypes: Mapping[int, np.dtype[np.void]],
    wanted: MessageFilter,
) -> Iterator[list[MessageBatch]]:
    """Yield the wanted messages of chunks, one batch a channel, many chunks at a time.

    Parameters
    ----------
    blocks : iterable of bytes or memoryview
        The records of chunks.
    dtypes : mapping of channel id to dtype
        Of the rows of components.
    wanted : callable
        Is asked once for every run of messages of a channel, in the order of the file; the records
        are None for rows.

    Raises
    ------
    ValueError
        If a block is not a sequence of records.
    """
    waiting: dict[int, list[_Chosen]] = {}
    size = 0
    for block in blocks:
        for number, chosen in _chosen(block, dtypes, wanted):
            waiting.setdefault(number, []).append(chosen)
            size += len(chosen[0])
        if size >= _GATHERED_BYTES:
            yield _joined(waiting)
            waiting = {}
            size = 0
    if waiting:
        yield _joined(waiting)


def _chosen(
    block: bytes | memoryview, dtypes: Mapping[int, np.dtype[np.void]], wanted: MessageFilter
) -> Iterator[tuple[int, _Chosen]]:
    """Yield the wanted rows of a chunk, then its other messages, by channel id."""
    others: dict[int, list[bytes]] = {}
    for item in scan(block, dtypes):
        if not isinstance(item, OtherRecord):
            number, rows = item
            time_ns = record_times(rows)
            kept = wanted(number, time_ns, None)
            if kept.any():
                chosen = rows if kept.all() else rows[kept]
                sizes = np.full(len(chosen), rows.itemsize, np.int64)
                yield number, (chosen.tobytes(), time_ns[kept], sizes)
        elif item.opcode == Opcode.MESSAGE:
            others.setdefault(item.channel_id, []).append(item.content)
    for number, contents in others.items():
        times = [int.from_bytes(content[_LOG_TIME], "little") for content in contents]
        time_ns = np.array(times, np.int64)
        kept = wanted(number, time_ns, contents)
        messages = []
        for content in compress(contents, kept):
            messages.append(record_header(Opcode.MESSAGE, len(content)) + content)
        if messages:
            sizes = np.array(list(map(len, messages)), np.int64)
            yield number, (b"".join(messages), time_ns[kept], sizes)


def _joined(waiting: Mapping[int, Sequence[_Chosen]]) -> list[MessageBatch]:
    batches = []
    for number, own in waiting.items():
        data, times, sizes = zip(*own, strict=True)
        lengths = np.concatenate(sizes)
        offsets = np.cumsum(lengths) - lengths
        batches.append(
            MessageBatch(number, memoryview(b"".join(data)), np.concatenate(times), offsets)
        )
    return batches
