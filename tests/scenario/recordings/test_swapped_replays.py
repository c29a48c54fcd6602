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

END = {"scenario.stop": 0.3}

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
    """Make FMUs, and logs of runs."""
    folder = tmp_path_factory.mktemp("swaps")
    (folder / "filtered.toml").write_text(FILTERED)
    export_component(folder / "filtered.toml", "filter", folder / "filter.fmu")
    lag.build(folder, "2")
    cosim.run("academic", out=folder / "a.mcap", set=END)
    cosim.run(folder / "filtered.toml", out=folder / "f.mcap")
    return folder


@pytest.mark.fast("filtered.toml-f.mcap-swap3", "filtered.toml-f.mcap-swap4")
@pytest.mark.parametrize(
    ("scenario", "log", "swap"),
    [
        ("academic", "a.mcap", {"plant": "plant.fmu"}),
        ("academic", "a.mcap", {"plant": "plant.fmu#cs"}),
        ("academic", "a.mcap", {"plant": "a.mcap"}),
        ("filtered.toml", "f.mcap", {"filter": "filter.fmu#me"}),
        ("filtered.toml", "f.mcap", {"filter": "filter.fmu#cs"}),
    ],
)
def test_a_swapped_replay_has_the_rows_of_a_swapped_run(scenario, log, swap, folder):
    """What is taken from the log, the plant, is what a run computes: bit for bit."""
    if "plant.fmu" in swap.get("plant", "") and not (folder / "plant.fmu").exists():
        export_component("academic", "plant", folder / "plant.fmu")
    paths = {name: folder / path for name, path in swap.items()}
    name = folder / scenario if scenario.endswith(".toml") else scenario
    again = cosim.replay(folder / log, swap=paths)
    run = cosim.run(name, swap=paths, set=END if scenario == "academic" else {})
    assert cosim.diff(again, run).equal
    assert set(replay_origin(again).copied) == {"plant"} - paths.keys()


def test_the_log_of_a_swapped_replay_is_replayed_without_what_was_swapped_in(folder, tmp_path):
    """As the log of a swapped run is: no file is opened but those that are named."""
    swap = {"filter": folder / "filter.fmu"}
    log = cosim.replay(folder / "f.mcap", swap=swap, out=tmp_path / "s.mcap")
    again = cosim.replay(log)
    assert set(replay_origin(again).copied) == {"plant", "filter"}
    assert verify(log, again).passed


def test_ports_have_the_names_of_a_map(folder, tmp_path, call):
    """As in a run; a name that the new component does not have is refused."""
    swap = {"filter": folder / "lag2.fmu"}
    names = {"filter.y": "x"}  # it has an output y too, which feeds through
    again = cosim.replay(folder / "f.mcap", swap=swap, map=names)
    run = cosim.run(folder / "filtered.toml", swap=swap, map=names)
    assert cosim.diff(again, run).equal
    assert not np.array_equal(again["filter.y"], cosim.open_log(folder / "f.mcap")["filter.y"])
    command = ("replay", folder / "f.mcap", "--swap", f"filter={folder / 'lag2.fmu'}")
    assert call(*command, "--map", "filter.y=x")[0] == 0
    code, _, err = call(*command, "--map", "filter.y=force")
    assert code == 2
    assert "'filter' has no output 'force'" in err


def test_a_swap_that_the_recording_cannot_follow_is_refused(folder):
    """The plant's rows belong to the source that it had."""
    message = (
        r"swap\['u'\]: this changes 'u', which drives 'plant'; 'plant' is taken from the recording "
        "and cannot follow: run the scenario"
    )
    with pytest.raises(UsageError, match=message):
        cosim.replay(folder / "f.mcap", swap={"u": folder / "f.mcap"})
    paths = {"u": folder / "f.mcap", "plant": folder / "f.mcap"}
    again = cosim.replay(folder / "f.mcap", swap=paths)
    assert replay_origin(again).copied == ()


def test_an_invalid_swap_is_refused(folder, subtests):
    """Unknown components, files that are not there or are something else, a map alone."""
    for swap, names, error, message in [
        ({"filtr": "filter.fmu"}, {}, ScenarioError, "component 'filtr'; did you mean"),
        ({"filter": "none.fmu"}, {}, ScenarioError, r"none\.fmu: there is no such file"),
        (
            {"filter": "f.toml"},
            {},
            ScenarioError,
            r"swap\['filter'\]: expected a path that ends in \.fmu",
        ),
        ({}, {"filter.u": "force"}, UsageError, "expected swap with map"),
        ({"filter": 3}, {}, UsageError, r"swap\['filter'\]: path: expected a path, got 3"),
    ]:
        with subtests.test(swap=swap, names=names):
            paths = {}
            for name, path in swap.items():
                paths[name] = folder / path if isinstance(path, str) else path
            with pytest.raises(error, match=message):
                cosim.replay(folder / "f.mcap", swap=paths, map=names)


def test_a_swapped_replay_is_compared_with_the_log(folder, call):
    """With --verify: an FMU that has other bits is found, and where."""
    command = ("replay", folder / "f.mcap", "--swap", f"filter={folder / 'filter.fmu#cs'}")
    assert call(*command)[0] == 0
    code, _, err = call(*command, "--verify")
    assert code == 1
    assert "component tables.filter.kind: 'lag' in the log, 'fmu' in the replay" in err


def test_a_swap_is_compared_with_what_was_recorded(folder):
    """By what both declare: the log keeps the report, and warns of what differs."""
    swap = {"filter": folder / "lag2.fmu"}
    log = cosim.replay(folder / "f.mcap", swap=swap)
    report = component_record(log, "filter").swap_report
    rows = {(row.port, row.aspect): row for row in report.ports}
    feedthrough = rows["filter.y", "feedthrough"]
    assert (feedthrough.verdict, feedthrough.connected) == ("differs", False)
    assert rows["filter", "kind"].after == "co-simulation"
    run = component_record(cosim.run(folder / "filtered.toml", swap=swap), "filter").swap_report
    of_run = {(row.port, row.aspect): row for row in run.ports}
    for key, row in rows.items():
        if row.verdict == "differs":
            assert (of_run[key].before, of_run[key].after) == (row.before, row.after)


def test_a_port_that_is_missing_is_proposed(folder, tmp_path):
    """As before a run: the port that may have been meant."""
    xml = lag.xml("2").replace('name="u"', 'name="u_in"')
    renamed = with_description(folder / "lag2.fmu", tmp_path / "renamed.fmu", xml)
    message = r"map=\{'filter\.u': '\w+'\}: filter\.\w+ may be filter\.u \(input of size 1, real"
    with pytest.raises(ScenarioError, match=message):
        cosim.replay(folder / "f.mcap", swap={"filter": renamed})
    names = {"filter.u": "u_in"}
    again = cosim.replay(folder / "f.mcap", swap={"filter": renamed}, map=names)
    other = cosim.replay(folder / "f.mcap", swap={"filter": folder / "lag2.fmu"})
    assert np.array_equal(again["filter.y"], other["filter.y"])
