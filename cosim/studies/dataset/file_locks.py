"""Locks of files and folders, which tell who still writes from who was killed.

The system frees a lock of a file when its process ends, however it ends. Where a file system has no
locks, a folder is locked by a file that only one process can make; what was killed has left it.
"""

from __future__ import annotations

import os
import platform
import sys
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Final, final

from cosim.errors import DatasetError

if sys.platform != "win32":
    import fcntl

LOCK: Final = "_lock"
EXCLUSIVE: Final = "_lock-exclusive"  # where there are no locks


class LockState(Enum):
    """What came of locking a file."""

    HELD = "held"
    BUSY = "busy"  # another process has it
    UNSUPPORTED = "unsupported"


def lock_file(descriptor: int) -> LockState:
    """Lock a file for as long as it is open, if no other process has."""
    if sys.platform == "win32":
        return LockState.UNSUPPORTED
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return LockState.BUSY
    except OSError:  # of the file system, such as ENOSYS, ENOTSUP and ENOLCK
        return LockState.UNSUPPORTED
    return LockState.HELD


@final
class FolderLock:
    """Keeps other processes from writing into a folder.

    Parameters
    ----------
    folder : Path
        That is there.

    Raises
    ------
    DatasetError
        If another process has it, or the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._exclusive = folder / EXCLUSIVE
        self._is_exclusive = False
        try:
            self._descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise _unwritable(folder, error) from error
        try:
            self._lock(folder)
        except BaseException:
            os.close(self._descriptor)
            raise

    def close(self) -> None:
        """Release the lock."""
        os.close(self._descriptor)
        if self._is_exclusive:
            self._exclusive.unlink(missing_ok=True)

    def _lock(self, folder: Path) -> None:
        state = lock_file(self._descriptor)
        if state is LockState.BUSY:
            raise DatasetError(
                f"{folder}: another study is writing there ({_holder(folder / LOCK)}); wait until "
                "it ends, or choose another folder"
            )
        if state is LockState.UNSUPPORTED:
            self._make_exclusive(folder)
        with suppress(OSError):  # a full disk: who holds it is not said then
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, _own_name().encode())

    def _make_exclusive(self, folder: Path) -> None:
        try:
            with open(self._exclusive, "x") as file:
                self._is_exclusive = True
                file.write(_own_name())
        except FileExistsError as error:
            raise DatasetError(
                f"{folder}: another study is writing there, or was killed "
                f"({_holder(self._exclusive)}); this file system has no locks to tell which; wait "
                f"until it ends, or, if it has ended, remove {self._exclusive}"
            ) from error
        except OSError as error:
            if self._is_exclusive:
                self._exclusive.unlink(missing_ok=True)
            raise _unwritable(folder, error) from error


def _own_name() -> str:
    return f"process {os.getpid()} on {platform.node()}"


def _holder(path: Path) -> str:
    try:
        return path.read_text(errors="replace")[:100] or "process unknown"
    except OSError:
        return "process unknown"


def _unwritable(folder: Path, error: OSError) -> DatasetError:
    return DatasetError(f"{folder}: {error.strerror}; expected a writable folder")
