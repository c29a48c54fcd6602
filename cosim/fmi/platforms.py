"""The binary of an FMU for this machine: where it is, and how it is loaded.

FMI 2.0.4 section 2.3, FMI 3.0 section 2.5.1.
"""

from __future__ import annotations

import platform
import sys
import threading
from collections.abc import Collection
from contextlib import chdir
from ctypes import CDLL
from pathlib import Path
from typing import Final

_LOADING: Final = threading.RLock()  # two would put back each other's working directory
_ARCHITECTURES: Final = {"AMD64": "x86_64", "arm64": "aarch64"}
_SYSTEMS: Final = {"linux": "linux", "darwin": "darwin", "win32": "windows"}
_SHORT: Final = {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}

ARCHITECTURE: Final = _ARCHITECTURES.get(platform.machine(), platform.machine())
SYSTEM: Final = _SYSTEMS.get(sys.platform, sys.platform)
SUFFIX: Final = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}.get(SYSTEM, ".so")


def folders(version: str) -> tuple[str, ...]:
    """Return the folders under ``binaries/`` to look in, the usual one first."""
    exact = f"{ARCHITECTURE}-{SYSTEM}"
    if version.startswith("3.") or ARCHITECTURE != "x86_64":
        return (exact,)
    return (_SHORT[SYSTEM], exact)


def cure(path: Path, members: Collection[str]) -> str:
    """Return what to do about an FMU without a binary for this machine."""
    if any(name.startswith("sources/") for name in members):
        return f"it has sources: 'cosim compile {path}' makes a copy with a binary of them"
    return "it has no sources either: export it for this platform in the tool that made it"


def load_library(path: Path) -> CDLL:
    """Load a binary; meanwhile its folder is the working directory, if there is more in it.

    As in other tools: a binary may open what is beside it by ``dlopen("./libother.so")``. The
    working directory is one for all threads: where nothing is beside the binary it stays.

    Raises
    ------
    OSError
        If it cannot be loaded.
    """
    absolute = path.absolute()
    if all(other.name == path.name for other in path.parent.iterdir()):
        return CDLL(str(absolute))
    with _LOADING, chdir(path.parent):
        return CDLL(str(absolute))
