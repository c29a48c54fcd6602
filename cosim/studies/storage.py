"""Where a dataset is: files by name in a folder, or in a bucket that fsspec reaches.

A file is whole at any instant, also where its writer is killed; a line is appended whole, or not.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Final, final
from urllib.parse import unquote, urlsplit

from cosim.arguments import path_argument
from cosim.errors import DatasetError, DatasetWriteError, UsageError

if sys.platform != "win32":
    import fcntl

_LOCK: Final = "_lock"
_TEMPORARY: Final = ".cosim-tmp"


def open_storage(place: str | Path) -> Folder | Bucket:
    """Return the storage at a path or a URL; a folder need not be there yet.

    Raises
    ------
    UsageError
        If it is empty.
    DatasetError
        If fsspec, or what it needs for this URL, is missing.
    """
    text = str(place)
    if not text:
        raise UsageError("expected a folder or URL for the dataset, got an empty path")
    if "://" not in text:
        return Folder(path_argument("place", place))
    if text.startswith(("file://", "local://")):
        url = urlsplit(text)
        return Folder(Path(unquote(url.netloc + url.path)))
    return Bucket(text)


@final
class Folder:
    """Files in a folder of this machine."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = -1

    def label(self, name: str = "") -> str:
        """Return where a file is, for people."""
        return str(self.path / name)

    def read(self, name: str) -> bytes | None:
        """Return the content of a file; None: there is none."""
        with _reading(self.label(name)), suppress(FileNotFoundError, NotADirectoryError):
            return (self.path / name).read_bytes()
        return None

    def write(self, name: str, content: bytes | Path) -> None:
        """Write a file as a whole, or move one there."""
        path = self.path / name
        near = path.with_name(f"_{path.name}{_TEMPORARY}")
        with _writing(self.label(name)):
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

    def append(self, name: str, line: bytes) -> None:
        """Append a line to a file."""
        with _writing(self.label(name)), open(self.path / name, "ab", buffering=0) as file:
            length = os.fstat(file.fileno()).st_size
            try:
                _write(file.fileno(), line)
            except OSError:
                file.truncate(length)
                raise

    def names(self, folder: str = "") -> list[str]:
        """Return the names in a folder."""
        with _reading(self.label(folder)), suppress(FileNotFoundError, NotADirectoryError):
            return os.listdir(self.path / folder)
        return []

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, and the folders that are empty then."""
        with _writing(self.label()):
            for name in names:
                path = self.path / name
                path.unlink(missing_ok=True)
                if path.parent != self.path:
                    with suppress(OSError):  # others are in it
                        path.parent.rmdir()

    def lock(self) -> None:
        """Make the folder, and keep others from writing there until it is closed.

        Raises
        ------
        DatasetError
            If another process does, or it cannot be made.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            if sys.platform != "win32":
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = self.read(_LOCK) or b"unknown"
            self.close()
            raise DatasetError(
                f"{self.path}: another study is writing there (process {holder.decode()}); wait "
                "until it ends, or choose another folder"
            ) from error
        except OSError as error:
            if self._lock < 0:  # otherwise a file system without locks
                raise DatasetError(
                    f"{self.path}: {error.strerror}; expected a writable folder"
                ) from error
        with suppress(OSError):  # a full disk: who holds it is not said then
            os.ftruncate(self._lock, 0)
            os.write(self._lock, str(os.getpid()).encode())
        for pattern in ("_*", "*/_*"):  # what a killed writer has left
            for left in self.path.glob(f"{pattern}{_TEMPORARY}"):
                left.unlink(missing_ok=True)

    def close(self) -> None:
        """Let others write there."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


@final
class Bucket:
    """Files behind a URL of fsspec; nobody keeps two studies from writing there."""

    def __init__(self, url: str) -> None:
        try:
            self._files, root = import_module("fsspec").core.url_to_fs(url)
        except ModuleNotFoundError as error:
            raise DatasetError(
                f"{url}: a dataset outside of a local folder needs {error.name}, which is not "
                f"installed: pip install {error.name}"
            ) from error
        except (ImportError, ValueError) as error:  # a library for this protocol; no such protocol
            raise DatasetError(f"{url}: {error}") from error
        self._url = url.rstrip("/")
        self._root = root.rstrip("/")

    def label(self, name: str = "") -> str:
        """Return where a file is, for people."""
        return f"{self._url}/{name}".rstrip("/")

    def read(self, name: str) -> bytes | None:
        """Return the content of a file; None: there is none."""
        with _reading(self.label(name)), suppress(FileNotFoundError):
            content: bytes = self._files.cat_file(f"{self._root}/{name}")
            return content
        return None

    def write(self, name: str, content: bytes | Path) -> None:
        """Write a file as a whole, or move one there."""
        path = f"{self._root}/{name}"
        with _writing(self.label(name)):
            if isinstance(content, Path):
                self._files.put_file(str(content), path)
                content.unlink()
            else:
                self._files.pipe_file(path, content)

    def names(self, folder: str = "") -> list[str]:
        """Return the names in a folder."""
        with _reading(self.label(folder)), suppress(FileNotFoundError):
            self._files.invalidate_cache()
            paths = self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=False)
            return [path.rstrip("/").rpartition("/")[2] for path in paths]
        return []

    def remove(self, names: Iterable[str]) -> None:
        """Remove files."""
        with _writing(self.label()):
            for name in names:
                if self._files.exists(f"{self._root}/{name}"):
                    self._files.rm_file(f"{self._root}/{name}")

    def lock(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def _write(descriptor: int, content: bytes) -> None:
    view = memoryview(content)
    while view:  # a disk that gets full takes a part; the next write says why
        view = view[os.write(descriptor, view) :]


@contextmanager
def _reading(label: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # each kind of storage has errors of its own
        raise DatasetError(f"{label}: {_text(error)}") from error


@contextmanager
def _writing(label: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise DatasetWriteError(
            f"{label}: {_text(error)}; all outcomes so far are saved: fix this and run the study "
            "again to continue"
        ) from error


def _text(error: Any) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
