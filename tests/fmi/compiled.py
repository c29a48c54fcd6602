"""FMUs of C, compiled for the tests: what no generator of Python FMUs can show."""

import atexit
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import fmpy

from cosim.fmi.compiling import compile_library
from cosim.fmi.platforms import SUFFIX, folders
from cosim.temporary import TemporaryFolder

HERE = Path(__file__).parent / "c"
NOTHING: Mapping[str, str | bytes] = MappingProxyType({})
HEADERS = Path(fmpy.__file__).parent / "c-code"


def kept_folder() -> Path:
    """Make a folder that stays until the process ends."""
    folder = TemporaryFolder("test")
    atexit.register(folder.remove)
    return folder.path


def compile_fmu(
    path: Path,
    xml: str,
    *sources: str | Path,
    name: str = "model",
    defines: tuple[str, ...] = (),
    extra: Mapping[str, str | bytes] = NOTHING,
) -> Path:
    """Write an FMU: its modelDescription.xml, and a binary for this machine of C sources.

    Parameters
    ----------
    path : Path
        The .fmu to write; its folder takes the intermediate files.
    xml : str
    sources : str or Path
        Names of files in ``tests/fmi/c``, or paths.
    name : str
        The modelIdentifier, so also the name of the binary.
    defines : tuple of str
        Such as ``"STEPS=3"``.
    extra : mapping of path to content
        Further files of the archive.
    """
    library = path.with_suffix(SUFFIX)
    version = xml.split('fmiVersion="')[1].split('"')[0]
    flags = ["-O0", f"-I{HEADERS}", *(f"-D{define}" for define in defines)]
    compile_library([HERE / source for source in sources], library, flags)
    binary = f"binaries/{folders(version)[0]}/{name}{SUFFIX}"
    return write_archive(path, {"modelDescription.xml": xml, **extra, binary: library.read_bytes()})


def write_archive(path: Path, members: Mapping[str, str | bytes]) -> Path:
    """Write an FMU whose bytes are those of its members alone, whenever it is written.

    Trials are kept by the content of the file: the same FMU is tried once.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(zipfile.ZipInfo(member), content)
    return path


def with_description(fmu: Path, target: Path, xml: str) -> Path:
    """Copy an FMU with another modelDescription.xml."""
    with zipfile.ZipFile(fmu) as source:
        members = {member: source.read(member) for member in source.namelist()}
    return write_archive(target, {**members, "modelDescription.xml": xml})
