"""Paths of logs: what can name a file, and what is one."""

from __future__ import annotations

import os
from io import BufferedReader
from pathlib import Path

from cosim.errors import LogError, quoted
from cosim.files import expanded, regular


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
