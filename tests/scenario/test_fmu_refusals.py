"""A damaged or alien .fmu in a plant's place gets one clear error before the first step.

No file is written.
"""

import re
import zipfile

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.exporting import export_component
from tests.scenario.fmu_edits import rewritten

XML = "modelDescription.xml"


def archive(path, content):
    with zipfile.ZipFile(path, "w") as target:
        for name, text in content.items():
            target.writestr(name, text)


def without_binaries(path):
    export_component("academic", "plant", path)
    rewritten(path, path, members=lambda name: not name.startswith("binaries/"))
    with zipfile.ZipFile(path, "a") as target:
        target.writestr("binaries/win64/academic_plant.dll", b"MZ")


CASES = [
    (lambda path: path.write_text("hello"), "not an FMU, as it is no zip archive"),
    (lambda path: path.write_bytes(b""), "not an FMU, as it is no zip archive"),
    (lambda path: archive(path, {"readme.txt": ""}), f"not an FMU, as the archive has no {XML}"),
    (lambda path: archive(path, {XML: "<fmi"}), f"{XML} is not well-formed: .*line 1, column 0"),
    (without_binaries, "no binary for this platform; .*win64; expected binaries/"),
    (lambda path: path.mkdir(), "expected an .fmu file, got a folder"),
]


@pytest.mark.parametrize(("make", "text"), CASES)
def test_an_fmu_that_is_none_is_refused(make, text, tmp_path):
    """The component, the file, the reason, in one line."""
    make(path := tmp_path / "plant.fmu")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": path}, out=tmp_path / "run.mcap")
    assert caught.value.exit_code == 2
    message = str(caught.value)
    place = rf"swap\['plant'\]: components\.plant: {re.escape(str(path))}:? "
    assert re.search(f"^{place}{text}", message), message
    assert "\n" not in message
    assert sorted(tmp_path.rglob("*")) == before
