"""How a run ended: the record ``cosim.result``, and the attachment ``result.json``.

The attachment has the values that the caller adds, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
from isal import isal_zlib

from cosim.core.recorders import EndOfRun
from cosim.instants import NANOSECONDS
from cosim.log.mcap_file.checksum import add_checksum
from cosim.log.mcap_file.head import attachment_group, metadata_group
from cosim.log.mcap_file.summary import RecordGroup

RESULT = "cosim.result"
RESULT_FILE = "result.json"
PARTIAL = "cosim.partial"  # the result of the whole run, in the log of a part of it
WHOLE = "whole"  # in the result file of a part: what the one of the whole run has
PARTIAL_STATUS = "partial"  # of a log that lacks rows of its run
PART_REASON = "part "  # what the reason of a file of several begins with, before its number

ResultItems: TypeAlias = Mapping[str, str | int]


@dataclass(frozen=True, slots=True)
class LastRow:
    """The last row of a run."""

    steps: int = 0
    end_ns: int = 0


def result_items(end: EndOfRun, last_row: LastRow, *, content_hash: str) -> ResultItems:
    """Return what is recorded of the end of a run."""
    return {**asdict(end), **asdict(last_row), "content_hash": content_hash}


def with_whole(part: RecordGroup, whole: ResultItems) -> RecordGroup:
    """Return the end of the last file of a log of several behind that of the whole run."""
    return _joined(result_record(PARTIAL, whole), part)


def part_items(
    number: int, first_ns: int | None, last_row: Mapping[str, Any], content_hash: str
) -> ResultItems:
    """Return what is recorded of the end of a file of several.

    Parameters
    ----------
    number : int
        Of the file, from 1.
    first_ns : int or None
        Its first row [ns]; None: there is none.
    last_row : mapping
        Its ``steps`` and ``end_ns``.
    content_hash : str
        Of the rows of the file.
    """
    end_ns = last_row["end_ns"]
    where = "without rows" if first_ns is None else span_text(first_ns, end_ns)
    return {
        "status": PARTIAL_STATUS,
        "reason": f"{PART_REASON}{number} of its log, {where}",
        "steps": last_row["steps"],
        "end_ns": end_ns,
        "content_hash": content_hash,
    }


def span_text(first_ns: int, last_ns: int) -> str:
    """Return from when to when some rows are, in words."""
    return f"from {first_ns / NANOSECONDS} s to {last_ns / NANOSECONDS} s"


def end_group(items: ResultItems, values: Mapping[str, Any]) -> RecordGroup:
    """Return the record and the attachment; ``values`` go to the attachment only."""
    # Ours after the caller's: no caller may overwrite how the run ended.
    text = json.dumps({**values, **items}, default=_to_json, indent=2)
    attachment = attachment_group(RESULT_FILE, "application/json", text.encode())
    return _joined(result_record(RESULT, items), attachment)


def result_record(name: str, items: ResultItems) -> RecordGroup:
    """Return the metadata record ``name``: how a run or a part of it ended."""
    texts = {key: str(value) for key, value in items.items()}
    return metadata_group(name, add_checksum(name, texts))


def _joined(first: RecordGroup, second: RecordGroup) -> RecordGroup:
    entries = [*first.entries, *second.placed(first.size)]
    crc = isal_zlib.crc32_combine(first.crc, second.crc, second.size)
    return RecordGroup([*first.parts, *second.parts], entries, crc)


def _to_json(value: object) -> object:
    """Return numpy values as numbers and lists, and all others, such as paths, as text."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return str(value)
