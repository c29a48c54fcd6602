"""Logs: runs recorded to MCAP files, read back bit for bit, and compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.log.preamble import Attachment
    from cosim.log.reader import Log, open_log
    from cosim.log.recorder import McapRecorder

_HOMES = {
    "Attachment": "cosim.log.preamble",
    "Log": "cosim.log.reader",
    "McapRecorder": "cosim.log.recorder",
    "open_log": "cosim.log.reader",
}

__all__ = ["Attachment", "Log", "McapRecorder", "open_log"]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
