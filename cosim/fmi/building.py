"""Build the binary of an FMU for this machine from its sources, by fmpy and CMake."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from cosim.errors import FmuError, UsageError
from cosim.fmi.exporting.export import write_files
from cosim.fmi.platforms import SUFFIX, SYSTEM, folders
from cosim.fmi.reading.model_description import Archive, read
from cosim.temporary import TemporaryFolder

SHOWN: Final = 10  # lines of the compiler that a message shows
BUILD_DESCRIPTION: Final = "sources/buildDescription.xml"  # FMI 3.0; in FMI 2.0 there may be one
BUILD: Final = (
    "import json, sys; from fmpy.build import build_platform_binary; "
    "build_platform_binary(sys.argv[1], **json.loads(sys.argv[2]))"
)
"""Done in another process: CMake prints what it does."""
# As cosim compiles: the same bits on every processor; the mathematical functions are linked.
UNIX: Final = {
    "generator": "Unix Makefiles",
    "cmake_options": {
        "CMAKE_C_FLAGS:STRING": "-ffp-contract=off",
        "CMAKE_C_STANDARD_LIBRARIES:STRING": "-lm",
    },
}


def compiled_path(path: Path) -> Path:
    """Return where an FMU is written that is compiled for this machine, unless the user says."""
    return Path("fmus") / f"{path.stem}-{folders('3.0')[0]}.fmu"


def compile_fmu(path: Path, out: Path) -> str:
    """Write a copy of an FMU with a binary for this machine, built of its own sources.

    Its build scripts and its sources are the maker's: nothing else asks for this.

    Returns
    -------
    str
        The folder of the binary, such as ``linux64``.

    Raises
    ------
    FmuError
        If it is no FMU, has no sources, or they cannot be compiled.
    UsageError
        If the copy cannot be written.
    """
    with TemporaryFolder("build") as temporary:
        unpacked = temporary / "fmu"
        unpacked.mkdir()
        archive = read(path, into=unpacked)
        member = _member(archive)
        files = {name: (unpacked / name).read_bytes() for name in sorted(archive.members)}
        shutil.rmtree(unpacked / "binaries", ignore_errors=True)
        files[member] = _built(path, unpacked, Path(member).name)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_files(out, files)
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror or error}") from error
    return Path(member).parent.name


def _member(archive: Archive) -> str:
    """Return where the archive is to have the binary; refuse one that cannot be built."""
    description = archive.description
    identifiers = {can.identifier for can in description.capabilities.values()}
    problem = ""
    if not any(name.startswith("sources/") for name in archive.members):
        problem = "it has no sources; export it for this platform in the tool that made it"
    elif description.version.startswith("1."):
        problem = "expected FMI 2.0 or 3.0, whose description names the sources, got FMI 1.0"
    elif not (BUILD_DESCRIPTION in archive.members or "<SourceFiles" in archive.xml):
        problem = f"neither its modelDescription.xml nor {BUILD_DESCRIPTION} names its sources"
    elif len(identifiers) != 1:
        problem = f"expected one model identifier, got {', '.join(sorted(identifiers)) or 'none'}"
    if problem:
        raise FmuError(f"{archive.path}: cannot be compiled: {problem}")
    return f"binaries/{folders(description.version)[0]}/{identifiers.pop()}{SUFFIX}"


def _built(path: Path, unpacked: Path, file: str) -> bytes:
    """Return the binary that fmpy builds in a folder with an unpacked FMU."""
    if shutil.which("cmake") is None:
        raise FmuError(f"{path}: cannot be compiled: no cmake; install it, or 'pip install cmake'")
    options = {} if SYSTEM == "windows" else UNIX
    command = [sys.executable, "-c", BUILD, str(unpacked), json.dumps(options)]
    ran = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    binary = next((unpacked / "binaries").rglob(file), None)
    if ran.returncode or binary is None:
        lines = ran.stdout.replace(f"{unpacked}/", "").splitlines()
        of_errors = [line for line in lines if re.search(r"\berror\b", line, re.IGNORECASE)]
        shown = "\n".join(of_errors[:SHOWN] or lines[-SHOWN:])
        raise FmuError(f"{path}: its sources cannot be compiled:\n{shown}")
    return binary.read_bytes()
