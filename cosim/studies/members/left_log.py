"""What a run that failed has left of its log."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from cosim.errors import LogError
from cosim.log import open_log
from cosim.log.editing.recovering import recover
from cosim.log.reading.reader import Log

_UNFINISHED = "unfinished"


def readable_log(path: Path) -> Path | None:
    """Return a log that can be opened: the one that was left, or what is intact in it.

    None: no row is. A log is whole at any moment; only a disk that lost a part of it changes that.
    """
    if _opened(path) is not None:
        return path
    out = path.with_name(path.name.replace(".", ".recovered.", 1))
    with suppress(LogError):
        recover(path, out, force=True)
        return out
    return None


def is_ended(path: Path) -> bool:
    """Return whether the run has recorded its end: it was not killed, nor crashed."""
    log = _opened(path)
    return log is not None and log.status != _UNFINISHED


def _opened(path: Path) -> Log | None:
    try:
        return open_log(path)
    except LogError:
        return None
