"""FMUs that are opened again and again in one process: unpacked once, and loaded once.

Every opening has an instance of its own. A binary that can be instantiated only once per process
keeps what it knows in its own memory, as a rule: it is unloaded with every instance, so that the
next one finds it as the first did, and what opens it meanwhile unpacks a copy of its own.

Of many FMUs those that were not opened for the longest are unloaded and removed; they are unpacked
again when they are opened again.
"""

from __future__ import annotations

from ctypes import CDLL
from dataclasses import replace
from pathlib import Path
from typing import Final, final

from cosim.digests import FileDigests
from cosim.fmi.binary.library import unload
from cosim.fmi.platforms import load_library
from cosim.fmi.reading.model_description import Archive, read
from cosim.temporary import TemporaryFolder

MOST_FMUS: Final = 64  # that are unpacked and not open; each has a file open, too
MOST_BYTES: Final = 2**30  # of these; temporary folders may be in memory


@final
class UnpackedFmu:
    """An FMU in a folder.

    Parameters
    ----------
    archive : Archive
    folder : TemporaryFolder

    Attributes
    ----------
    size : int
        Of its files [bytes].
    openings : int
        How many have it now.
    keeps_values : bool
        Whether it can be instantiated only once per process.
    """

    def __init__(self, archive: Archive, folder: TemporaryFolder) -> None:
        self.archive = archive
        self._folder = folder
        self._libraries: dict[Path, CDLL] = {}
        self.openings = 0
        capabilities = archive.description.capabilities.values()
        self.keeps_values = any(capability.once_per_process for capability in capabilities)
        self.size = sum(path.stat().st_size for path in folder.path.rglob("*") if path.is_file())

    @property
    def path(self) -> Path:
        """The folder."""
        return self._folder.path

    def take(self) -> None:
        """Keep it until it is given back."""
        self.openings += 1

    def give_back(self) -> None:
        """Say that one who took it does not need it any more."""
        self.openings -= 1

    def keep_loaded(self, library: Path) -> None:
        """Keep a binary in memory that is loaded, unless it keeps values of its instance."""
        if not self.keeps_values and library not in self._libraries:
            self._libraries[library] = load_library(library)

    def remove(self) -> None:
        """Unload the binaries, and remove the folder."""
        for library in self._libraries.values():
            unload(library)
        self._libraries.clear()
        self._folder.remove()


@final
class UnpackedFmus:
    """FMUs by their content; closed, it leaves nothing behind.

    What was opened has to be closed before.

    Parameters
    ----------
    digests : FileDigests, optional
        Of the files, where others ask for them, too.
    most : int
        FMUs that may stay unpacked while they are not open.
    most_bytes : int
        The most that these may have together.
    """

    def __init__(
        self,
        digests: FileDigests | None = None,
        *,
        most: int = MOST_FMUS,
        most_bytes: int = MOST_BYTES,
    ) -> None:
        self._digests = FileDigests() if digests is None else digests
        self._most = most
        self._most_bytes = most_bytes
        self._by_hash: dict[str, UnpackedFmu] = {}  # the one that was opened last is the last

    def close(self) -> None:
        """Unload and remove all of them."""
        for unpacked in self._by_hash.values():
            unpacked.remove()
        self._by_hash.clear()

    def take(self, path: Path) -> tuple[Archive, UnpackedFmu]:
        """Return what was read from an FMU, and where it is unpacked, until it is given back.

        Raises
        ------
        FmuError
            If it is no FMU.
        """
        known = self._by_hash.pop(self._hash(path), None)
        if known is None:
            known = self._unpack(path)
            self._remove_oldest()
        self._by_hash[known.archive.sha256] = known
        known.take()
        return replace(known.archive, path=path), known

    def _hash(self, path: Path) -> str:
        """Return the SHA-256 of a file; empty: it is none, and what reads it says why."""
        try:
            return self._digests.of(str(path))
        except (OSError, ValueError):
            return ""

    def _unpack(self, path: Path) -> UnpackedFmu:
        folder = TemporaryFolder("fmu")
        try:
            archive = read(path, into=folder.path)
            unpacked = UnpackedFmu(archive, folder)
        except BaseException:
            folder.remove()
            raise
        known = self._by_hash.pop(archive.sha256, None)  # the file changed to a known one
        if known is None:
            return unpacked
        folder.remove()
        return known

    def _remove_oldest(self) -> None:
        """Remove what was not opened for the longest, as far as there are too many."""
        idle = [unpacked for unpacked in self._by_hash.values() if not unpacked.openings]
        size = sum(unpacked.size for unpacked in idle)
        for number, unpacked in enumerate(idle):
            if len(idle) - number <= self._most and size <= self._most_bytes:
                break
            size -= unpacked.size
            del self._by_hash[unpacked.archive.sha256]
            unpacked.remove()
