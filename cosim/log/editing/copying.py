"""Write a log from the pieces and messages of other logs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from io import RawIOBase
from typing import Any

from cosim.errors import LogError
from cosim.log.contents.environment import library_name
from cosim.log.contents.metadata import json_table
from cosim.log.contents.result import PARTIAL, RESULT, RESULT_FILE, WHOLE, result_record
from cosim.log.editing.pieces import LogPieces
from cosim.log.mcap_file.chunks import MessageBatch, separate_chunks
from cosim.log.mcap_file.head import FileHead, attachment_group
from cosim.log.mcap_file.live_file import LiveFile
from cosim.log.mcap_file.summary import RecordGroup
from cosim.log.mcap_file.unfinished import UnfinishedLog
from cosim.log.mcap_file.workers import Workers
from cosim.log.reading.reader import Log


@dataclass(frozen=True, slots=True)
class PartEnd:
    """What a part of a log says of its end.

    Parameters
    ----------
    status, reason : str
    steps : int
        Number of the last communication step in it.
    end_ns : int
        Its instant.
    """

    status: str
    reason: str
    steps: int
    end_ns: int


def write_log(
    target: UnfinishedLog,
    pieces: LogPieces,
    batches: Iterable[list[MessageBatch]],
    end: Callable[[str], PartEnd],
) -> Log:
    """Write a log, and return it.

    Where its rows turn out to be all those of the run, it ends as that did.

    Parameters
    ----------
    target : UnfinishedLog
    pieces : LogPieces
    batches : iterable of list of MessageBatch
    end : callable
        Is called with the content hash when all messages are written.

    Raises
    ------
    LogError
        If a file exists there and is to stay, or it cannot be written.
    """
    target.check_free()
    try:
        file = _begun(target.create(), pieces)
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


def _begun(stream: RawIOBase, pieces: LogPieces) -> LiveFile:
    """Begin a file with the pieces that every part of a run has."""
    head = FileHead(library=library_name())
    head.copy(pieces.schemas, pieces.channels)
    for name, items in pieces.kept_metadata.items():
        head.metadata(name, dict(items))
    for item in pieces.kept_attachments:
        head.attachment(item.name, item.media_type, item.data)
    return LiveFile(stream, head.data, head.summary())


def _end_groups(pieces: LogPieces, end: PartEnd, content_hash: str) -> list[RecordGroup]:
    """Return the records that tell of the end: those of the run, where all its rows are here."""
    of_run = pieces.run_result
    if of_run.get("content_hash") == content_hash:
        groups = [result_record(RESULT, of_run)]
        if pieces.result_file is not None and PARTIAL not in pieces.metadata:
            groups.append(attachment_group(RESULT_FILE, "application/json", pieces.result_file))
        else:
            groups.append(_result_file(_whole_result(pieces.result_file, of_run)))
        return groups
    items: dict[str, Any] = {**asdict(end), "content_hash": content_hash}
    groups = [result_record(RESULT, items)]
    if of_run:
        groups.append(result_record(PARTIAL, of_run))
    values = _values(pieces.result_file)
    if PARTIAL not in pieces.metadata:  # they are of the whole run, whose last row is another one
        values = {WHOLE: values} if of_run and values else {}
    groups.append(_result_file({**values, **items}))
    return groups


def _whole_result(of_part: bytes | None, of_run: Mapping[str, str]) -> dict[str, Any]:
    """Return the result of the whole run, with the values of it that a part has."""
    items: dict[str, Any] = dict(of_run)
    for key in ("steps", "end_ns"):
        if of_run.get(key, "").isdecimal():
            items[key] = int(of_run[key])
    values = _values(of_part)
    whole = values.get(WHOLE)
    return {**(whole if isinstance(whole, dict) else values), **items}


def _values(result_file: bytes | None) -> dict[str, Any]:
    """Return the content of a result file; where it cannot be read nothing, which loses no row."""
    try:
        return {} if result_file is None else json_table(result_file)
    except ValueError:
        return {}


def _result_file(items: Mapping[str, Any]) -> RecordGroup:
    return attachment_group(RESULT_FILE, "application/json", json.dumps(items, indent=2).encode())
