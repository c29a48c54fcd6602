"""Paths of logs: what can name a file, and what is one."""

from __future__ import annotations

import os
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path

from cosim.errors import LogError, flag, quoted
from cosim.files import check_folder, expanded, regular


def log_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of a log to read or to write, whether there is a file or not.

    Raises
    ------
    LogError
        If no file can have that name.
    """
    try:
        result = expanded(path)
        os.lstat(result)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return result  # whoever reads or writes the file says that
    except (TypeError, ValueError) as error:  # no text, a NUL, no text that the system can write
        raise LogError(f"{quoted(path)} is not a valid path of a log: {error}") from error
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{quoted(path)} cannot be used for a log: {reason}") from error
    return result


def check_new_log(path: Path, *, force: bool, numbered: bool) -> None:
    """Check that a log can be written to a path.

    Raises
    ------
    LogError
        If a file exists there and is neither to be replaced nor kept beside the new one, or both;
        the path is a folder, or its folder takes no files.
    """
    if force and numbered:
        raise LogError(
            "force and numbered exclude each other: an existing log is either replaced or kept "
            "beside the new one"
        )
    if not numbered and path.is_dir():
        raise LogError(f"{path} is a folder; name a file, such as {path / 'run.mcap'}")
    if not numbered and not force and path.exists():
        raise LogError(f"{path} exists; choose another path, or {flag('force')} to replace it")
    try:
        check_folder(path.parent)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{path} cannot be created: {reason}") from error


def check_not_read(out: Path, sources: Iterable[Path]) -> None:
    """Check that a log is not written over one of its inputs.

    Raises
    ------
    LogError
        If it is, also by another name.
    """
    for source in sources:
        if os.path.realpath(log_path(out)) == os.path.realpath(log_path(source)):
            raise LogError(
                f"{source} is an input of the new log and cannot be replaced by it; choose another "
                "path"
            )


def open_file(path: Path) -> BufferedReader:
    """Open a log to read; only a regular file can be one.

    Raises
    ------
    LogError
        If it is something else, or cannot be read.
    """
    try:
        return open(path, "rb", opener=regular)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{path} cannot be read: {reason}") from error
