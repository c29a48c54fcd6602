"""The files of a log: their paths, a new one under a hidden name until its first row, rotation.

A file at a path is untouched until the first row of the one that replaces it. A log that is rotated
is ``run.mcap``, ``run.part2.mcap``, ``run.part3.mcap``, ...
"""

from __future__ import annotations

import errno
import glob
import io
import os
import re
import secrets
import sys
import weakref
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import Decimal
from io import BufferedReader
from itertools import count
from math import ceil
from pathlib import Path
from typing import Any, Final, final

from cosim.core.clock import LARGEST_NS
from cosim.core.signals import Channel
from cosim.errors import LogError, UsageError, flag, option, quoted
from cosim.files import check_folder, expanded, regular
from cosim.instants import NANOSECONDS, StepNs


@contextmanager
def refused(what: str) -> Iterator[None]:
    """Raise what the system refuses as the error of a log.

    Raises
    ------
    LogError
        ``what``, and the reason.
    """
    try:
        yield
    except OSError as error:
        raise LogError(f"{what}: {error.strerror or error}") from error


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
    with refused(f"{path} cannot be read"):
        return open(path, "rb", opener=regular)


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

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        starts = (0, self._position, os.fstat(self._descriptor).st_size)
        self._position = starts[whence] + offset
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


_HIDDEN_SUFFIX = ".part"
_KEPT_NAME = 48  # characters of the path's name in the hidden one: names end at 255 bytes


def create(path: Path) -> io.RawIOBase:
    """Create a file that does not exist yet, unbuffered."""
    return path.open("xb", buffering=0)


