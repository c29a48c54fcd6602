"""The zip archive of an .fmu, judged before anything of it is used (FMI 2.0.4 section 2.3, FMI 3.0 section 2.5)."""

from __future__ import annotations

import re
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from cosim.errors import FmuError

LARGEST: Final = 2**30  # bytes, unpacked
MOST: Final = 10_000  # entries


def look(path: Path, member: str) -> tuple[frozenset[str], bytes | None]:
    """Give the names of the files in an archive, and the content of one of them; None: it is not there.

    Raises
    ------
    FmuError
        If it is no zip archive, or one that must not or cannot be unpacked.
    """
    with _opened(path) as archive:
        members = frozenset(archive.namelist())
        return members, archive.read(member) if member in members else None


def unpack(path: Path, folder: Path) -> None:
    """Unpack an archive.

    Raises
    ------
    FmuError
        As ``look``.
    """
    with _opened(path) as archive:
        archive.extractall(folder)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            _check_size(path, entries)
            for entry in entries:
                _check_entry(path, entry)
            try:
                yield archive
            except Exception as error:  # damaged, encrypted, a full disk: zipfile raises what its parts happen to raise
                raise FmuError(f"{path}: the archive cannot be unpacked: {type(error).__name__}: {error}") from error
    except FmuError:
        raise
    except OSError as error:
        raise FmuError(f"{path} cannot be read: {error.strerror}") from error
    except Exception as error:  # BadZipFile, NotImplementedError, UnicodeDecodeError, struct.error, ...
        raise FmuError(f"{path}: not an FMU, as it is no zip archive ({error})") from error


def _check_size(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    if len(entries) > MOST:
        raise FmuError(f"{path}: the archive has {len(entries)} entries; needed at most {MOST}")
    size = sum(entry.file_size for entry in entries)
    if size > LARGEST:
        raise FmuError(f"{path}: unpacked, the archive would have {size} bytes; needed at most {LARGEST}")


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.orig_filename  # zipfile alters the other one
    if re.match(r"[/\\]|[A-Za-z]:", name):
        raise FmuError(f"{path}: the archive has an entry with an absolute path: {name!r}")
    if ".." in re.split(r"[/\\]", name):
        raise FmuError(f"{path}: the archive has an entry that leads out of it: {name!r}")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise FmuError(f"{path}: the archive has a link: {name!r}; needed files and folders only")
