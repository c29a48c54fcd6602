"""A file that a run has written, to be read whatever is at its path by now."""

from __future__ import annotations

import io
import os
import weakref
from collections import deque
from pathlib import Path
from typing import Any, Final, final

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
