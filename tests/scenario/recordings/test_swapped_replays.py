"""Replays with a component replaced by an FMU or another recording."""

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.report.verification import verify
from cosim.scenario.exporting import export_component
from cosim.scenario.record import component_record, replay_origin
from tests.fmi import lag
from tests.fmi.compiled import with_description

# the plant is one that a replay takes from the log; the filter behind it is computed
FILTERED = """
[scenario]
name = "filtered"
stop = 0.5
step = 0.01

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


def test_ports_have_the_names_of_a_map(folder, call):
    """As in a run; a name that the new component does not have is refused."""
    swap = {"filter": folder / "lag2.fmu"}
    names = {"filter.y": "x"}  # it has an output y too, which feeds through
    again = cosim.replay(folder / "f.mcap", swap=swap, map=names)
    assert cosim.diff(again, cosim.run(folder / "filtered.toml", swap=swap, map=names)).equal
    assert not np.array_equal(again["filter.y"], cosim.open_log(folder / "f.mcap")["filter.y"])
    command = ("replay", folder / "f.mcap", "--swap", f"filter={folder / 'lag2.fmu'}")
    code, _, err = call(*command, "--map", "filter.y=force")
    assert (code, "'filter' has no output 'force'" in err) == (2, True)


def test_a_swap_that_the_recording_cannot_follow_is_refused(folder):
    """The plant's rows belong to the source that it had."""
    message = (
        r"swap\['u'\]: this changes 'u', which drives 'plant'; 'plant' is taken from the recording "
        "and cannot follow: run the scenario"
    )
    with pytest.raises(UsageError, match=message):
        cosim.replay(folder / "f.mcap", swap={"u": folder / "f.mcap"})
    paths = {"u": folder / "f.mcap", "plant": folder / "f.mcap"}
    assert replay_origin(cosim.replay(folder / "f.mcap", swap=paths)).copied == ()


@pytest.mark.parametrize(
    ("swap", "names", "error", "message"),
    [
        ({"filtr": "filter.fmu"}, {}, ScenarioError, "component 'filtr'; did you mean"),
        ({"filter": "none.fmu"}, {}, ScenarioError, r"none\.fmu: there is no such file"),
        ({"filter": "f.toml"}, {}, ScenarioError, r"swap\['filter'\]: expected a path .* \.fmu"),
        ({}, {"filter.u": "force"}, UsageError, "expected swap with map"),
        ({"filter": 3}, {}, UsageError, r"swap\['filter'\]: path: expected a path, got 3"),
        (
            {"filter": "lag2.fmu"},
            {"filter.y": "x", "filter.u": "x"},
            ScenarioError,
            r"map\['filter\.u'\]: .*expected an input of 'filter', got an output",
        ),
        ({"filter": "lag2.fmu"}, {"filter.y": ""}, ScenarioError, "the name of a port"),
        ({"filter": "lag2.fmu"}, {"filter.z": "x"}, ScenarioError, r"unknown port|'filter\.z'"),
    ],
)
def test_an_invalid_swap_is_refused(folder, tmp_path, swap, names, error, message):
    """Unknown components and ports, no such file, a map alone, to two, to nothing: not written."""
    paths = {n: folder / file if isinstance(file, str) else file for n, file in swap.items()}
    with pytest.raises(error, match=message):
        cosim.replay(folder / "f.mcap", swap=paths, map=names, out=tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_swapped_replay_is_compared_with_the_log(folder, call):
    """With --verify: an FMU that has other bits is found, and where."""
    command = ("replay", folder / "f.mcap", "--swap", f"filter={folder / 'filter.fmu#cs'}")
    code, _, err = call(*command, "--verify")
    assert code == 1
    assert "component tables.filter.kind: 'lag' in the log, 'fmu' in the replay" in err


def test_a_swap_is_compared_with_what_was_recorded(folder):
    """By what both declare: the log keeps the report, as one of a run has it."""
    swap = {"filter": folder / "lag2.fmu"}
    runs = (
        cosim.replay(folder / "f.mcap", swap=swap),
        cosim.run(folder / "filtered.toml", swap=swap),
    )
    of_replay, of_run = (
        {(row.port, row.aspect): row for row in component_record(run, "filter").swap_report.ports}
        for run in runs
    )
    feedthrough = of_replay["filter.y", "feedthrough"]
    assert (feedthrough.verdict, feedthrough.connected) == ("differs", False)
    assert of_replay["filter", "kind"].after == "co-simulation"
    for key, row in of_replay.items():
        if row.verdict == "differs":
            assert (of_run[key].before, of_run[key].after) == (row.before, row.after)


def test_a_port_that_is_missing_is_proposed(folder, tmp_path):
    """As before a run: the port that may have been meant."""
    xml = lag.xml("2").replace('name="u"', 'name="u_in"')
    swap = {"filter": with_description(folder / "lag2.fmu", tmp_path / "renamed.fmu", xml)}
    message = r"map=\{'filter\.u': '\w+'\}: filter\.\w+ may be filter\.u \(input of size 1, real"
    with pytest.raises(ScenarioError, match=message):
        cosim.replay(folder / "f.mcap", swap=swap)
    again = cosim.replay(folder / "f.mcap", swap=swap, map={"filter.u": "u_in"})
    other = cosim.replay(folder / "f.mcap", swap={"filter": folder / "lag2.fmu"})
    assert np.array_equal(again["filter.y"], other["filter.y"])
