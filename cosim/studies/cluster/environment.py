"""What a machine computes with: two whose answers differ may come to different numbers."""

from __future__ import annotations

import platform
import zipfile
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from cosim.digests import source_digest
from cosim.fmi import platforms
from cosim.version import __version__

_WORDS: Final = {
    "python": "Python",
    "cosim": "cosim",
    "content": "a cosim whose source has the hash",
    "numpy": "numpy",
    "scipy": "scipy",
}


def describe_environment() -> dict[str, str]:
    """Return the versions and the platform of this process."""
    major, minor, _ = platform.python_version_tuple()
    return {
        "python": f"{major}.{minor}",
        "cosim": __version__,
        "content": source_digest(),
        "numpy": _version_of("numpy"),
        "scipy": _version_of("scipy"),
        "system": platforms.SYSTEM,
        "architecture": platforms.ARCHITECTURE,
    }


def lacks(own: Mapping[str, str], found: Mapping[str, str]) -> str:
    """Return what a worker has otherwise than this process; empty: nothing that matters.

    Its platform may be another: see :func:`without_binary`.
    """
    differences = []
    for key, word in _WORDS.items():
        if own[key] != found[key]:
            differences.append(f"expected {word} {own[key]}, got {found[key]}")
    return "; ".join(differences)


def binary_folders(files: Iterable[str]) -> dict[str, list[str]]:
    """Return the platforms for which the FMUs among some files have binaries.

    FMUs without any, and what is no FMU, are left out: that shows when they are opened.
    """
    found = {}
    for path in files:
        if not path.endswith(".fmu"):
            continue
        try:
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
        except (OSError, zipfile.BadZipFile):
            continue
        split = (name.split("/") for name in names)
        folders = {parts[1] for parts in split if parts[0] == "binaries" and len(parts) > 2}
        if folders:
            found[path] = sorted(folders)
    return found


def without_binary(
    folders: Mapping[str, list[str]], system: str, architecture: str
) -> dict[str, list[str]]:
    """Return the FMUs that have no binary for a platform, with those for which they have one."""
    needed = {f"{architecture}-{system}"}
    if architecture == "x86_64":
        needed |= {{"linux": "linux64", "darwin": "darwin64", "windows": "win64"}.get(system, "")}
    return {path: found for path, found in folders.items() if not needed & set(found)}


def _version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"
