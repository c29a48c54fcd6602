"""Temporary folders that do not outlive the processes that need them.

A folder is locked while its process lives; however that ends, the lock ends with it. So a folder
that can be locked belongs to no process any more: the next one that needs a folder removes it.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, final

if sys.platform != "win32":
    import fcntl

PREFIX: Final = "cosim."
_SETTLED: Final = 60.0  # s after which a folder that was made has been locked, too

_swept: set[str] = set()


@final
class TemporaryFolder:
    """A folder that is removed at the end of a ``with`` block, or by :meth:`remove`.

    Parameters
    ----------
    purpose : str
        A word for its name.

    Raises
    ------
    OSError
        If it cannot be made.
    """

    def __init__(self, purpose: str) -> None:
        parent = tempfile.gettempdir()
        if parent not in _swept:
            _swept.add(parent)
            remove_abandoned(Path(parent))
        self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{purpose}-", dir=parent))
        self._lock = _lock(self.path)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove it with what it holds. Twice does no harm."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def without_folders(text: str, purpose: str) -> str:
    """Return a text in which paths into temporary folders begin there: their names are random."""
    parent = re.escape(tempfile.gettempdir())
    return re.sub(rf"{parent}[/\\]{re.escape(PREFIX + purpose)}-\w+[/\\]", "", text)


def remove_abandoned(parent: Path) -> None:
    """Remove the folders that processes of this user have left there when they were killed."""
    if sys.platform == "win32":
        return
    settled = time.time() - _SETTLED
    with suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if entry.name.startswith(PREFIX) and entry.is_dir(follow_symlinks=False):
                status = entry.stat(follow_symlinks=False)
                if status.st_uid == os.getuid() and status.st_mtime < settled:
                    _remove_abandoned(Path(entry.path))


def _remove_abandoned(folder: Path) -> None:
    lock = _lock(folder)
    if lock is not None:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _lock(folder: Path) -> int | None:
    """Lock a folder; None where another process has, or the file system cannot."""
    if sys.platform == "win32":
        return None
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor
