"""A new file that stands under a hidden name until it has something to show; what stood at its path is untouched until then."""

from __future__ import annotations

import io
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import final

from cosim.errors import LogError

_NAME = 48  # characters of the path's name that the hidden one keeps: names end at 255 bytes


def create(path: Path) -> io.RawIOBase:
    """Create a file that is not there yet, unbuffered."""
    return path.open("xb", buffering=0)


@final
class UnfinishedLog:
    """A file to be published, or discarded.

    Parameters
    ----------
    path : Path
        Where it goes; missing folders are created.
    force : bool
        Replace what stands there.
    """

    def __init__(self, path: Path, *, force: bool) -> None:
        self.path, self._force = path, force
        self.published = False
        self._hidden: Path | None = None
        self._stream: io.RawIOBase | None = None

    def create(self) -> io.RawIOBase:
        """Create the file beside its path, under the hidden name.

        Raises
        ------
        LogError
            If that cannot be done.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._hidden = self.path.with_name(f".{self.path.name[:_NAME]}.{secrets.token_hex(4)}")
            self._stream = create(self._hidden)
        except OSError as error:
            raise LogError(f"{self.path} cannot be created: {error.strerror or error}") from error
        return self._stream

    def publish(self) -> None:
        """Give the file its path, the first time this is called; it stays open.

        Raises
        ------
        LogError
            If something has come to stand there meanwhile and ``force`` is false, or the file cannot be moved.
        """
        if self.published:
            return
        assert self._hidden is not None
        try:
            if self._force:
                self._hidden.replace(self.path)  # whoever has the old file open keeps it whole
            else:
                _move(self._hidden, self.path)
        except FileExistsError as error:
            raise LogError(
                f"{self.path} exists by now; choose another path, or --force to replace it"
            ) from error
        except OSError as error:
            raise LogError(f"{self.path} cannot be created: {error.strerror or error}") from error
        self.published = True

    def discard(self) -> None:
        """Remove the file if it was not published."""
        if self.published or self._hidden is None:
            return
        with suppress(OSError):  # what brought us here is the error to tell
            if self._stream is not None:
                self._stream.close()
            self._hidden.unlink(missing_ok=True)


def _move(source: Path, target: Path) -> None:
    """Rename a file and never replace another, which ``rename`` would."""
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except (
        OSError
    ):  # a file system without hard links: reserve the name, then replace what reserves it
        target.open("xb").close()
        source.replace(target)
    else:
        source.unlink()
