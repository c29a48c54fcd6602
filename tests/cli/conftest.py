"""The files that commands of the tests read, and members of studies without processes."""

import shutil

import pytest

import cosim
from cosim.scenario.exporting import export_component
from tests.scenario.field_recordings import LOOP, field_log
from tests.studies.in_process import run_members_in_this_process

SHORT = {"scenario.stop": 0.1}
PART = {"record.signals": ["plant.*", "observer.delta"], "record.every": 10}
STUDY = """
[study]
name = "filters"
scenario = "academic"
set = { "scenario.stop" = 0.1 }

[vary]
"observer.filter_rate" = { log = [10.0, 1e3], points = 2 }

[metrics]
error = "rms(observer.delta - delta.y)"
"""
LAG = """
scenario = { name = "lag", stop = 2.0, step = 0.01 }
[components]
u = { kind = "constant", value = 1.0 }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Make, once: logs of 0.1 s, some damaged; an FMU; scenarios; a study."""
    folder = tmp_path_factory.mktemp("made")
    changed = {"plant.x_a0": [1.0, -1.001]}
    for name, changes in {"a": {}, "b": changed, "part": PART}.items():
        cosim.run("academic", set={**SHORT, **changes}, out=folder / f"{name}.mcap")
    export_component("academic", "plant", folder / "plant.fmu")
    whole = (folder / "a.mcap").read_bytes()
    for name, data in {"text": b"no log", "empty": b"", "short": whole[:-400]}.items():
        (folder / f"{name}.mcap").write_bytes(data)
    (folder / "old.csv").touch()
    field_log(folder)
    for name, text in {"filters": STUDY, "lag": LAG, "loop": LOOP}.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def files(made, tmp_path):
    """Return the folder of ``call`` with a copy of them."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture
def members_in_this_process(monkeypatch):
    """Run members where the command runs: for tests of what it reads and prints."""
    run_members_in_this_process(monkeypatch)
