"""The further files of a log that was rotated, where a new log takes its place.

A file is not removed for its name: ``run.part2.mcap`` may be anybody's. It has to say itself that
it is a part of a log, or have no steps to lose.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from cosim.errors import CosimError, LogError, flag
from cosim.log.contents.result import PART_REASON, PARTIAL_STATUS
from cosim.log.mcap_file.rotation import further_parts
from cosim.log.mcap_file.unfinished import check_not_written
from cosim.log.reading.reader import open_log


def replaced_parts(first: Path) -> list[Path]:
    """Return the further files of the log at a path, which a new log there replaces.

    Raises
    ------
    LogError
        If a file is called as one of them, and does not say that it is, or a run writes to it.
    """
    paths = further_parts(first)
    for path in paths:
        check_not_written(path)
        if not _is_later_part(path):
            raise LogError(
                f"{path} is named like a part of the log {first}, but is not one, so it is not "
                "replaced; move it, or choose another path"
            )
    return paths


def check_no_parts(first: Path, *, force: bool) -> None:
    """Check that there are no further files beside the path of a new log, or that they may go.

    Raises
    ------
    LogError
        If there are some and they shall stay, or if they are not parts of a log.
    """
    parts = replaced_parts(first) if force else further_parts(first)
    if parts and not force:
        raise LogError(
            f"{parts[0]} exists, named like a part of an earlier log {first}; choose another "
            f"path, or {flag('force')} to replace that log with its parts"
        )


def _is_later_part(path: Path) -> bool:
    """Return whether a file says that it is a later part of a log, or has no steps."""
    with suppress(CosimError):
        log = open_log(path)
        if log.status == "unfinished":  # its run was killed, and did not come to say it
            return log.begins_late or not log.steps
        return log.status == PARTIAL_STATUS and log.reason.startswith(PART_REASON)
    return False
