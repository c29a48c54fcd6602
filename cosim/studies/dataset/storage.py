"""Where a dataset is: files that are read, and written whole, by names below one place.

A place is a folder or a URL of fsspec, such as ``s3://bucket/studies/x``. A name has forward
slashes on every system.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote, urlsplit

from cosim.arguments import path_argument
from cosim.errors import UsageError


class DatasetJournal(Protocol):
    """Lines of outcomes whose part is not complete yet."""

    def append(self, line: bytes) -> None:
        """Add a line."""
        ...

    def replace(self, lines: Sequence[bytes]) -> None:
        """Keep these lines only."""
        ...

    def close(self) -> None:
        """Write what is not written yet."""
        ...


class Storage(Protocol):
    """The files of a dataset."""

    def label(self, name: str = "") -> str:
        """Return the place of a file, or of the dataset, for messages."""
        ...

    def read(self, name: str) -> bytes | None:
        """Return the content of a file; None: there is none.

        Raises
        ------
        DatasetError
            If it cannot be read.
        """
        ...

    def write(self, name: str, content: bytes) -> None:
        """Write a file whole: nobody ever finds a part of it.

        Raises
        ------
        DatasetWriteError
            If it cannot be written; what was there is there.
        """
        ...

    def put(self, name: str, file: Path) -> None:
        """Move a file of this machine to a name: nobody ever finds a part of it.

        Parameters
        ----------
        name : str
        file : Path
            Of a dataset in a folder: on the disk of that.

        Raises
        ------
        DatasetWriteError
            If it cannot be written; what was there is there.
        """
        ...

    def folder(self, name: str) -> Path | None:
        """Return the path of a folder, which may not be there; None: it is none of this machine."""
        ...

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder; none where there is no such folder."""
        ...

    def sizes(self, folder: str) -> dict[str, int]:
        """Return how many bytes the files in a folder have, by name."""
        ...

    def remove(self, names: Sequence[str], folders: Sequence[str]) -> None:
        """Remove files, and after them the folders that are empty."""
        ...

    def lock(self) -> None:
        """Keep others from writing, where that is possible, and clear what a kill left.

        Raises
        ------
        DatasetError
            If another process writes there.
        """
        ...

    def journal(self, name: str) -> DatasetJournal:
        """Open a journal to write on after its last whole line."""
        ...

    def close(self) -> None:
        """Release the lock of the place. Twice does no harm."""
        ...


def open_storage(place: str | Path) -> Storage:
    """Return the files below a folder or a URL; nothing is made.

    Raises
    ------
    UsageError
        If it is no path.
    DatasetError
        If there is no such kind of storage.
    """
    text = str(place)
    if not text:
        raise UsageError("expected a folder or URL for the dataset, got an empty path")
    if "://" not in text:
        from cosim.studies.dataset.local_storage import LocalStorage

        return LocalStorage(path_argument("place", place))
    if text.startswith(("file://", "local://")):
        from cosim.studies.dataset.local_storage import LocalStorage

        url = urlsplit(text)
        return LocalStorage(Path(unquote(url.netloc + url.path)))
    from cosim.studies.dataset.object_storage import ObjectStorage

    return ObjectStorage(text)
