"""The user's cache folder: results of trials of FMUs, and compiled files.

Each file is written whole under another name and then renamed, so that readers and writers need not
know of each other. Nothing here fails: without a folder, or with one that cannot be written, there
is no cache.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from cosim.files import expanded

VARIABLE: Final = "COSIM_CACHE"  # of the environment: the folder; empty: no cache
TRIALS: Final = "trials"
COMPILED: Final = "compiled"
_NAME: Final = re.compile(r"[0-9a-f]{64}(\.json|\.bin|\.\w+\.part)")


def cache_folder() -> Path | None:
    """Return the cache folder; None: there is none.

    That of the environment variable ``COSIM_CACHE``, else ``cosim`` in the user's folder for
    caches: ``XDG_CACHE_HOME`` or ``~/.cache``, on macOS ``~/Library/Caches``, on Windows
    ``LOCALAPPDATA``.
    """
    given = os.environ.get(VARIABLE)
    if given is not None:
        return expanded(given).absolute() if given else None
    with suppress(RuntimeError):  # no home
        return _user_caches() / "cosim"
    return None


def _user_caches() -> Path:
    match sys.platform:
        case "win32":
            local = os.environ.get("LOCALAPPDATA", "")
            return Path(local) if local else Path.home() / "AppData" / "Local"
        case "darwin":
            return Path.home() / "Library" / "Caches"
        case _:
            # A relative path is to be ignored, by the XDG Base Directory Specification.
            xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
            return xdg if xdg.is_absolute() else Path.home() / ".cache"


def keep(file: Path, content: bytes) -> None:
    """Write a file of the cache, if its folder can be written."""
    with suppress(OSError):  # a folder that cannot be written, a full disk
        file.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=file.parent, prefix=f"{file.stem}.", suffix=".part")
        try:
            with os.fdopen(descriptor, "wb") as opened:
                opened.write(content)
            os.replace(name, file)
        except OSError:
            os.unlink(name)


def cached_files(*kinds: str) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the files that are kept, those that were not finished too, with their status.

    By their names: the folder may hold files of others.

    Parameters
    ----------
    kinds : {"trials", "compiled"}
        None: all.
    """
    folder = cache_folder()
    if folder is None:
        return
    for kind in kinds or (TRIALS, COMPILED):
        for file in sorted((folder / kind).glob("*")):
            if _NAME.fullmatch(file.name):
                with suppress(OSError):  # another process may clear it
                    yield file, file.lstat()


def clear() -> int:
    """Remove what is kept; return the number of files."""
    count = 0
    for file, _ in list(cached_files()):
        with suppress(OSError):
            file.unlink()
            count += 1
    return count