class UnfinishedLog:
    """A file to be published at its path, or discarded.

    Parameters
    ----------
    path : Path or str
        Where it goes; missing folders are created.
    force : bool
        Replace an existing file.
    numbered : bool
        Where a file exists, go to the next free one of ``x-2.mcap``, ``x-3.mcap``, ...

    Attributes
    ----------
    path : Path
        Where it goes; with ``numbered`` it is known once the file is published.
    force, numbered : bool
    own : OwnFile or None
        The file, to be read whatever is at the path; None before it is created.
    """

    def __init__(self, path: Path | str, *, force: bool, numbered: bool = False) -> None:
        self.path = log_path(path)
        self.force = force
        self.numbered = numbered
        self.published = False
        self.own: OwnFile | None = None
        self._hidden_path: Path | None = None
        self._stream: io.RawIOBase | None = None

    def check_free(self) -> None:
        """Check that a log can be written to its path.

        Raises
        ------
        LogError
            If a file exists there and is neither to be replaced nor kept beside the new one, or
            both; the path is a folder, or its folder takes no files.
        """
        if self.force and self.numbered:
            raise LogError(
                "force and numbered exclude each other: an existing log is either replaced or kept "
                "beside the new one"
            )
        path = self.path
        if not self.numbered and path.is_dir():
            raise LogError(f"{path} is a folder; name a file, such as {path / 'run.mcap'}")
        if not self.numbered and not self.force and path.exists():
            raise LogError(f"{path} exists; choose another path, or {flag('force')} to replace it")
        with refused(f"{path} cannot be created"):
            check_folder(path.parent)

    def create(self) -> io.RawIOBase:
        """Create the file beside its path, under the hidden name.

        Raises
        ------
        LogError
            If that cannot be done.
        """
        with refused(f"{self.path} cannot be created"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(self.path)
            while self._stream is None:  # another run may take it for an abandoned one
                self._stream = self._create_locked()
        return self._stream

    def _create_locked(self) -> io.RawIOBase | None:
        """Create the file and lock it; None: it is gone already."""
        name = f".{self.path.name[:_KEPT_NAME]}.{secrets.token_hex(4)}{_HIDDEN_SUFFIX}"
        self._hidden_path = self.path.with_name(name)
        # After the path is known: an error or interrupt in here must not leave the file.
        stream = create(self._hidden_path)
        try:
            if lock(stream.fileno()):
                # From here on no other run removes it; whether one has, opening it says.
                self.own = OwnFile(self._hidden_path)
                return stream
        except FileNotFoundError:
            os.stat(self.path.parent)  # it is there, so that trying again has an end
        stream.close()
        return None

    def publish(self) -> None:
        """Rename the file to its path, the first time this is called; it stays open.

        The name is taken in one step: of any number of runs at once each gets its own.

        Raises
        ------
        LogError
            If a file has been created there meanwhile and ``force`` is false, another run writes to
            the file there, or the file cannot be moved.
        """
        if self.published:
            return
        assert self._hidden_path is not None
        assert self.own is not None
        with refused(f"{self.path} cannot be created"):
            try:
                if self.force:
                    check_not_written(self.path)
                    self._hidden_path.replace(self.path)  # readers of the old file keep it whole
                elif self.numbered:
                    self.path = _move_to_free(self._hidden_path, self.path)
                else:
                    _move(self._hidden_path, self.path)
            except FileExistsError as error:
                raise LogError(
                    f"{self.path} was created in the meantime; choose another path, or "
                    f"{flag('force')} to replace it"
                ) from error
        self.own.hold(self.path)
        self.published = True

    def check(self) -> None:
        """Check that the file is still at its path.

        Raises
        ------
        OSError
            If it was removed, moved or replaced.
        """
        if not self.published:
            return
        assert self._stream is not None
        try:
            status = os.stat(self.path)
        except FileNotFoundError as error:
            raise OSError(errno.ENOENT, "it or its folder was removed") from error
        if not os.path.samestat(status, os.fstat(self._stream.fileno())):
            raise OSError(errno.ESTALE, "another file took its place")

    def discard(self) -> None:
        """Remove the file if it was not published."""
        if self.published or self._hidden_path is None:
            return
        with suppress(OSError):  # the error to report is the one that brought us here
            if self._stream is not None:
                self._stream.close()
            self._hidden_path.unlink(missing_ok=True)


def check_not_read(out: Path, sources: Iterable[Path]) -> None:
    """Check that a new file does not replace one of its inputs.

    Raises
    ------
    LogError
        If it does, also under another name.
    """
    for source in sources:
        with suppress(OSError):  # what is not there is not replaced
            if os.path.samefile(log_path(out), log_path(source)):
                raise LogError(
                    f"{source} is an input of {out} and cannot be replaced by it; choose another "
                    "path"
                )


def check_not_written(path: Path) -> None:
    """Check that no run writes to the file at a path, if there is one.

    Raises
    ------
    LogError
        If one does.
    """
    if is_locked(path):
        raise LogError(
            f"{path} is being written by another run; choose another path, or stop that run"
        )


def is_locked(path: Path) -> bool:
    """Return whether a run writes to the file at a path; no: there is none."""
    with suppress(FileNotFoundError), path.open("rb") as stream:
        return not lock(stream.fileno())
    return False


def is_written(path: Path) -> bool:
    """Return whether a run may write to the file at a path; where nothing tells, it may."""
    return sys.platform == "win32" or is_locked(path)


def is_begun(path: Path) -> bool:
    """Return whether a run writes to a file that is to go to a path.

    Names that begin with the same 48 characters are not distinguished.
    """
    for hidden in _hidden_paths(path):
        with suppress(OSError):
            if is_locked(hidden):
                return True
    return False


def _hidden_paths(path: Path) -> list[Path]:
    """Return the hidden files that are to go to a path, or were."""
    kept_name = glob.escape(path.name[:_KEPT_NAME])
    return list(path.parent.glob(f".{kept_name}.*{_HIDDEN_SUFFIX}"))


def _remove_abandoned(path: Path) -> None:
    """Remove the hidden files of runs that were killed before their first row."""
    for hidden in _hidden_paths(path):
        with suppress(OSError), hidden.open("rb") as stream:
            if lock(stream.fileno()):
                hidden.unlink()


def lock(descriptor: int) -> bool:
    """Lock a file as one that a run writes to, until it is closed; return whether that was free.

    Where a file system, or Windows, has no such locks, every file is free.
    """
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _move_to_free(source: Path, first: Path) -> Path:
    """Rename a file to the first free one of ``x.mcap``, ``x-2.mcap``, ...; return that.

    Raises
    ------
    OSError
        If the file cannot be moved.
    """
    for number in count(1):
        name = first.name if number == 1 else f"{first.stem}-{number}{first.suffix}"
        target = first.with_name(name)
        if not further_parts(target):
            with suppress(FileExistsError):
                _move(source, target)
                return target
    raise AssertionError


def _move(source: Path, target: Path) -> None:
    """Rename a file, but never replace another, as ``rename`` would.

    Raises
    ------
    FileExistsError
        If there is a file at ``target``.
    OSError
        If the file cannot be moved.
    """
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except OSError:
        # A file system without hard links: reserve the name, then replace what reserves it.
        target.open("xb").close()
        source.replace(target)
    else:
        source.unlink()
