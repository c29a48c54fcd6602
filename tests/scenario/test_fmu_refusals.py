"""A damaged or alien .fmu in a plant's place gets one clear error before the first step.

No file is written.
"""

import re
import zipfile

import pytest

import cosim
from cosim.cli import main
from cosim.errors import ScenarioError
from cosim.scenario.exporting import export_component

XML = "modelDescription.xml"


def archive(path, content):
    with zipfile.ZipFile(path, "w") as target:
        for name, text in content.items():
            target.writestr(name, text)


def without_binaries(path):
    export_component("academic", "plant", path)
    with zipfile.ZipFile(path) as source:
        kept = {
            name: source.read(name)
            for name in source.namelist()
            if not name.startswith("binaries/")
        }
    archive(path, kept)


CASES = {
    "not a zip": (
        lambda path: path.write_text("hello"),
        "not an FMU, as it is no zip archive (File is not a zip file)",
    ),
    "empty file": (
        lambda path: path.write_bytes(b""),
        "not an FMU, as it is no zip archive (File is not a zip file)",
    ),
    "no description": (
        lambda path: archive(path, {"readme.txt": ""}),
        f"not an FMU, as the archive has no {XML}",
    ),
    "broken XML": (
        lambda path: archive(path, {XML: "<fmi"}),
        f"{XML} is not well-formed: unclosed token: line 1, column 0",
    ),
    "no binary here": (
        without_binaries,
        "no binary for this platform; found binaries for: none; expected binaries/",
    ),
    "folder": (lambda path: path.mkdir(), "expected an .fmu file, got a folder"),
}


@pytest.mark.parametrize("name", CASES)
def test_an_fmu_that_is_none_is_refused(name, tmp_path):
    """The component, the file, the reason."""
    make, text = CASES[name]
    make(path := tmp_path / "plant.fmu")
    before = sorted(tmp_path.rglob("*"))
    out = tmp_path / "run.mcap"
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": path}, out=out)
    assert caught.value.exit_code == 2
    message = str(caught.value)
    assert re.search(
        rf"swap\['plant'\]: components\.plant: {re.escape(str(path))}: {re.escape(text)}",
        message.replace(f"{path} ", f"{path}: "),
    ), message
    assert message.count("\n") == 0, "one error, one line"
    assert sorted(tmp_path.rglob("*")) == before, "nothing is written"


def test_the_command_ends_with_code_2(tmp_path, capsys):
    """No traceback."""
    (path := tmp_path / "plant.fmu").write_text("hello")
    with pytest.raises(SystemExit) as end:
        main(["run", "academic", "--swap", f"plant={path}", "--out", str(tmp_path / "run.mcap")])
    assert end.value.code == 2
    assert "not an FMU, as it is no zip archive" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [path]
