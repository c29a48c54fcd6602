"""A dataset in a folder.

A file is written under a temporary name and renamed. The temporary file is locked by who writes it;
one that is not was left by a kill. Who writes the dataset holds a lock for it, too: it ends with
the process, however that ends.
"""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, final

from cosim.errors import DatasetError, DatasetWriteError
from cosim.studies.dataset.file_locks import FolderLock, LockState, lock_file

_TEMPORARY: Final = ".tmp"
_NONE: Final = -1  # no descriptor: to write there is an error


@final
class LocalStorage:
    """The files of a dataset in a folder.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock: FolderLock | None = None

    def label(self, name: str = "") -> str:
        """Return the path of a file, or of the folder."""
        return str(self._folder / name)

    def read(self, name: str) -> bytes | None:
        """Return the content of a file; None: there is none."""
        try:
            return (self._folder / name).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise DatasetError(f"{self.label(name)}: {error.strerror}") from error

    def write(self, name: str, content: bytes) -> None:
        """Write a file whole."""
        path = self._folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_whole(path, content)
        except OSError as error:
            raise _write_error(path, error) from error

    def put(self, name: str, file: Path) -> None:
        """Rename a file on this disk."""
        path = self._folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, path)
        except OSError as error:
            raise _write_error(path, error) from error

    def folder(self, name: str) -> Path:
        """Return the path of a folder."""
        return self._folder / name

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder, in order."""
        try:
            return sorted(os.listdir(self._folder / folder))
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise DatasetError(f"{self.label(folder)}: {error.strerror}") from error

    def sizes(self, folder: str) -> dict[str, int]:
        """Return how many bytes the files in a folder have, by name."""
        sizes = {}
        for name in self.names(folder):
            with suppress(FileNotFoundError):
                sizes[name] = (self._folder / folder / name).stat().st_size
        return sizes

    def remove(self, names: Sequence[str], folders: Sequence[str]) -> None:
        """Remove files, and after them the folders that are empty."""
        try:
            for name in names:
                (self._folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise _write_error(self._folder, error) from error
        for folder in folders:
            with suppress(OSError):  # other files are in it, or it is not there
                (self._folder / folder).rmdir()

    def lock(self) -> None:
        """Keep other processes from writing, and remove what a kill left half-written."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DatasetError(
                f"{self._folder}: {error.strerror}; expected a writable folder"
            ) from error
        self._lock = FolderLock(self._folder)
        for folder in (self._folder, self._folder / "parts"):
            _remove_abandoned(folder)

    def journal(self, name: str) -> AppendedJournal:
        """Open a journal to write on after its last whole line."""
        return AppendedJournal(self._folder / name)

    def close(self) -> None:
        """Release the lock of the place. Twice does no harm."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


@final
class AppendedJournal:
    """A journal that has every line as soon as it is added: a kill of the process loses none.

    Parameters
    ----------
    path : Path

    Raises
    ------
    DatasetWriteError
        If it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._length = 0
        try:
            self._file = self._opened()
        except OSError as error:
            raise _write_error(path, error) from error

    def append(self, line: bytes) -> None:
        """Add a line.

        Raises
        ------
        DatasetWriteError
            If it cannot be written; the lines before it are there.
        """
        try:
            _write_all(self._file, line)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self._length)
            raise _write_error(self._path, error) from error
        self._length += len(line)

    def replace(self, lines: Sequence[bytes]) -> None:
        """Keep these lines only.

        Raises
        ------
        DatasetWriteError
            If they cannot be written; all lines are there then.
        """
        try:
            self._write_anew(lines)
        except OSError as error:
            raise _write_error(self._path, error) from error

    def close(self) -> None:
        """Close the file. Twice does no harm."""
        if self._file != _NONE:
            os.close(self._file)
            self._file = _NONE

    def _write_anew(self, lines: Sequence[bytes]) -> None:
        # A new file, as who reads the old one must not find its lines changed meanwhile.
        # While it is not known which file has the name, there is none to append to: a line in
        # the file that was replaced would be lost.
        replaced = self._file
        self._file = _NONE
        try:
            _write_whole(self._path, b"".join(lines))
        except OSError:
            self._file = replaced
            raise
        os.close(replaced)
        self._file = self._opened()

    def _opened(self) -> int:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        with open(descriptor, "rb", closefd=False) as file:
            content = file.read()
        self._length = content.rfind(b"\n") + 1
        if self._length < len(content):
            os.ftruncate(descriptor, self._length)
        return descriptor


def _write_whole(path: Path, content: bytes) -> None:
    temporary = path.parent / f"_{path.name}.{secrets.token_hex(8)}{_TEMPORARY}"
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        lock_file(descriptor)
        _write_all(descriptor, content)
        if content:  # an empty journal needs no disk: it says nothing
            os.fsync(descriptor)
        if sys.platform == "win32":  # an open file cannot be renamed there
            os.close(descriptor)
            descriptor = -1
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise
    finally:
        if descriptor >= 0:
            os.close(descriptor)


def _write_all(descriptor: int, content: bytes) -> None:
    written = os.write(descriptor, content)
    while written < len(content):  # a disk that gets full takes a part; the next write says why
        written += os.write(descriptor, content[written:])


def _remove_abandoned(folder: Path) -> None:
    """Remove the temporary files that no process writes any more."""
    with suppress(OSError):
        for name in os.listdir(folder):
            if name.startswith("_") and name.endswith(_TEMPORARY):
                _remove_unlocked(folder / name)


def _remove_unlocked(path: Path) -> None:
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDWR)
        try:
            if lock_file(descriptor) is LockState.HELD:  # which nobody knows without locks
                path.unlink()
        finally:
            os.close(descriptor)


def _write_error(path: Path, error: OSError) -> DatasetWriteError:
    return DatasetWriteError(
        f"{path}: {error.strerror}; all outcomes so far are saved: fix this and run the study "
        "again to continue"
    )
