"""FMUs of C, compiled for the tests: what no generator of Python FMUs can show."""

import atexit
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import fmpy

from cosim.fmi.platforms import SUFFIX, folders
from cosim.native import build
from cosim.temporary import TemporaryFolder

HERE = Path(__file__).parent / "c"
NOTHING: Mapping[str, str] = MappingProxyType({})
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
    extra: Mapping[str, str] = NOTHING,
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
    flags = [f"-I{HEADERS}", *(f"-D{define}" for define in defines)]
    build.compile_library([HERE / source for source in sources], library, flags)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        for member, content in extra.items():
            archive.writestr(member, content)
        archive.write(library, f"binaries/{folders(version)[0]}/{name}{SUFFIX}")
    return path
