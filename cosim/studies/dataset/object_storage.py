"""A dataset at a URL of fsspec, such as an S3 bucket.

An object is put whole, so nobody finds a part of it. There is no lock: that only one study writes
there is for the user to see to. There is nothing to append to either: the journal is put as a whole
when an outcome comes, at most every few seconds, and when the study ends; a kill loses what came
after.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final, final

from cosim.errors import DatasetError, DatasetWriteError

_PERIOD: Final = 10.0  # s between two writes of a journal


@final
class ObjectStorage:
    """The files of a dataset below a URL.

    Parameters
    ----------
    url : str

    Raises
    ------
    DatasetError
        If no installed library knows its kind.
    """

    def __init__(self, url: str) -> None:
        try:
            fsspec = import_module("fsspec")
        except ImportError as error:
            raise DatasetError(
                f"{url}: a dataset outside of a local folder needs fsspec, which is not "
                "installed: pip install fsspec, or, in a clone of cosim, pip install -e "
                "'.[study]'"
            ) from error
        try:
            self._files, root = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:  # a library for this protocol; no such protocol
            raise DatasetError(f"{url}: {error}") from error
        self._url = url.rstrip("/")
        self._root = root.rstrip("/")

    def label(self, name: str = "") -> str:
        """Return the URL of a file, or of the dataset."""
        return f"{self._url}/{name}" if name else self._url

    def read(self, name: str) -> bytes | None:
        """Return the content of an object; None: there is none."""
        try:
            content: bytes = self._files.cat_file(self._path(name))
        except FileNotFoundError:
            return None
        except Exception as error:  # each kind of storage has errors of its own
            raise self._error(name, error) from error
        return content

    def write(self, name: str, content: bytes) -> None:
        """Put an object whole."""
        try:
            self._files.pipe_file(self._writable(name), content)
        except Exception as error:  # each kind of storage has errors of its own
            raise self._write_error(name, error) from error

    def put(self, name: str, file: Path) -> None:
        """Put an object whole, however many requests that takes; the file is removed."""
        try:
            self._files.put_file(str(file), self._writable(name))
        except Exception as error:  # each kind of storage has errors of its own
            raise self._write_error(name, error) from error
        file.unlink()

    def folder(self, name: str) -> None:
        """Return None: there are no folders of this machine."""

    def names(self, folder: str) -> list[str]:
        """Return the names of the objects in a folder, in order."""
        return sorted(self.sizes(folder))

    def sizes(self, folder: str) -> dict[str, int]:
        """Return how many bytes the objects in a folder have, by name."""
        path = self._path(folder)
        try:
            self._files.invalidate_cache()
            objects = self._files.ls(path, detail=True)
        except FileNotFoundError:
            return {}
        except Exception as error:  # each kind of storage has errors of its own
            raise self._error(folder, error) from error
        return {entry["name"].rstrip("/").rpartition("/")[2]: entry["size"] for entry in objects}

    def remove(self, names: Sequence[str], folders: Sequence[str]) -> None:
        """Remove objects; there are no folders."""
        try:
            for name in names:
                if self._files.exists(self._path(name)):
                    self._files.rm_file(self._path(name))
        except Exception as error:  # each kind of storage has errors of its own
            raise DatasetWriteError(f"{self._url}: {_text(error)}") from error

    def lock(self) -> None:
        """Do nothing: there are no locks."""

    def journal(self, name: str) -> PutJournal:
        """Open a journal to write on after its last whole line."""
        return PutJournal(self, name)

    def close(self) -> None:
        """Do nothing."""

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _writable(self, name: str) -> str:
        """Return the path of an object that is going to be put."""
        path = self._path(name)
        if "memory" in self._files.protocol:
            self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
        return path

    def _write_error(self, name: str, error: Exception) -> DatasetWriteError:
        return DatasetWriteError(
            f"{self.label(name)}: {_text(error)}; all outcomes so far are saved: fix this and run "
            "the study again to continue"
        )

    def _error(self, name: str, error: Exception) -> DatasetError:
        return DatasetError(f"{self.label(name)}: {_text(error)}")


@final
class PutJournal:
    """A journal that is put as a whole, not more often than every few seconds.

    Parameters
    ----------
    storage : ObjectStorage
    name : str
    """

    def __init__(self, storage: ObjectStorage, name: str) -> None:
        self._storage = storage
        self._name = name
        content = storage.read(name) or b""
        self._lines = content.splitlines(keepends=True)
        self._is_put = True
        self._due = time.monotonic() + _PERIOD

    def append(self, line: bytes) -> None:
        """Add a line."""
        self._lines.append(line)
        self._is_put = False
        if time.monotonic() >= self._due:
            self._put()

    def replace(self, lines: Sequence[bytes]) -> None:
        """Keep these lines only."""
        self._lines = list(lines)
        self._put()

    def close(self) -> None:
        """Put what is not put yet."""
        if not self._is_put:
            self._put()

    def _put(self) -> None:
        self._storage.write(self._name, b"".join(self._lines))
        self._is_put = True
        self._due = time.monotonic() + _PERIOD


def _text(error: Any) -> str:
    return str(error) or type(error).__name__
