"""Exported FMUs for other machines: the right folder, the right machine, the same bits."""

import importlib.util
import shutil
import struct
import zipfile

import numpy as np
import pytest

from cosim.errors import FmuError
from cosim.fmi.component import load
from cosim.fmi.exporting.compiling import PLATFORMS
from cosim.fmi.exporting.export import export
from cosim.fmi.options import FmuOptions
from cosim.fmi.platforms import ARCHITECTURE, SYSTEM
from cosim.native import build
from tests.fmi.identifiers import output_error
from tests.fmi.plant import model, run

needs_zig = pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="no ziglang")
HERE = f"{ARCHITECTURE}-{SYSTEM}"
ELF = b"\x7fELF"
PE = b"MZ"
MACH_O = struct.pack("<I", 0xFEEDFACF)
MACHINES = {  # e_machine of ELF; Machine of PE; cputype of Mach-O
    "x86_64-linux": (ELF, 62),
    "aarch64-linux": (ELF, 183),
    "x86_64-windows": (PE, 0x8664),
    "x86_64-darwin": (MACH_O, 0x01000007),
    "aarch64-darwin": (MACH_O, 0x0100000C),
}
FOLDERS = {
    "x86_64-linux": "linux64",
    "x86_64-windows": "win64",
    "x86_64-darwin": "darwin64",
}  # FMI 2.0.4 section 2.3


def machine(content):
    """Read what kind of file a library is, and for which machine."""
    if content.startswith(ELF):
        return ELF, struct.unpack_from("<H", content, 18)[0]
    if content.startswith(PE):
        return PE, struct.unpack_from(
            "<H", content, struct.unpack_from("<I", content, 0x3C)[0] + 4
        )[0]
    return content[:4], struct.unpack_from("<I", content, 4)[0]


def check_binaries(fmu, platforms, fmi):
    folders = [FOLDERS.get(p, p) if fmi == "2" else p for p in platforms]
    assert list(fmu.platforms) == folders
    with zipfile.ZipFile(fmu.path) as archive:
        for platform, folder in zip(platforms, folders, strict=True):
            content = archive.read(f"binaries/{folder}/plant{PLATFORMS[platform].suffix}")
            assert machine(content) == MACHINES[platform]
            assert f"fmi{fmi}DoStep".encode() in content
            assert b"cosim.export" not in content  # where it was compiled


@pytest.mark.slow
@needs_zig
@pytest.mark.parametrize("fmi", ["2", "3"])
def test_zig_compiles_for_another_machine(fmi, tmp_path):
    """The binary is for that machine; FMI 2.0 has no name for this one, as a note says."""
    fmu = export(model(), tmp_path / "x.fmu", name="plant", fmi=fmi, platforms=["aarch64-linux"])
    check_binaries(fmu, ["aarch64-linux"], fmi)
    assert (fmu.notes == ("FMI 2.0 has no name for aarch64-linux; its folder is FMI 3.0's",)) == (
        fmi == "2"
    )
    if HERE != "aarch64-linux":
        with pytest.raises(
            FmuError, match="no binary for this platform; found binaries for: aarch64-linux"
        ):
            load(fmu.path)


@needs_zig
@pytest.mark.campaign
@pytest.mark.parametrize("fmi", ["2", "3"])
def test_zig_compiles_for_every_machine(fmi, tmp_path, monkeypatch):
    """All platforms in one archive; the first time zig builds their C libraries, for minutes."""
    monkeypatch.setenv("COSIM_CACHE", "")
    first = export(model(), tmp_path / "x.fmu", name="plant", fmi=fmi, platforms=list(PLATFORMS))
    check_binaries(first, list(PLATFORMS), fmi)
    again = export(model(), tmp_path / "y.fmu", name="plant", fmi=fmi, platforms=list(PLATFORMS))
    assert first.path.read_bytes() == again.path.read_bytes()


@pytest.mark.slow
@needs_zig
@pytest.mark.skipif(
    shutil.which("cc") is None or HERE not in PLATFORMS, reason="no cc to compare with"
)
def test_zig_and_cc_give_the_same_bits(tmp_path):
    """Both without fused multiply-adds and without the instructions of the host."""
    paths = [
        export(model(), tmp_path / f"{len(platforms)}.fmu", name="plant", platforms=platforms).path
        for platforms in ([], [HERE])
    ]
    runs = []
    for path in paths:
        with load(path, FmuOptions(interface_type="cs")) as fmu:
            runs.append(run(fmu.component, step=0.01))
    assert np.array_equal(*runs)


@pytest.mark.slow
@pytest.mark.skipif(not build.compiler(), reason="no C compiler")
def test_the_optimization_of_the_compiler_changes_no_bit(tmp_path, monkeypatch):
    """Of a linear model in both interface types, and of an identifier with all its kernels."""
    first, *others = (rows_of(tmp_path, monkeypatch, level) for level in ("-O2", "-O0", "-O3"))
    assert [np.isfinite(rows).any() for rows in first] == [True, True, True]
    for rows in others:
        assert [part.tobytes() for part in rows] == [part.tobytes() for part in first]


def rows_of(folder, monkeypatch, level):
    """Return the rows of FMUs whose kernels are compiled with an option of optimization."""
    flags = tuple(level if flag == "-O2" else flag for flag in build.FLAGS)
    assert level in flags
    monkeypatch.setattr(build, "FLAGS", flags)
    rows = []
    plant = export(model(), folder / f"plant{level}.fmu", name="plant").path
    for interface_type in ("me", "cs"):
        with load(plant, FmuOptions(interface_type=interface_type)) as fmu:
            rows.append(run(fmu.component, step=0.01))
    path = export(output_error(), folder / f"identifier{level}.fmu", name="identifier").path
    with load(path) as fmu:
        n_u = fmu.component.interface.n_u

        def u(t):
            return np.sin(np.multiply.outer(t, np.arange(1.0, n_u + 1.0)))

        held = np.ones(n_u, np.bool_)
        rows.append(run(fmu.component, step=0.001, stop=0.1, held=held, u=u))
    monkeypatch.undo()
    return rows


def test_without_zig_other_machines_are_refused(tmp_path, monkeypatch):
    """The message names the extra."""
    monkeypatch.setattr(build, "cross_compiler", lambda target: [])
    with pytest.raises(
        FmuError,
        match=r"platform aarch64-linux: .* ziglang, which is not installed; "
        r"pip install ziglang",
    ):
        export(model(), tmp_path / "x.fmu", name="plant", platforms=["aarch64-linux"])
    assert list(tmp_path.iterdir()) == []


def test_errors_of_the_compiler_are_passed_on(tmp_path, monkeypatch):
    """With its own words; nothing is written."""

    def refuse(*arguments, **options):
        raise RuntimeError("cc failed:\nmodel.c:1: error")

    monkeypatch.setattr(build, "compiler", lambda: ["cc"])
    monkeypatch.setattr(build, "compile_library", refuse)
    with pytest.raises(
        FmuError, match=r"the FMU 'plant' could not be compiled: cc failed:\nmodel\.c:1: error"
    ):
        export(model(), tmp_path / "x.fmu", name="plant")
    assert list(tmp_path.iterdir()) == []
