"""FMUs that are opened again and again in one process: unpacked once, and loaded once.

Every opening has an instance of its own. A binary that can be instantiated only once per process
keeps what it knows in its own memory, as a rule: it is unloaded with every instance, so that the
next one finds it as the first did.
"""

from __future__ import annotations

import hashlib
import os
from ctypes import CDLL
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self, TypeAlias, final

from cosim.fmi.binary.library import unload
from cosim.fmi.reading.model_description import Archive, read
from cosim.temporary import TemporaryFolder

FileIdentity: TypeAlias = tuple[int, int, int, int]  # device, number, bytes, time of change [ns]


@final
class UnpackedFmu:
    """An FMU in a folder.

    Parameters
    ----------
    archive : Archive
    folder : TemporaryFolder
    """

    def __init__(self, archive: Archive, folder: TemporaryFolder) -> None:
        self.archive = archive
        self._folder = folder
        self._libraries: dict[Path, CDLL] = {}

    @property
    def path(self) -> Path:
        """The folder."""
        return self._folder.path

    def keep_loaded(self, library: Path) -> None:
        """Keep a binary in memory that is loaded."""
        if library not in self._libraries:
            self._libraries[library] = CDLL(str(library))

    def remove(self) -> None:
        """Unload the binaries, and remove the folder."""
        for library in self._libraries.values():
            unload(library)
        self._libraries.clear()
        self._folder.remove()


@final
class UnpackedFmus:
    """FMUs by their content; a context manager that leaves nothing behind.

    What was opened has to be closed before.
    """

    def __init__(self) -> None:
        self._by_hash: dict[str, UnpackedFmu] = {}
        self._hashes: dict[Path, tuple[FileIdentity, str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Unload and remove all of them."""
        for unpacked in self._by_hash.values():
            unpacked.remove()
        self._by_hash.clear()
        self._hashes.clear()

    def find(self, path: Path) -> tuple[Archive, UnpackedFmu]:
        """Return what was read from an FMU, and where it is unpacked.

        Raises
        ------
        FmuError
            If it is no FMU.
        """
        known = self._by_hash.get(self._hash(path))
        if known is None:
            known = self._unpack(path)
        return replace(known.archive, path=path), known

    def _hash(self, path: Path) -> str:
        """Return the SHA-256 of a file, which is read where it has changed; empty: it is none."""
        try:
            status = os.stat(path)
            identity = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
            known = self._hashes.get(path)
            if known is None or known[0] != identity:
                with path.open("rb") as file:
                    known = (identity, hashlib.file_digest(file, "sha256").hexdigest())
                self._hashes[path] = known
        except OSError:
            return ""  # what reads it says why
        return known[1]

    def _unpack(self, path: Path) -> UnpackedFmu:
        folder = TemporaryFolder("fmu")
        try:
            archive = read(path, into=folder.path)
        except BaseException:
            folder.remove()
            raise
        unpacked = UnpackedFmu(archive, folder)
        other = self._by_hash.setdefault(archive.sha256, unpacked)
        if other is not unpacked:
            folder.remove()
        return other
