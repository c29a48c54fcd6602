"""Replays with a component replaced by an FMU or another recording."""

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.report.verification import verify
from cosim.scenario.exporting import export_component
from cosim.scenario.record import replay_origin
from tests.fmi import lag
from tests.scenario.refusals import check_refused

# the plant is one that a replay takes from the log; the filter behind it is computed
FILTERED = """
scenario = { name = "filtered", stop = 0.5, step = 0.01 }
[components]
u = { kind = "sine", rate = 5.0 }
plant = { kind = "descriptor", model = "lag", x0 = [1.0] }
filter = { kind = "lag", time_constant = 0.1 }

[models.lag]
A = [[-1.0]]
Bu = [[1.0]]
C = [[1.0]]

[connections]
"plant.u" = "u.y"
"filter.u" = "plant.y"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make FMUs, and the log of a run."""
    folder = tmp_path_factory.mktemp("swaps")
    scenario = folder / "filtered.toml"
    scenario.write_text(FILTERED)
    export_component(scenario, "filter", folder / "filter.fmu")
    export_component(scenario, "plant", folder / "plant.fmu")
    lag.build(folder, "2")
    cosim.run(scenario, out=folder / "f.mcap")
    return folder


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("plant", "plant.fmu"),
        ("plant", "f.mcap"),
        ("filter", "filter.fmu#me"),
        ("filter", "filter.fmu#cs"),
    ],
)
def test_a_swapped_replay_has_the_rows_of_a_swapped_run(name, file, folder, tmp_path):
    """What is taken from the log, the plant, is what a run computes: bit for bit.

    Its log is replayed without what was swapped in, as that of a run.
    """
    swap = {name: folder / file}
    log = cosim.replay(folder / "f.mcap", swap=swap, out=tmp_path / "s.mcap")
    assert cosim.diff(log, cosim.run(folder / "filtered.toml", swap=swap)).equal
    assert set(replay_origin(log).copied) == {"plant"} - {name}
    again = cosim.replay(log)
    assert set(replay_origin(again).copied) == {"plant", name}
    assert verify(log, again).passed


def test_ports_have_the_names_of_a_map(folder):
    """As in a run."""
    swap = {"filter": folder / "lag2.fmu"}
    names = {"filter.y": "x"}  # it has an output y too, which feeds through
    again = cosim.replay(folder / "f.mcap", swap=swap, map=names)
    assert cosim.diff(again, cosim.run(folder / "filtered.toml", swap=swap, map=names)).equal
    assert not np.array_equal(again["filter.y"], cosim.open_log(folder / "f.mcap")["filter.y"])


def test_a_swap_that_the_recording_cannot_follow_is_refused(folder):
    """The plant's rows belong to the source that it had."""
    message = (
        r"swap\['u'\]: this changes 'u', on which 'plant' depends; 'plant' is taken from the "
        "recording and cannot follow: run the scenario"
    )
    with pytest.raises(UsageError, match=message):
        cosim.replay(folder / "f.mcap", swap={"u": folder / "f.mcap"})
    paths = {"u": folder / "f.mcap", "plant": folder / "f.mcap"}
    assert replay_origin(cosim.replay(folder / "f.mcap", swap=paths)).copied == ()


INVALID = [
    (({"filtr": "filter.fmu"}, {}), "component 'filtr'; did you mean"),
    (({"filter": "none.fmu"}, {}), r"none\.fmu: there is no such file"),
    (({}, {"filter.u": "force"}), "expected swap with map"),
    (({"filter": 3}, {}), r"swap\['filter'\]: path: expected a path, got 3"),
    (
        ({"filter": "lag2.fmu"}, {"filter.y": "x", "filter.u": "x"}),
        r"map\['filter\.u'\]: .*expected an input of 'filter', got an output",
    ),
    (({"filter": "lag2.fmu"}, {"filter.z": "x"}), r"unknown port|'filter\.z'"),
]


def test_an_invalid_swap_is_refused(folder, tmp_path):
    """Unknown components and ports, no such file, a map alone, to two: not written."""

    def replay(case):
        swap, names = case
        paths = {n: folder / file if isinstance(file, str) else file for n, file in swap.items()}
        cosim.replay(folder / "f.mcap", swap=paths, map=names, out=tmp_path / "a.mcap")

    check_refused(INVALID, replay)
    assert list(tmp_path.iterdir()) == []
