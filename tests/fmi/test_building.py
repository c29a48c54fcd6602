"""FMUs with sources and no binary for this machine: ``cosim compile`` builds one of them."""

import zipfile

import pytest

import cosim
from cosim.errors import FmuError
from cosim.fmi.building import compile_fmu
from cosim.fmi.checking.check import check
from cosim.fmi.component import load
from cosim.fmi.platforms import folders
from tests.fmi.compiled import write_archive


def without(fmu, target, *prefixes):
    """Copy an FMU without what is in some of its folders."""
    members = members_of(fmu)
    kept = {name: members[name] for name in members if not name.startswith(prefixes)}
    return write_archive(target, kept)


def members_of(fmu):
    with zipfile.ZipFile(fmu) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def changed(fmu, target, name, old, new):
    members = members_of(fmu)
    assert old in members[name]
    return write_archive(target, {**members, name: members[name].replace(old, new)})


@pytest.mark.slow
@pytest.mark.parametrize("version", ["2", "3"])
def test_a_built_binary_runs_as_the_original_one_does(tmp_path, call, monkeypatch, version):
    """Bit for bit: academic with its plant as an FMU."""
    monkeypatch.chdir(tmp_path)
    call("export", "academic", "--component", "plant", "--fmi", version, "--out", "whole.fmu")
    bare = without(tmp_path / "whole.fmu", tmp_path / "bare.fmu", "binaries/")
    code, out, _ = call("compile", bare, "--out", "built.fmu")
    assert (code, out.strip()) == (0, f"built.fmu: binary for {folders(f'{version}.0')[0]}")
    swaps = ({"plant": "whole.fmu#cs"}, {"plant": "built.fmu#cs"})
    logs = [cosim.run("academic", swap=swap, set={"scenario.stop": 0.5}) for swap in swaps]
    assert cosim.diff(*logs).equal
    assert check(tmp_path / "built.fmu") == check(tmp_path / "whole.fmu")
    assert call("compile", bare, "--out", "built.fmu")[0] == 2  # it is there


def test_the_message_names_the_way_out(exported, tmp_path):
    """The command where there are sources, else the tool; nothing is compiled unasked."""
    bare = without(exported, tmp_path / "bare.fmu", "binaries/")
    with pytest.raises(FmuError, match=r"found binaries for: none.*'cosim compile .*bare.fmu'"):
        load(bare)
    assert any(f"'cosim compile {bare}'" in finding.text for finding in check(bare))
    empty = without(exported, tmp_path / "empty.fmu", "binaries/", "sources/")
    with pytest.raises(FmuError, match="no sources either: export it for this platform"):
        load(empty)
    with pytest.raises(FmuError, match=r"empty\.fmu: cannot be compiled: it has no sources"):
        compile_fmu(empty, tmp_path / "out.fmu")
    xml = "modelDescription.xml"
    unnamed = changed(bare, tmp_path / "unnamed.fmu", xml, b"SourceFiles", b"Annotations")
    with pytest.raises(FmuError, match=f"neither its {xml} nor .* names its sources"):
        compile_fmu(unnamed, tmp_path / "out.fmu")
    assert not (tmp_path / "out.fmu").exists()


@pytest.mark.slow
def test_what_the_compiler_says_is_shown(exported, tmp_path):
    bare = without(exported, tmp_path / "bare.fmu", "binaries/")
    source = next(name for name in members_of(bare) if name.endswith("fmi2.c"))
    broken = changed(bare, tmp_path / "broken.fmu", source, b"#include", b"#incloud")
    with pytest.raises(FmuError, match=r"(?s)sources cannot be compiled:\n.*fmi2.c:.*incloud"):
        compile_fmu(broken, tmp_path / "out.fmu")
    assert not (tmp_path / "out.fmu").exists()
