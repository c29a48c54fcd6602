"""Where a dataset is: files by name in a folder, or in a bucket that fsspec reaches.

A file is whole at any instant, also where its writer is killed.
"""

from __future__ import annotations

import os
import secrets
import shutil
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Final, final
from urllib.parse import unquote, urlsplit

from cosim.arguments import path_argument
from cosim.errors import DatasetError, DatasetWriteError, UsageError

_LOCK: Final = "_lock"
_TEMPORARY: Final = ".tmp"
_PERIOD: Final = 10.0  # [s] between two writes of a journal in a bucket


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
        try:
            return (self.path / name).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise DatasetError(f"{self.label(name)}: {error.strerror}") from error

    def write(self, name: str, content: bytes) -> None:
        """Write a file as a whole."""
        path = self.path / name
        temporary = path.with_name(f"_{path.name}.{secrets.token_hex(8)}{_TEMPORARY}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(temporary, "xb", buffering=0) as file:
                _write(file.fileno(), content)
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            raise _write_error(self.label(name), error) from error

    def put(self, name: str, file: Path) -> None:
        """Move a file there."""
        try:
            path = self.path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            near = path.with_name(f"_{path.name}{_TEMPORARY}")  # the file may be on another disk
            shutil.move(file, near)
            os.replace(near, path)
        except OSError as error:
            raise _write_error(self.label(name), error) from error

    def names(self, folder: str = "") -> list[str]:
        """Return the names in a folder, in order."""
        try:
            return sorted(os.listdir(self.path / folder))
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise DatasetError(f"{self.label(folder)}: {error.strerror}") from error

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, and the folders that are empty then."""
        try:
            for name in names:
                path = self.path / name
                path.unlink(missing_ok=True)
                if path.parent != self.path:
                    with suppress(OSError):  # others are in it
                        path.parent.rmdir()
        except OSError as error:
            raise _write_error(str(self.path), error) from error

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
        except OSError as error:
            raise DatasetError(
                f"{self.path}: {error.strerror}; expected a writable folder"
            ) from error
        if sys.platform != "win32":
            import fcntl

            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                holder = self.read(_LOCK) or b"unknown"
                self.close()
                raise DatasetError(
                    f"{self.path}: another study is writing there (process {holder.decode()}); "
                    "wait until it ends, or choose another folder"
                ) from error
            except OSError:  # a file system without locks
                pass
        with suppress(OSError):  # a full disk: who holds it is not said then
            os.ftruncate(self._lock, 0)
            os.write(self._lock, str(os.getpid()).encode())
        for folder in (
            self.path,
            self.path / "parts",
            self.path / "logs",
        ):  # what a killed writer has left
            for left in folder.glob(f"_*{_TEMPORARY}"):
                left.unlink(missing_ok=True)

    def close(self) -> None:
        """Let others write there."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def journal(self, name: str) -> FolderJournal:
        """Open a file that grows line by line."""
        return FolderJournal(self, name)


@final
class FolderJournal:
    """A file of lines; an incomplete last one is cut off."""

    def __init__(self, folder: Folder, name: str) -> None:
        self._folder = folder
        self._name = name
        self._open()

    def append(self, line: bytes) -> None:
        """Append a line: as a whole, or not at all."""
        try:
            _write(self._file, line)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self._length)
            raise _write_error(self._folder.label(self._name), error) from error
        self._length += len(line)

    def replace(self, lines: Sequence[bytes]) -> None:
        """Have these lines instead."""
        self._folder.write(self._name, b"".join(lines))
        os.close(self._file)
        self._open()

    def close(self) -> None:
        """Close it."""
        os.close(self._file)

    def _open(self) -> None:
        path = self._folder.path / self._name
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
            self._length = path.read_bytes().rfind(b"\n") + 1
            os.ftruncate(self._file, self._length)
        except OSError as error:
            raise _write_error(str(path), error) from error


@final
class Bucket:
    """Files behind a URL of fsspec; nobody keeps two studies from writing there."""

    def __init__(self, url: str) -> None:
        try:
            fsspec = import_module("fsspec")
            self._files, root = fsspec.core.url_to_fs(url)
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
        try:
            content: bytes = self._files.cat_file(f"{self._root}/{name}")
        except FileNotFoundError:
            return None
        except Exception as error:  # each kind of storage has errors of its own
            raise DatasetError(f"{self.label(name)}: {_text(error)}") from error
        return content

    def write(self, name: str, content: bytes) -> None:
        """Write a file as a whole."""
        try:
            self._files.pipe_file(self._made(name), content)
        except Exception as error:
            raise _write_error(self.label(name), error) from error

    def put(self, name: str, file: Path) -> None:
        """Move a file there."""
        try:
            self._files.put_file(str(file), self._made(name))
        except Exception as error:
            raise _write_error(self.label(name), error) from error
        file.unlink()

    def names(self, folder: str = "") -> list[str]:
        """Return the names in a folder, in order."""
        try:
            self._files.invalidate_cache()
            paths = self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=False)
        except FileNotFoundError:
            return []
        except Exception as error:
            raise DatasetError(f"{self.label(folder)}: {_text(error)}") from error
        return sorted(path.rstrip("/").rpartition("/")[2] for path in paths)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files."""
        try:
            for name in names:
                if self._files.exists(f"{self._root}/{name}"):
                    self._files.rm_file(f"{self._root}/{name}")
        except Exception as error:
            raise _write_error(self._url, error) from error

    def lock(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def journal(self, name: str) -> BucketJournal:
        """Open a file that grows line by line."""
        return BucketJournal(self, name)

    def _made(self, name: str) -> str:
        path = f"{self._root}/{name}"
        if "memory" in self._files.protocol:  # the only one that misses its folders
            self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
        return path


@final
class BucketJournal:
    """A file of lines that is written anew every few seconds."""

    def __init__(self, bucket: Bucket, name: str) -> None:
        self._bucket = bucket
        self._name = name
        content = bucket.read(name) or b""
        self._lines = content.splitlines(keepends=True)
        self._written = len(self._lines)
        self._due = time.monotonic() + _PERIOD

    def append(self, line: bytes) -> None:
        """Append a line; it is written within seconds, or when the journal is closed."""
        self._lines.append(line)
        if time.monotonic() >= self._due:
            self._write()

    def replace(self, lines: Sequence[bytes]) -> None:
        """Have these lines instead."""
        self._lines = list(lines)
        self._write()

    def close(self) -> None:
        """Write what is not written."""
        if self._written < len(self._lines):
            self._write()

    def _write(self) -> None:
        self._bucket.write(self._name, b"".join(self._lines))
        self._written = len(self._lines)
        self._due = time.monotonic() + _PERIOD


def _write(descriptor: int, content: bytes) -> None:
    view = memoryview(content)
    while view:  # a disk that gets full takes a part; the next write says why
        view = view[os.write(descriptor, view) :]


def _write_error(label: str, error: Any) -> DatasetWriteError:
    return DatasetWriteError(
        f"{label}: {_text(error)}; all outcomes so far are saved: fix this and run the study again "
        "to continue"
    )


def _text(error: Any) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
