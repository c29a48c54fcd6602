"""Keep what trials of FMUs found, in the user's cache folder, by the content of the file.

One small JSON file a result, written whole under another name and then renamed, so that readers and
writers need not know of each other. It holds its key too: a file that is damaged, or another's, is
as good as none. Nothing here fails: without a folder, or with one that cannot be written, there is
no cache.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from cosim.files import read_bounded
from cosim.fmi.platforms import ARCHITECTURE, SYSTEM
from cosim.version import __version__

VARIABLE: Final = "COSIM_CACHE"  # of the environment: the folder; empty: no cache
TRIAL_VERSION: Final = 2  # to be raised where the trials themselves change
LARGEST: Final = 2**16  # bytes of one file
_NAME: Final = re.compile(r"[0-9a-f]{64}(\.json|\.\w+\.part)")


def cache_folder() -> Path | None:
    """Return the folder where results are kept; None: there is none.

    That of the environment variable ``COSIM_CACHE``, else ``cosim`` in the user's folder for
    caches: ``XDG_CACHE_HOME`` or ``~/.cache``, on macOS ``~/Library/Caches``, on Windows
    ``LOCALAPPDATA``.
    """
    given = os.environ.get(VARIABLE)
    if given is not None:
        return Path(given).absolute() if given else None
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


def read_problems(task: str, sha256: str, interface_type: str) -> tuple[str, ...] | None:
    """Return the problems that a trial found; None: they are not known.

    Parameters
    ----------
    task : str
        The trial.
    sha256 : str
        Of the FMU.
    interface_type : {"me", "cs"}
    """
    key = _key(task, sha256, interface_type)
    file = _file(key)
    if file is None:
        return None
    try:
        content = json.loads(read_bounded(file, LARGEST))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("key") != key:
        return None
    problems = content.get("problems")
    if not isinstance(problems, list) or not all(isinstance(text, str) for text in problems):
        return None
    return tuple(problems)


def keep_problems(task: str, sha256: str, interface_type: str, problems: Sequence[str]) -> None:
    """Keep the problems that a trial found, if there is a folder for them."""
    key = _key(task, sha256, interface_type)
    file = _file(key)
    content = json.dumps({"key": key, "problems": list(problems)}).encode()
    if file is None or len(content) > LARGEST:
        return
    with suppress(OSError):  # a folder that cannot be written, a full disk
        file.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=file.parent, prefix=f"{file.stem}.", suffix=".part")
        try:
            with os.fdopen(descriptor, "wb") as opened:
                opened.write(content)
            os.replace(name, file)
        except OSError:
            os.unlink(name)


def cached_files() -> Iterator[tuple[Path, int]]:
    """Yield the files that are kept, those that were not finished too, with their sizes [bytes].

    By their names: the folder may hold files of others.
    """
    folder = cache_folder()
    if folder is None:
        return
    for file in sorted((folder / "trials").glob("*")):
        if _NAME.fullmatch(file.name):
            with suppress(OSError):  # another process may clear it
                yield file, file.lstat().st_size


def clear() -> int:
    """Remove what is kept; return the number of files."""
    count = 0
    for file, _ in list(cached_files()):
        with suppress(OSError):
            file.unlink()
            count += 1
    return count


def _key(task: str, sha256: str, interface_type: str) -> dict[str, str]:
    return {
        "task": task,
        "sha256": sha256,
        "interface_type": interface_type,
        "platform": f"{ARCHITECTURE}-{SYSTEM}",
        "version": f"{__version__}, trial {TRIAL_VERSION}",
    }


def _file(key: Mapping[str, str]) -> Path | None:
    folder = cache_folder()
    if folder is None:
        return None
    text = json.dumps(key, sort_keys=True)
    return folder / "trials" / f"{hashlib.sha256(text.encode()).hexdigest()}.json"
