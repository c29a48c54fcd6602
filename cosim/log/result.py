"""How a run ended: the record ``cosim.result`` and, with what the caller adds, the attachment ``result.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cosim.core.recorders import EndOfRun
from cosim.log.metadata import seal
from cosim.log.sink import Sink

RESULT = "cosim.result"
RESULT_FILE = "result.json"


@dataclass(frozen=True, slots=True)
class LastRow:
    """The last row of a run."""

    steps: int = 0
    end_ns: int = 0


def write_result(
    sink: Sink, end: EndOfRun, reached: LastRow, *, content_hash: str, more: Mapping[str, Any]
) -> None:
    """Write the record and the attachment; ``more`` goes to the attachment alone.

    Raises
    ------
    OSError
        If the file cannot be written to.
    """
    items = {**asdict(end), **asdict(reached), "content_hash": content_hash}
    sink.metadata(RESULT, seal(RESULT, {key: str(value) for key, value in items.items()}))
    text = json.dumps({**more, **items}, default=_plain, indent=2)
    sink.attachment(RESULT_FILE, "application/json", text.encode())


def _plain(value: object) -> object:
    """Give numpy values and paths as JSON can say them."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)
