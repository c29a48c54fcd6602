"""How a run ended: the record ``cosim.result``, and the attachment ``result.json``.

The attachment has the values that the caller adds, too.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cosim.core.recorders import EndOfRun
from cosim.log.head import attachment_group, metadata_group
from cosim.log.metadata import add_checksum
from cosim.log.summary import RecordGroup

RESULT = "cosim.result"
RESULT_FILE = "result.json"
PARTIAL_STATUS = "partial"  # of a log that has not all rows of its run


@dataclass(frozen=True, slots=True)
class LastRow:
    """The last row of a run."""

    steps: int = 0
    end_ns: int = 0


def result_group(
    end: EndOfRun, last_row: LastRow, *, content_hash: str, values: Mapping[str, Any]
) -> RecordGroup:
    """Return the record and the attachment; ``values`` go to the attachment only."""
    items = {**asdict(end), **asdict(last_row), "content_hash": content_hash}
    texts = {key: str(value) for key, value in items.items()}
    record = metadata_group(RESULT, add_checksum(RESULT, texts))
    # Ours after the caller's: no caller may overwrite how the run ended.
    text = json.dumps({**values, **items}, default=_to_json, indent=2)
    attachment = attachment_group(RESULT_FILE, "application/json", text.encode())
    entries = [*record.entries, *attachment.placed(len(record.data))]
    data = record.data + attachment.data
    return RecordGroup(data, entries, zlib.crc32(data))


def _to_json(value: object) -> object:
    """Return numpy values as numbers and lists, and all others, such as paths, as text."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return str(value)
