"""SHA-256 of files, values and this package.

A file that was read before is read again only where it may be another one.
"""

from __future__ import annotations

import json
import os
from functools import cache
from hashlib import file_digest, sha256
from pathlib import Path
from time import time_ns
from typing import Any, BinaryIO, Final, TypeAlias, final

from cosim.files import regular

# device, number, bytes, time of the content and of any change [ns]
FileState: TypeAlias = tuple[int, int, int, int, int]

# Times of files advance by ticks of the system: within one a second change cannot be seen.
SETTLED_NS: Final = 50_000_000

_SOURCES: Final = frozenset({".py", ".c", ".h", ".toml"})


def sha256_of(path: str | Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal; it is never in memory as a whole.

    Raises
    ------
    OSError
        If it is no regular file, or cannot be read.
    """
    with open(path, "rb", opener=regular) as file:
        return sha256_of_open(file)


def sha256_of_open(file: BinaryIO) -> str:
    """Return the SHA-256 of what follows in an open file, in hexadecimal."""
    return file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


def digest_of(value: Any) -> str:
    """Return the SHA-256 of plain values, whatever the order of their keys, in hexadecimal."""
    text = json.dumps(value, sort_keys=True, default=str)
    return sha256(text.encode()).hexdigest()


@cache
def source_digest() -> str:
    """Return what tells the source of cosim from another of the same version."""
    root = Path(__file__).parent
    digest = sha256()
    for path in sorted(root.rglob("*")):
        if path.suffix in _SOURCES and path.is_file():
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:12]


@final
class FileDigests:
    """The SHA-256 of files by path.

    A file is read again where its size, its times or its place on the disk are others; links are
    followed each time.
    """

    def __init__(self) -> None:
        self._known: dict[str, tuple[FileState, str]] = {}

    def of(self, path: str) -> str:
        """Return the SHA-256 of a file as it is now.

        Raises
        ------
        OSError
            If it is no regular file, or cannot be read.
        """
        state = _state_of(path)
        known = self._known.get(path)
        if known is not None and known[0] == state:
            return known[1]
        is_settled = not 0 <= time_ns() - state[-1] < SETTLED_NS
        # the state is that before it is read: a file that changes meanwhile is read again
        digest = sha256_of(path)
        if is_settled:
            self._known[path] = (state, digest)
        return digest


def _state_of(path: str) -> FileState:
    status = os.stat(path)
    return (
        status.st_dev,
        status.st_ino,
        status.st_size,
        status.st_mtime_ns,
        status.st_ctime_ns,
    )
