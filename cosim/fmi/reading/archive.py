"""The zip archive of an .fmu: judged before anything is written, bounded while it is unpacked.

FMI 2.0.4 section 2.3, FMI 3.0 section 2.5. The file is opened once: what is hashed is what is read. The sizes that entries
declare are only a first reason to refuse; what counts is what comes out.
"""

from __future__ import annotations

import hashlib
import io
import re
import stat
import unicodedata
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cosim.errors import FmuError

LARGEST: Final = 2**30  # bytes, unpacked
MOST: Final = 10_000  # entries
DIRECTORY: Final = (
    2**24
)  # bytes of the list of entries, which zipfile reads in one piece before it can be counted
RATIO: Final = 200  # unpacked to packed, of one entry
SMALL: Final = 2**20  # bytes: a small file may be emptier than that, such as a table of zeros
DEEPEST: Final = 32  # folders in folders
LONGEST: Final = 255  # bytes of one name
XML_LARGEST: Final = 64 * 2**20  # bytes
CHUNK: Final = 2**16
WINDOWS: Final = re.compile(
    r"(?i)(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?|.*[. ]"
)  # no names of files there


@dataclass(frozen=True, slots=True)
class ArchiveContents:
    """What an archive was found to hold.

    Parameters
    ----------
    sha256 : str
        Of the file, in hexadecimal.
    members : frozenset of str
        Names of the files in it.
    wanted : mapping of str to bytes
        Content of the members that were asked for, where they are there.
    """

    sha256: str
    members: frozenset[str]
    wanted: Mapping[str, bytes]


def look(path: Path, wanted: Sequence[str], into: Path | None = None) -> ArchiveContents:
    """Judge an archive and read some members of it; unpack all of it where a folder is given.

    Parameters
    ----------
    path : Path
    wanted : sequence of str
        Members of at most ``XML_LARGEST`` bytes each.
    into : Path or None
        An empty folder. Nothing is ever written outside of it; after an error it holds a part.

    Raises
    ------
    FmuError
        If it is no zip archive, or one that must not or cannot be unpacked.
    """
    with _opened(path) as (archive, sha256):
        files = _judged(path, archive)
        read = {member: io.BytesIO() for member in wanted if member in files}
        for member, content in read.items():
            _copy(path, archive, files[member], content.write, XML_LARGEST)
        if into is not None:
            _unpack(path, archive, files, into)
        return ArchiveContents(
            sha256,
            frozenset(files),
            {member: content.getvalue() for member, content in read.items()},
        )


