"""Files that are read: regular ones, of a bounded size; and places where files can be written.

A device, a pipe or a socket may never end, or never begin; what a user names must not stop the
program there. Whatever is refused is an ``OSError``, as every other reason why a file cannot be
read: who opens a file catches that, and names the file and what was expected.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final, Literal, TypeAlias

FileType: TypeAlias = Literal["log", "FMU", "scenario", "table"]

_ENDINGS: Final[dict[str, FileType]] = {
    ".mcap": "log",
    ".fmu": "FMU",
    ".toml": "scenario",
    ".csv": "table",
    ".tsv": "table",
    ".txt": "table",
    ".dat": "table",
    ".parquet": "table",
    ".xlsx": "table",
    ".xlsm": "table",
    ".mat": "table",
}
MCAP_MAGIC: Final = b"\x89MCAP0\r\n"  # at both ends of an MCAP file
# Opening a pipe waits for its other end; on Windows there are none among the files.
_NO_WAITING: Final = getattr(os, "O_NONBLOCK", 0)
_TYPES: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
)


def expanded(path: str | os.PathLike[str]) -> Path:
    """Return a path with the home folder for ``~``, as a shell has it: every path that users give.

    Environment variables in it stay as they are.
    """
    return Path(os.path.expanduser(path))


def file_type(path: str | Path) -> FileType | None:
    """Return what a file is by the ending of its name, in any case; None: something else."""
    return _ENDINGS.get(Path(path).suffix.lower())


def read_type(path: str | Path) -> FileType | None:
    """Return what a file that is read is: a log if it begins as one, else by its ending.

    A log is every MCAP file, also of another tool. What cannot be opened is what its ending says.
    """
    with suppress(OSError, ValueError), open(path, "rb", opener=regular) as file:
        if file.read(len(MCAP_MAGIC)) == MCAP_MAGIC:
            return "log"
    return file_type(path)


def regular(path: str, flags: int) -> int:
    """Open a regular file and return its descriptor: an ``opener`` for :func:`open`.

    Raises
    ------
    OSError
        If it is something else, or cannot be opened.
    """
    _check_type(path, os.stat(path))  # before it is opened: that may wake what is behind a device
    descriptor = os.open(path, flags | _NO_WAITING)
    try:
        _check_type(path, os.fstat(descriptor))  # what was opened may be another file by now
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def read_bounded(path: Path, largest: int) -> bytes:
    """Read a regular file of at most ``largest`` bytes.

    Raises
    ------
    OSError
        If it is no regular file, is larger, or cannot be read.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name has the character 0", str(path))
    with open(path, "rb", opener=regular) as file:
        check_size(path, os.fstat(file.fileno()).st_size, largest)
        content = file.read(largest + 1)  # it may have grown; some files say that they are empty
    check_size(path, len(content), largest)
    return content


def check_size(path: Path, size: int, largest: int) -> None:
    """Check the size of a file [bytes].

    Raises
    ------
    OSError
        If it is too large.
    """
    if size > largest:
        text = f"it is too large: more than {largest} bytes"
        raise OSError(errno.EFBIG, text, str(path))


def check_writable(path: Path) -> None:
    """Check that a file can be written, in a folder that is there or can be made.

    Raises
    ------
    OSError
        If it cannot, or something else stands there.
    """
    if path.exists():
        _check_type(str(path), path.stat())
        if not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    check_folder(path.parent)


def check_folder(folder: Path) -> None:
    """Check that a folder takes new files; where it is missing, that it can be made.

    Raises
    ------
    OSError
        If it does not.
    """
    nearest = Path(os.path.abspath(folder))
    while not os.path.lexists(nearest):
        nearest = nearest.parent
    # A file is tried, as permissions do not say everything; it has no name, or not for long.
    with tempfile.TemporaryFile(dir=nearest):
        pass


def _check_type(path: str, status: os.stat_result) -> None:
    for is_type, name in _TYPES:
        if is_type(status.st_mode):
            text = f"it is {name}, not a regular file"
            raise OSError(errno.EINVAL, text, str(path))
