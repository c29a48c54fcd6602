"""The zip archive of an .fmu: checked before anything is written, bounded while it is unpacked.

FMI 2.0.4 section 2.3, FMI 3.0 section 2.5. The file is opened once: what is hashed is what is read.
The sizes that entries declare are only a first reason to refuse; what counts is what comes out.

What is dangerous is refused, and so is what has two meanings. What does no harm on this machine,
but may on another, is a warning: names that Windows keeps for itself, names that are one where the
case does not count. So is what is listed twice, a file with the same bytes each time.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import unicodedata
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from cosim.digests import sha256_of_open
from cosim.errors import FmuError, listing
from cosim.files import check_size, regular
from cosim.fmi.platforms import SYSTEM

LARGEST: Final = 2**30  # bytes, packed and unpacked
MOST: Final = 10_000  # entries
# Bytes of the list of entries, which zipfile reads in one piece before it can be counted.
DIRECTORY: Final = 2**24
RATIO: Final = 200  # unpacked to packed, of one entry
SMALL: Final = 2**20  # bytes: a small file may be emptier than that, such as a table of zeros
DEEPEST: Final = 32  # folders in folders
LONGEST: Final = 255  # bytes of one name
XML_LARGEST: Final = 64 * 2**20  # bytes
CHUNK: Final = 2**16
# No names of files on Windows.
WINDOWS: Final = re.compile(r"(?i)(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?|.*[. ]")
ENTRY_HEADER: Final = 30  # bytes before the name of an entry
ENCRYPTED: Final = 0x2041  # flag bits: encrypted, strongly encrypted, masked
UTF8_NAME: Final = 0x800  # flag bit


@dataclass(frozen=True, slots=True)
class ArchiveContents:
    """What an archive holds.

    Parameters
    ----------
    sha256 : str
        Of the file, in hexadecimal.
    members : frozenset of str
        Names of the files in it.
    wanted : mapping of str to bytes
        Content of the members that were asked for, where they are there.
    warnings : tuple of str
        What is wrong with it and does no harm here.
    """

    sha256: str
    members: frozenset[str]
    wanted: Mapping[str, bytes]
    warnings: tuple[str, ...] = ()


def read_archive(path: Path, wanted: Sequence[str], into: Path | None = None) -> ArchiveContents:
    """Check an archive and read some members of it; unpack all of it where a folder is given.

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
    with _open(path) as (archive, sha256):
        opened = _Zip(path, archive)
        entries, warnings = opened.check_entries()
        contents = {}
        for member in wanted:
            if member in entries:
                content = io.BytesIO()
                opened.copy(entries[member], content.write, XML_LARGEST)
                contents[member] = content.getvalue()
        if into is not None:
            opened.unpack(entries, into)
        return ArchiveContents(sha256, frozenset(entries), contents, tuple(warnings))


