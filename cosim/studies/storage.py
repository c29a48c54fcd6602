"""Where a dataset is: files by name in a folder, or in a bucket that fsspec reaches.

A file is whole at any instant, also where its writer is killed; of a line that is appended, a part
may be left then, or where the disk is full.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic
from typing import Final, final
from urllib.parse import unquote, urlsplit

from cosim.arguments import path_argument
from cosim.errors import DatasetError, DatasetWriteError, UsageError, optional_library

if sys.platform != "win32":
    import fcntl

_LOCK: Final = "_lock"
_TEMPORARY: Final = ".cosim-tmp"
_PERIOD: Final = 10.0  # [s] between two writes of a file to which nothing can be appended
_RESUME: Final = "; what was recorded before is there: fix this and run the study again to continue"


@final
class Storage:
    """The files at a path or a URL; nobody keeps two studies from writing behind a URL.

    Parameters
    ----------
    place : str or Path
        A folder need not be there yet.

    Raises
    ------
    UsageError
        If it is empty, or a library is missing.
    DatasetError
        If fsspec cannot reach it.
    """

    def __init__(self, place: str | Path) -> None:
        text = str(place)
        if not text:
            raise UsageError("expected a folder or URL for the dataset, got an empty path")
        if text.startswith(("file://", "local://")):
            url = urlsplit(text)
            text = unquote(url.netloc + url.path)
        self._folder = None if "://" in text else path_argument("out", text)
        self._lock = -1
        self._later: dict[str, bytes] = {}  # files behind a URL that lines are appended to
        self._due = monotonic() + _PERIOD
        optional_library("pyarrow")  # with which parts are read and written
        fsspec = optional_library("fsspec")
        if self._folder is not None:
            self._files = fsspec.filesystem("file")
            self._label = self._root = str(self._folder)
            return
        try:
            self._files, self._root = fsspec.core.url_to_fs(text.rstrip("/"))
        except (ImportError, ValueError) as error:  # a library for this protocol; no such protocol
            raise DatasetError(f"{text}: {error}") from error
        self._label = text.rstrip("/")

    def label(self, name: str = "") -> str:
        """Return where a file is, for people."""
        return f"{self._label}/{name}" if name else self._label

    def read(self, name: str) -> bytes | None:
        """Return the content of a file; None: there is none."""
        missing = suppress(FileNotFoundError, NotADirectoryError)
        with _explained(self.label(name)), missing:
            content: bytes = self._files.cat_file(f"{self._root}/{name}")
            return content
        return None

    def names(self, folder: str = "") -> list[str]:
        """Return the names in a folder."""
        missing = suppress(FileNotFoundError, NotADirectoryError)
        with _explained(self.label(folder)), missing:
            self._files.invalidate_cache()
            paths = self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=False)
            return [path.rstrip("/").rpartition("/")[2] for path in paths]
        return []

    def write(self, name: str, content: bytes | Path) -> None:
        """Write a file as a whole, or move one there."""
        path = f"{self._root}/{name}"
        with _explained(self.label(name), DatasetWriteError):
            if self._folder is not None:
                _replace(Path(path), content)
            elif isinstance(content, Path):
                self._files.put_file(str(content), path)
                content.unlink()
            else:
                self._files.pipe_file(path, content)
        self._later.pop(name, None)

    def append(self, name: str, line: bytes) -> None:
        """Append a line to a file; behind a URL it is there after seconds, or when this closes."""
        if self._folder is None:
            before = self._later[name] if name in self._later else self.read(name) or b""
            self._later[name] = before + line
            if monotonic() >= self._due:
                self._write_later()
            return
        path = self._folder / name
        explained = _explained(self.label(name), DatasetWriteError)
        with explained, open(path, "ab", buffering=0) as file:
            _write(file.fileno(), line)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files."""
        with _explained(self.label(), DatasetWriteError):
            for name in names:
                if self._files.exists(f"{self._root}/{name}"):
                    self._files.rm_file(f"{self._root}/{name}")

    def lock(self) -> None:
        """Make the folder, and keep others from writing there until it is closed.

        Raises
        ------
        DatasetError
            If another process does, or it cannot be made.
        """
        if self._folder is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self._folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            if sys.platform != "win32":
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = self.read(_LOCK) or b"unknown"
            raise DatasetError(
                f"{self.label()}: another study is writing there (process {holder.decode()}); wait "
                "until it ends, or choose another folder"
            ) from error
        except OSError as error:
            if self._lock < 0:  # otherwise a file system without locks
                raise DatasetError(
                    f"{self.label()}: {error.strerror}; expected a writable folder"
                ) from error
        with suppress(OSError):  # a full disk: who holds it is not said then
            os.ftruncate(self._lock, 0)
            os.write(self._lock, str(os.getpid()).encode())
        for pattern in ("_*", "*/_*"):  # what a killed writer has left
            for left in self._folder.glob(f"{pattern}{_TEMPORARY}"):
                left.unlink(missing_ok=True)

    def close(self) -> None:
        """Write what is to be written, and let others write there."""
        try:
            self._write_later()
        finally:
            if self._lock >= 0:
                os.close(self._lock)
                self._lock = -1

    def _write_later(self) -> None:
        for name, content in list(self._later.items()):
            self.write(name, content)
        self._due = monotonic() + _PERIOD


def _replace(path: Path, content: bytes | Path) -> None:
    near = path.with_name(f"_{path.name}{_TEMPORARY}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        if isinstance(content, Path):
            shutil.move(content, near)  # it may be on another disk
        else:
            with open(near, "wb", buffering=0) as file:
                _write(file.fileno(), content)
                os.fsync(file.fileno())
        os.replace(near, path)
    except OSError:
        near.unlink(missing_ok=True)
        raise


def _write(descriptor: int, content: bytes) -> None:
    view = memoryview(content)
    while view:  # a disk that gets full takes a part; the next write says why
        view = view[os.write(descriptor, view) :]


@contextmanager
def _explained(
    label: str, kind: type[DatasetError | DatasetWriteError] = DatasetError
) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # each kind of storage has errors of its own
        text = getattr(error, "strerror", None) or str(error) or type(error).__name__
        advice = _RESUME if kind is DatasetWriteError else ""
        raise kind(f"{label}: {text}{advice}") from error
