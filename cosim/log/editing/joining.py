"""Open a file of a log that was rotated, together with the files before it, as one log."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import LogError
from cosim.log.contents.result import PARTIAL_STATUS
from cosim.log.editing.merging import merge
from cosim.log.mcap_file.own_file import OwnFile
from cosim.log.mcap_file.rotation import part_paths
from cosim.log.reading.reader import Log, open_log
from cosim.temporary import TemporaryFolder


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
    if len(paths) == 1 or not _is_later_part(last):
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


def _is_later_part(log: Log) -> bool:
    """Return whether a log has rows from some time after the start of its run on."""
    if log.status not in {PARTIAL_STATUS, "unfinished"}:
        return False
    return log.begins_late