class _Zip(NamedTuple):
    """An open archive, and the path of its file, for messages."""

    path: Path
    archive: zipfile.ZipFile

    def check_entries(self) -> tuple[Mapping[str, zipfile.ZipInfo], list[str]]:
        """Return the files by name, if the archive may be unpacked, and warnings."""
        entries = self.archive.infolist()
        _check_extent(self.path, entries)
        for entry in entries:
            # The original name: zipfile alters ``filename``, so that some problems no longer show.
            name = entry.orig_filename
            problem = _name_problem(name) or _type_problem(entry)
            if problem:
                raise FmuError(f"{self.path}: the archive has {problem}: {name!r}")
        with_backslash = [entry.orig_filename for entry in entries if "\\" in entry.orig_filename]
        warnings = []
        if with_backslash:
            text = "names with backslashes, where FMI needs '/'"
            warnings.append(f"the archive has {text}: {listing(with_backslash)}")
        listed: dict[str, list[zipfile.ZipInfo]] = {}
        for entry in entries:
            listed.setdefault(_member(entry.orig_filename), []).append(entry)
        listed.pop("", None)  # the folder that all is in
        warnings += _check_portability(self.path, list(listed))
        self._check_overlap(entries)
        warnings += self._check_duplicates(listed)
        return {name: same[0] for name, same in listed.items() if not name.endswith("/")}, warnings

    def _check_overlap(self, entries: list[zipfile.ZipInfo]) -> None:
        """Refuse entries that share packed bytes: header, name and content stand one by one."""
        end = 0
        distinct = {(entry.header_offset, entry.orig_filename): entry for entry in entries}
        for entry in sorted(distinct.values(), key=lambda entry: entry.header_offset):
            if entry.header_offset < end:
                raise FmuError(
                    f"{self.path}: the archive has overlapping entries: "
                    f"{entry.orig_filename!r} begins inside another"
                )
            encoding = "utf-8" if entry.flag_bits & UTF8_NAME else "cp437"
            name_length = len(entry.orig_filename.encode(encoding))
            end = entry.header_offset + ENTRY_HEADER + name_length + entry.compress_size
        if end > self.archive.start_dir:
            raise FmuError(
                f"{self.path}: the archive has an entry that reaches beyond the others: "
                "the file is truncated or altered"
            )

    def _check_duplicates(self, listed: Mapping[str, Sequence[zipfile.ZipInfo]]) -> list[str]:
        """Refuse a file that is there twice and not the same; return warnings about others.

        Its bytes are compared: what the entries declare is only what they declare.
        """
        files = []
        folders = []
        for name, same in listed.items():
            if len(same) == 1:
                continue
            if name.endswith("/"):
                folders.append(name)
                continue
            files.append(name)
            contents = set()
            for entry in same:
                digest = hashlib.sha256()
                self.copy(entry, digest.update, LARGEST)
                contents.add(digest.digest())
            if len(contents) > 1:
                raise FmuError(
                    f"{self.path}: the archive has {len(same)} entries of one name that differ: "
                    f"{name!r}"
                )
        kinds = {"folders twice": folders, "files twice, with equal bytes": files}
        return [
            f"the archive lists {kind}: {listing(names)}" for kind, names in kinds.items() if names
        ]

    def unpack(self, files: Mapping[str, zipfile.ZipInfo], folder: Path) -> None:
        """Unpack files, and all folders, into a folder."""
        size = 0
        for name, entry in files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("xb") as file:
                size += self.copy(entry, file.write, LARGEST - size)
        for entry in self.archive.infolist():
            target = folder / _member(entry.orig_filename)
            target.parent.mkdir(parents=True, exist_ok=True)
            if _is_folder(entry):
                target.mkdir(exist_ok=True)

    def copy(self, entry: zipfile.ZipInfo, write: Callable[[bytes], object], room: int) -> int:
        """Unpack one entry in pieces, into at most ``room`` bytes; return its size."""
        size = 0
        name = entry.orig_filename
        with self.archive.open(entry) as source:
            while chunk := source.read(CHUNK):
                size += len(chunk)
                if size > room:
                    raise FmuError(
                        f"{self.path}: {name!r} has more than {room} bytes unpacked, "
                        "which is all it may have"
                    )
                if size > max(SMALL, RATIO * entry.compress_size):
                    raise FmuError(
                        f"{self.path}: {name!r} is packed more than {RATIO} times: "
                        f"{entry.compress_size} bytes unpack to {size} or more"
                    )
                write(chunk)
        if size != entry.file_size:
            raise FmuError(
                f"{self.path}: {name!r} has {size} bytes unpacked; the archive declares "
                f"{entry.file_size}"
            )
        return size


