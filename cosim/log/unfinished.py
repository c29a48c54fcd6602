"""A new log under a hidden name until its first row.

A file at its path is untouched until then.
"""

from __future__ import annotations

import errno
import glob
import io
import os
import secrets
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from cosim.errors import LogError, flag
from cosim.files import check_folder
from cosim.log.files import OwnFile, further_parts, log_path

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
    own : OwnFile or None
        The file, to be read whatever is at the path; None before it is created.
    """

    def __init__(self, path: Path | str, *, force: bool, numbered: bool = False) -> None:
        self.path = log_path(path)
        self._force = force
        self._numbered = numbered
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
        if self._force and self._numbered:
            raise LogError(
                "force and numbered exclude each other: an existing log is either replaced or kept "
                "beside the new one"
            )
        path = self.path
        if not self._numbered and path.is_dir():
            raise LogError(f"{path} is a folder; name a file, such as {path / 'run.mcap'}")
        if not self._numbered and not self._force and path.exists():
            raise LogError(f"{path} exists; choose another path, or {flag('force')} to replace it")
        try:
            check_folder(path.parent)
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{path} cannot be created: {reason}") from error

    def check_not_read(self, sources: Iterable[Path]) -> None:
        """Check that it does not replace one of its inputs.

        Raises
        ------
        LogError
            If it does, also under another name.
        """
        for source in sources:
            if os.path.realpath(self.path) == os.path.realpath(log_path(source)):
                raise LogError(
                    f"{source} is an input of the new log and cannot be replaced by it; choose "
                    "another path"
                )

    def create(self) -> io.RawIOBase:
        """Create the file beside its path, under the hidden name.

        Raises
        ------
        LogError
            If that cannot be done.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(self.path)
            self._stream = self._create_locked()
            while self._stream is None:  # another run took it for an abandoned one, and removed it
                self._stream = self._create_locked()
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{self.path} cannot be created: {reason}") from error
        return self._stream

    def _create_locked(self) -> io.RawIOBase | None:
        """Create the file and lock it; None: it is gone already."""
        hidden_name = _hidden_name(self.path.name[:_KEPT_NAME], secrets.token_hex(4))
        self._hidden_path = self.path.with_name(hidden_name)
        # After the path is known: an error or interrupt in here must not leave the file.
        stream = create(self._hidden_path)
        try:
            if lock(stream.fileno()):
                # From here on no other run removes it; whether one has, opening it says.
                self.own = OwnFile(self._hidden_path)
                return stream
        except FileNotFoundError:
            self._check_folder()
        stream.close()
        return None

    def _check_folder(self) -> None:
        """Check that the folder is there, so that trying again has an end.

        Raises
        ------
        OSError
            If it is not.
        """
        os.stat(self.path.parent)

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
        try:
            if self._force:
                check_not_written(self.path)
                self._hidden_path.replace(self.path)  # readers of the old file keep it whole
            elif self._numbered:
                self.path = _move_to_free(self._hidden_path, self.path)
            else:
                _move(self._hidden_path, self.path)
        except FileExistsError as error:
            raise LogError(
                f"{self.path} was created in the meantime; choose another path, or {flag('force')} "
                "to replace it"
            ) from error
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{self.path} cannot be created: {reason}") from error
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
    return list(path.parent.glob(_hidden_name(kept_name, "*")))


def _hidden_name(kept_name: str, token: str) -> str:
    return f".{kept_name}.{token}{_HIDDEN_SUFFIX}"


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
    number = 1
    target = first
    while True:
        try:
            if further_parts(target):
                raise FileExistsError
            _move(source, target)
        except FileExistsError:
            number += 1
            target = first.with_name(f"{first.stem}-{number}{first.suffix}")
        else:
            return target


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
