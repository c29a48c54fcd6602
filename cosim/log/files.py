"""The files of a log: their paths, a new one under a hidden name until its first row, rotation.

A file at a path is untouched until the first row of the one that replaces it. A log that is rotated
is ``run.mcap``, ``run.part2.mcap``, ``run.part3.mcap``, ...
"""

from __future__ import annotations

import io
import os
import re
import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from io import BufferedReader
from math import ceil
from pathlib import Path
from typing import Any, Final, final

from cosim.core.clock import LARGEST_NS
from cosim.core.signals import Channel
from cosim.errors import LogError, UsageError, option, quoted
from cosim.files import expanded, regular
from cosim.instants import NANOSECONDS, StepNs


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


_MOST_HELD: Final = 64  # descriptors: a process may often have 1024

_held: deque[weakref.ref[OwnFile]] = deque()


@final
class OwnFile:
    """A file held open.

    Of very many in a process the oldest are let go again where the file is at its path.

    Parameters
    ----------
    path : Path
        Where it is now.

    Raises
    ------
    OSError
        If it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDONLY)
        self._status = os.fstat(self._descriptor)
        self._close = weakref.finalize(self, os.close, self._descriptor)

    def hold(self, path: Path) -> None:
        """Hold it from here on, while there are few such files or it is not at its path."""
        self._path = path
        _held.append(weakref.ref(self))
        while len(_held) > _MOST_HELD:
            oldest = _held.popleft()()
            if oldest is not None and oldest.is_at_its_path:
                oldest._close()

    @property
    def is_at_its_path(self) -> bool:
        """Whether the path still leads to this file."""
        try:
            return os.path.samestat(os.stat(self._path), self._status)
        except OSError:
            return False

    def open(self) -> io.BufferedReader | None:
        """Open it to read, from its start; None: it was let go."""
        if not self._close.alive:
            return None
        return io.BufferedReader(_Reading(os.dup(self._descriptor)))


@final
class _Reading(io.RawIOBase):
    """A position in a file that others read too, each from its own."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._position = 0

    def close(self) -> None:
        if not self.closed:
            os.close(self._descriptor)
        super().close()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        starts = {io.SEEK_SET: 0, io.SEEK_CUR: self._position}
        start = starts.get(whence, os.fstat(self._descriptor).st_size)
        self._position = start + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        data = os.pread(self._descriptor, len(memoryview(buffer)), self._position)
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)


_SIZES: Final = {
    "B": 1,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
}
_TIMES: Final = {"s": NANOSECONDS, "min": 60 * NANOSECONDS, "h": 3600 * NANOSECONDS}
_LIMIT: Final = re.compile(r"(\d{1,15}(?:\.\d{1,15})?) ?([A-Za-z]+)", re.ASCII)
_SMALLEST: Final = 10**6  # bytes: about what is written at a time
_PART_NAME: Final = re.compile(r"(.+)\.part([2-9]|[1-9]\d{1,8})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Rotation:
    """After how much of one file a next one begins; one of the two is given.

    Parameters
    ----------
    size : int or None
        Of the file [bytes].
    span_ns : int or None
        Simulated time in it [ns].
    text : str
        As it was asked for.
    """

    size: int | None
    span_ns: int | None
    text: str

    def check(self, channels: Sequence[Channel], step_ns: StepNs, head_bytes: int) -> None:
        """Check that every file has room for rows.

        Parameters
        ----------
        channels : sequence of Channel
            The components that are recorded.
        step_ns : int
            Communication step [ns].
        head_bytes : int
            What precedes the rows in each file.

        Raises
        ------
        UsageError
            If it has not.
        """
        if self.size is not None and self.size < 2 * head_bytes:
            raise UsageError(
                f"{option('rotate')}: expected at least {2 * head_bytes}B (twice what every file "
                f"begins with), got {self.text!r}"
            )
        period_ns = ceil(step_ns * max((channel.period for channel in channels), default=1))
        if self.span_ns is not None and self.span_ns < period_ns:
            raise UsageError(
                f"{option('rotate')}: expected at least {period_ns / NANOSECONDS} s, so that every "
                f"file has a row of every component, got {self.text!r}"
            )


def read_rotation(text: object) -> Rotation:
    """Read a limit, such as ``1GB`` or ``1h``.

    Raises
    ------
    UsageError
        If it is neither a size nor a time, or too small.
    """
    match = _LIMIT.fullmatch(text.strip()) if isinstance(text, str) else None
    unit = "" if match is None else match[2]
    if match is None or unit not in _SIZES | _TIMES:
        raise UsageError(
            f"{option('rotate')}: expected a size in {', '.join(_SIZES)} or a simulated time in "
            f"{', '.join(_TIMES)}, such as 1GB or 1h, got {quoted(text)}"
        )
    amount = Decimal(match[1]) * (_SIZES | _TIMES)[unit]
    limit = int(amount)
    if unit in _SIZES:
        if limit < _SMALLEST:
            raise UsageError(
                f"{option('rotate')}: expected at least 1MB (about as much is written at a time), "
                f"got {match[0]!r}"
            )
        return Rotation(limit, None, match[0])
    if amount != limit or not 0 < limit <= LARGEST_NS:
        raise UsageError(
            f"{option('rotate')}: expected a whole number of nanoseconds > 0, got {match[0]!r}"
        )
    return Rotation(None, limit, match[0])


def part_path(first: Path, number: int) -> Path:
    """Return the path of a file of a log, counted from 1."""
    return first if number == 1 else first.with_name(f"{first.stem}.part{number}{first.suffix}")


def part_paths(path: Path) -> list[Path]:
    """Return the paths of the files of a log up to one of them, by its name."""
    match = _PART_NAME.fullmatch(path.stem)
    if match is None:
        return [path]
    first = path.with_name(match[1] + path.suffix)
    return [part_path(first, number) for number in range(1, int(match[2]) + 1)]


def further_parts(first: Path) -> list[Path]:
    """Return the files after the first one of a log that are there, in their order."""
    found = []
    if first.parent.is_dir():
        for path in first.parent.iterdir():
            match = _PART_NAME.fullmatch(path.stem)
            if match is not None and match[1] == first.stem and path.suffix == first.suffix:
                found.append((int(match[2]), path))
    return [path for _, path in sorted(found)]


def all_parts(path: Path) -> list[Path]:
    """Return the paths of all files of a log of which one is given, by their names."""
    first = part_paths(path)[0]
    return [first, *further_parts(first)]