class _BoundedFile(io.FileIO):
    """A file of which at most ``DIRECTORY`` bytes can be read at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > DIRECTORY:
            raise FmuError(
                f"{self.name}: the archive's list of entries takes {size} bytes; "
                f"expected at most {DIRECTORY}"
            )
        content = super().read(size)
        assert content is not None
        return content


@contextmanager
def _open(path: Path) -> Iterator[tuple[zipfile.ZipFile, str]]:
    """Open an archive; yield it with the SHA-256 of the file. Whatever fails is an FmuError."""
    try:
        with _BoundedFile(path, opener=regular) as file:
            check_size(path, os.fstat(file.fileno()).st_size, LARGEST)
            sha256 = sha256_of_open(file)
            with zipfile.ZipFile(file) as archive:
                try:
                    yield archive, sha256
                except FmuError:
                    raise
                # Damaged data, a full disk: zipfile raises what its parts happen to raise.
                except Exception as error:
                    reason = f"{type(error).__name__}: {error}"
                    raise FmuError(f"{path}: the archive cannot be unpacked: {reason}") from error
    except FmuError:
        raise
    except OSError as error:
        raise FmuError(f"{path} cannot be read: {error.strerror or error}") from error
    # BadZipFile, NotImplementedError, UnicodeDecodeError, struct.error, ...
    except Exception as error:
        raise FmuError(f"{path}: not an FMU, as it is no zip archive ({error})") from error


# --- checks of names ---


def _check_extent(path: Path, entries: Sequence[zipfile.ZipInfo]) -> None:
    """Check the number of entries and their size unpacked."""
    if len(entries) > MOST:
        raise FmuError(f"{path}: the archive has {len(entries)} entries; expected at most {MOST}")
    size = sum(entry.file_size for entry in entries)
    if size > LARGEST:
        raise FmuError(
            f"{path}: unpacked, the archive would have {size} bytes; expected at most {LARGEST}"
        )


def _member(name: str) -> str:
    """Return the name of an entry with the separators that FMI needs, without ``./``."""
    return "/".join(part for part in name.replace("\\", "/").split("/") if part != ".")


def _is_folder(entry: zipfile.ZipInfo) -> bool:
    return entry.orig_filename.endswith(("/", "\\"))


def _name_problem(name: str) -> str | None:
    """Return what is wrong with the name of an entry."""
    if any(re.match(r"[/\\]|[A-Za-z]:", path) for path in (name, _member(name))):
        return "an entry with an absolute path"
    if ".." in re.split(r"[/\\]", name):
        return "an entry that leads out of it"
    if _has_control_character(name):
        return "an entry with a control character in its name"
    if re.fullmatch(r"(\.[/\\])+", name):
        return None
    return _parts_problem(_member(name).removesuffix("/").split("/"))


def _parts_problem(parts: list[str]) -> str | None:
    """Return what is wrong with the names of folders and of the file in a path."""
    if "" in parts:
        return "an entry with an empty part in its path"
    longest_part = max(len(part.encode()) for part in parts)
    if len(parts) > DEEPEST or longest_part > LONGEST:
        return f"an entry whose path is too long (at most {DEEPEST} parts of {LONGEST} bytes)"
    return None


def _has_control_character(name: str) -> bool:
    categories = {unicodedata.category(character) for character in name}
    return not categories.isdisjoint(("Cc", "Cf", "Cs", "Zl", "Zp"))


def _type_problem(entry: zipfile.ZipInfo) -> str | None:
    """Return what is wrong with an entry that is no plain file or folder."""
    is_folder = _is_folder(entry)
    file_type = stat.S_IFMT(entry.external_attr >> 16)
    if file_type == stat.S_IFLNK:
        return "a link, where it may have files and folders only"
    allowed_types = (0, stat.S_IFREG, stat.S_IFDIR) if is_folder else (0, stat.S_IFREG)
    if file_type not in allowed_types:
        return "a special file, where it may have files and folders only"
    if is_folder and entry.file_size:
        return "a folder with content of its own"
    if entry.flag_bits & ENCRYPTED:
        return "an encrypted entry"
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        expected = "expected 0, stored, or 8, deflated"
        return f"an entry with compression method {entry.compress_type} ({expected})"
    return None


def _check_portability(path: Path, names: list[str]) -> list[str]:
    """Return warnings about names that cannot be unpacked on every system.

    Raises
    ------
    FmuError
        If they cannot be on this one, or a file stands where a folder is needed.
    """
    warnings = []
    kept = [name for name in names if _is_kept_by_windows(name)]
    if kept:
        text = "names that Windows keeps for devices or streams, or ends otherwise"
        if SYSTEM == "windows":
            raise FmuError(f"{path}: the archive has {text}: {kept[0]!r}")
        warnings.append(f"the archive has {text}: {listing(kept)}")
    clashes = _clashes(path, names)
    if clashes:
        text = "names that are one on some systems"
        if SYSTEM != "linux":
            raise FmuError(f"{path}: the archive has {text}: {clashes[0]}")
        warnings.append(f"the archive has {text}: {listing(clashes)}")
    return warnings


def _is_kept_by_windows(name: str) -> bool:
    parts = name.removesuffix("/").split("/")
    return any(":" in part or WINDOWS.fullmatch(part) for part in parts)


def _clashes(path: Path, names: list[str]) -> list[str]:
    """Return pairs of names that are one file on some system.

    Names are one where neither the case nor the composition of letters counts.

    Raises
    ------
    FmuError
        If a file stands where a folder is needed.
    """
    files = {name for name in names if not name.endswith("/")}
    spellings: dict[str, str] = {}
    clashes: dict[str, None] = {}
    for name in names:
        for place in _places(name):
            if place in files and place != name:
                raise FmuError(
                    f"{path}: the archive has {place!r} as a file, where {name!r} needs a folder"
                )
            other = spellings.setdefault(_normalized(place), place)
            if other != place:
                clashes[f"{other!r} and {place!r}"] = None
    return list(clashes)


def _places(name: str) -> list[str]:
    """Return the path of an entry and of every folder above it, from the outermost."""
    parts = name.removesuffix("/").split("/")
    return ["/".join(parts[:end]) for end in range(1, len(parts) + 1)]


def _normalized(name: str) -> str:
    """Return what a name is where neither case nor the composition of letters counts."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
