"""Compile the sources of an exported FMU, for this machine or for others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cosim.errors import FmuError, nearest, option
from cosim.fmi.compiling import compile_library
from cosim.fmi.platforms import ARCHITECTURE, SUFFIX, SYSTEM, folders
from cosim.native import build
from cosim.temporary import TemporaryFolder


@dataclass(frozen=True, slots=True)
class Platform:
    """A machine to compile for.

    Parameters
    ----------
    target : str
        Its name to zig; on Linux with the oldest C library that will do.
    suffix : str
        Of its shared libraries.
    short : str or None
        Its folder under ``binaries/`` in FMI 2.0; None: the standard has no name for it.
    """

    target: str
    suffix: str
    short: str | None


PLATFORMS: Final[Mapping[str, Platform]] = {
    "x86_64-linux": Platform("x86_64-linux-gnu.2.17", ".so", "linux64"),
    "aarch64-linux": Platform("aarch64-linux-gnu.2.17", ".so", None),
    "x86_64-windows": Platform("x86_64-windows-gnu", ".dll", "win64"),
    "x86_64-darwin": Platform("x86_64-macos", ".dylib", "darwin64"),
    "aarch64-darwin": Platform("aarch64-macos", ".dylib", None),
}


@dataclass(frozen=True, slots=True)
class Binary:
    """A shared library in an archive.

    Parameters
    ----------
    folder : str
        Under ``binaries/``.
    name : str
        Of the file.
    content : bytes
    note : str
        What is to be known about the folder.
    """

    folder: str
    name: str
    content: bytes
    note: str = ""


def check_platforms(platforms: Sequence[str]) -> None:
    """Check that these platforms can be compiled for.

    Raises
    ------
    FmuError
        If a name is not known, stands twice, or there is no cross compiler.
    """
    for name in platforms:
        if name not in PLATFORMS:
            raise FmuError(f"unknown platform {name!r}; {nearest(name, PLATFORMS)}")
        if platforms.count(name) > 1:
            raise FmuError(f"platform {name!r} is given twice")
    if platforms and not build.cross_compiler(""):
        raise FmuError(
            f"platform {', '.join(platforms)}: other machines are compiled for with ziglang, which "
            f"is not installed; pip install ziglang, or leave {option('platform')} out to compile "
            "for this machine with its own compiler"
        )


def compile_sources(
    sources: Mapping[str, bytes],
    main: Sequence[str],
    *,
    name: str,
    version: str,
    platforms: Sequence[str],
) -> list[Binary]:
    """Compile a set of sources; without ``platforms`` for this machine, where there is a compiler.

    Parameters
    ----------
    sources : mapping of file name to content
        C files and their headers.
    main : sequence of str
        The C files.
    name : str
        The modelIdentifier.
    version : str
        FMI version, which decides the names of the folders.
    platforms : sequence of str
        Of ``PLATFORMS``.

    Raises
    ------
    FmuError
        If the compiler refuses the sources.
    """
    with TemporaryFolder("export") as folder:
        for file, content in sources.items():
            (folder / file).write_bytes(content)
        files = [folder / file for file in main]
        try:
            if platforms:
                return [
                    _cross_compile(files, folder, name, version, platform) for platform in platforms
                ]
            if not build.compiler():
                return []
            return [_compile_here(files, folder, name, version)]
        except RuntimeError as error:
            raise FmuError(f"the FMU {name!r} could not be compiled: {error}") from error


def _compile_here(files: Sequence[Path], folder: Path, name: str, version: str) -> Binary:
    library = folder / f"{name}{SUFFIX}"
    compile_library(files, library)
    note = _note(version, f"{ARCHITECTURE}-{SYSTEM}")
    return Binary(folders(version)[0], library.name, library.read_bytes(), note)


def _cross_compile(
    files: Sequence[Path], folder: Path, name: str, version: str, platform: str
) -> Binary:
    machine = PLATFORMS[platform]
    own_folder = folder / f"{name}-{platform}"
    own_folder.mkdir()
    library = own_folder / f"{name}{machine.suffix}"
    # without these, debug information or the library itself would name the temporary folder
    options = ["-s"]
    if machine.suffix == ".dylib":
        options.append(f"-Wl,-install_name,@rpath/{library.name}")
    command = build.cross_compiler(machine.target)
    compile_library(files, library, options, command=command)
    short = machine.short if version == "2.0" else None
    note = _note(version, platform)
    return Binary(short or platform, library.name, library.read_bytes(), note)


def _note(version: str, platform: str) -> str:
    machine = PLATFORMS.get(platform)
    if version != "2.0" or machine is None or machine.short is not None:
        return ""
    return f"FMI 2.0 has no name for {platform}; its folder is FMI 3.0's"


def advice(main: Sequence[str], name: str, version: str) -> str:
    """Return how to compile what was written as sources only."""
    flags = " ".join(build.FLAGS)
    library = f"../binaries/{folders(version)[0]}/{name}{SUFFIX}"
    return (
        "no C compiler was found, so the FMU holds sources only. Install one as 'cc' or "
        "'pip install ziglang' and export again, or, in sources/: "
        f"cc {flags} {' '.join(main)} -o {library} -lm"
    )