class _Bounded(io.FileIO):
    """A file that does not give more than ``DIRECTORY`` bytes at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > DIRECTORY:
            raise FmuError(
                f"{self.name}: the archive's list of entries takes {size} bytes; needed at most {DIRECTORY}"
            )
        found = super().read(size)
        assert found is not None
        return found


@contextmanager
def _opened(path: Path) -> Iterator[tuple[zipfile.ZipFile, str]]:
    try:
        with _Bounded(path) as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            with zipfile.ZipFile(file) as archive:
                try:
                    yield archive, sha256
                except FmuError:
                    raise
                except (
                    Exception
                ) as error:  # damaged, a full disk: zipfile raises what its parts happen to raise
                    raise FmuError(
                        f"{path}: the archive cannot be unpacked: {type(error).__name__}: {error}"
                    ) from error
    except FmuError:
        raise
    except OSError as error:
        raise FmuError(f"{path} cannot be read: {error.strerror or error}") from error
    except (
        Exception
    ) as error:  # BadZipFile, NotImplementedError, UnicodeDecodeError, struct.error, ...
        raise FmuError(f"{path}: not an FMU, as it is no zip archive ({error})") from error


# --- judging ---


def _judged(path: Path, archive: zipfile.ZipFile) -> Mapping[str, zipfile.ZipInfo]:
    """Give the files by name, if the archive may be unpacked."""
    entries = archive.infolist()
    if len(entries) > MOST:
        raise FmuError(f"{path}: the archive has {len(entries)} entries; needed at most {MOST}")
    _check_size(path, sum(entry.file_size for entry in entries))
    for entry in entries:
        problem = _name_problem(entry.orig_filename) or _kind_problem(
            entry
        )  # zipfile alters the other name
        if problem:
            raise FmuError(f"{path}: the archive has {problem}: {entry.orig_filename!r}")
    _check_clashes(path, [entry.orig_filename for entry in entries])
    _check_overlap(path, archive, entries)
    return {
        entry.orig_filename: entry for entry in entries if not entry.orig_filename.endswith("/")
    }


def _check_size(path: Path, size: int) -> None:
    if size > LARGEST:
        raise FmuError(
            f"{path}: unpacked, the archive would have {size} bytes; needed at most {LARGEST}"
        )


def _name_problem(name: str) -> str | None:
    """Say what is wrong with the name of an entry."""
    parts = name.removesuffix("/").split("/")
    if re.match(r"[/\\]|[A-Za-z]:", name):
        return "an entry with an absolute path"
    if ".." in re.split(r"[/\\]", name):
        return "an entry that leads out of it"
    if "\\" in name:
        return "an entry with a backslash in its name, where FMI needs '/'"
    if any(unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp") for letter in name):
        return "an entry with a control character in its name"
    if "" in parts or "." in parts:
        return "an entry with an empty part in its path"
    if ":" in name or any(WINDOWS.fullmatch(part) for part in parts):
        return "an entry with a name that Windows keeps for devices or streams, or ends otherwise"
    if len(parts) > DEEPEST or any(len(part.encode()) > LONGEST for part in parts):
        return f"an entry whose path is too long (at most {DEEPEST} parts of {LONGEST} bytes)"
    return None


def _kind_problem(entry: zipfile.ZipInfo) -> str | None:
    """Say what is wrong with an entry that is no plain file or folder."""
    kind, folder = stat.S_IFMT(entry.external_attr >> 16), entry.orig_filename.endswith("/")
    if kind == stat.S_IFLNK:
        return "a link, where it may have files and folders only"
    if kind not in (0, stat.S_IFREG) and not (folder and kind == stat.S_IFDIR):
        return "a special file, where it may have files and folders only"
    if folder and entry.file_size:
        return "a folder with content of its own"
    if entry.flag_bits & 0x2041:  # encrypted, strongly encrypted, masked
        return "an encrypted entry"
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return f"an entry with compression method {entry.compress_type} (needed 0, stored, or 8, deflated)"
    return None


def _check_clashes(path: Path, names: list[str]) -> None:
    """Refuse names that are one file on some system: duplicates, other case or composition, a file where a folder is needed."""
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FmuError(f"{path}: the archive has two entries of one name: {twice!r}")
    files = {name for name in names if not name.endswith("/")}
    spelled: dict[str, str] = {}
    for name in names:
        parts = name.removesuffix("/").split("/")
        for place in ("/".join(parts[:end]) for end in range(1, len(parts) + 1)):
            if place in files and place != name:
                raise FmuError(
                    f"{path}: the archive has {place!r} as a file, where {name!r} needs a folder"
                )
            other = spelled.setdefault(_key(place), place)
            if other != place:
                raise FmuError(
                    f"{path}: the archive has names that are one on some systems: {other!r} and {place!r}"
                )


def _key(name: str) -> str:
    """Give what a name is where neither case nor the composition of letters counts."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _check_overlap(path: Path, archive: zipfile.ZipFile, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse entries that share their packed bytes: 30 bytes of header, the name and the packed content stand one by one."""
    end = 0
    for entry in sorted(entries, key=lambda entry: entry.header_offset):
        if entry.header_offset < end:
            raise FmuError(
                f"{path}: the archive has overlapping entries: {entry.orig_filename!r} begins inside another"
            )
        end = (
            entry.header_offset
            + 30
            + len(entry.orig_filename.encode("utf-8" if entry.flag_bits & 0x800 else "cp437"))
        )
        end += entry.compress_size
    if end > archive.start_dir:
        raise FmuError(
            f"{path}: the archive has an entry that reaches beyond the others: the file is truncated or altered"
        )


# --- unpacking ---


def _unpack(
    path: Path, archive: zipfile.ZipFile, files: Mapping[str, zipfile.ZipInfo], folder: Path
) -> None:
    size = 0
    for name, entry in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            size += _copy(path, archive, entry, file.write, LARGEST - size)
    for entry in archive.infolist():
        (folder / entry.orig_filename).parent.mkdir(parents=True, exist_ok=True)
        if entry.orig_filename.endswith("/"):
            (folder / entry.orig_filename).mkdir(exist_ok=True)


def _copy(
    path: Path,
    archive: zipfile.ZipFile,
    entry: zipfile.ZipInfo,
    write: Callable[[bytes], object],
    room: int,
) -> int:
    """Unpack one entry in pieces, into at most ``room`` bytes; give its size."""
    size = 0
    with archive.open(entry) as source:
        while chunk := source.read(CHUNK):
            size += len(chunk)
            if size > room:
                raise FmuError(
                    f"{path}: {entry.orig_filename!r} has more than {room} bytes unpacked, which is all it may have"
                )
            if size > max(SMALL, RATIO * entry.compress_size):
                raise FmuError(
                    f"{path}: {entry.orig_filename!r} is packed more than {RATIO} times: {entry.compress_size} bytes unpack to "
                    f"{size} or more"
                )
            write(chunk)
    if size != entry.file_size:
        raise FmuError(
            f"{path}: {entry.orig_filename!r} has {size} bytes unpacked; the archive says {entry.file_size}"
        )
    return size
