"""Sweeps: what-if replays of one log."""

import json
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.report.comparing import results_of
from cosim.report.summary import summarize
from cosim.scenario.running import replay
from tests.scenario.field_recordings import BOTH, LOOP, field_log

END = {"scenario.stop": 8.0}  # past the start of the identification at 6.461 s
FAILING = """
[scenario]
name = "failing"
stop = 0.2
step = 0.01

[components]
u = { kind = "sine", rate = 5.0 }
v = { kind = "expression", y = "2 * u.y" }
w = { kind = "expression", y = "t" }
"""


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run past the start of its identification."""
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    return cosim.run("academic-as-printed", out=path, set=END)


@pytest.fixture(scope="module")
def failing(tmp_path_factory):
    """Record a run whose replays fail with other expressions."""
    folder = tmp_path_factory.mktemp("failing")
    (folder / "failing.toml").write_text(FAILING)
    return cosim.run(folder / "failing.toml", out=folder / "f.mcap")


@pytest.mark.slow
def test_each_row_is_a_replay_of_its_own(log):
    """With the values of its row and those that all have; in the order of the product."""
    common = {"observer.filter_rate": 500.0}
    vary = {"identifier.P0": [1e3, 1e9], "identifier.start": [7.0, 7.5]}
    sweep = cosim.replay_sweep(log, vary=vary, set=common)
    assert sweep.varied == tuple(vary)
    values = [tuple(row.values.values()) for row in sweep.rows]
    assert values == list(product(*vary.values()))
    for row in sweep.rows:
        again = cosim.replay(log, set={**common, **row.values})
        assert row.summary == summarize(again)
        theta = [row.results[f"identifier.theta[{number}]"] for number in (0, 1)]
        assert theta == again["identifier.theta"][-1].tolist()
    assert len(set(sweep["identifier.theta[0]"])) == 4
    assert sweep.passed
    assert not list(log.path.parent.glob("*[0-9].mcap"))


@pytest.mark.slow
def test_results_are_estimates_errors_verdicts_and_noise(log):
    """By the names of the table; a column that no row has is empty."""
    sweep = cosim.replay_sweep(log, vary={"identifier.P0": [1e9]})
    (row,) = sweep.rows
    results = row.results
    assert results == results_of(summarize(cosim.replay(log, set={"identifier.P0": 1e9})))
    assert set(sweep.columns) == set(results)
    errors = [results[f"identifier.theta[{number}] error"] for number in (0, 1)]
    theta = [results[f"identifier.theta[{number}]"] for number in (0, 1)]
    assert errors == np.abs(np.array(theta) - [-0.1, -0.3]).tolist()
    assert isinstance(results["identifier verdict"], str)
    assert results["identifier noise"] > 0.0
    assert results["observer.x_a rms error"] <= results["observer.x_a largest error"]
    assert sweep["nothing"] == [None]


def test_without_a_truth_the_results_are_the_last_values(failing):
    """Of all outputs."""
    sweep = cosim.replay_sweep(failing, vary={"u.amplitude": [1.0, 3.0]})
    assert sweep.columns == ("u.y", "v.y", "w.y")
    first, second = sweep["u.y"]
    assert second == pytest.approx(3.0 * first)


@pytest.mark.slow
def test_the_log_is_opened_and_read_once(log, monkeypatch):
    """All replays have the same log in memory."""
    sources = []
    rows = []

    def recorded(source, *arguments, **options):
        sources.append(source)
        rows.append(source.rows("plant"))
        return record_replay(source, *arguments, **options)

    record_replay = replay.record_replay
    monkeypatch.setattr(replay, "record_replay", recorded)
    cosim.replay_sweep(log.path, vary={"identifier.P0": [1e3, 1e6, 1e9]})
    assert len({id(source) for source in sources}) == 1
    assert all(np.shares_memory(rows[0], other) for other in rows[1:])


@pytest.mark.slow
def test_the_parts_of_a_rotated_log_are_replayed_together(log, tmp_path):
    """As of one file; the sweep is called by the part that was named."""
    last = cosim.run("academic-as-printed", out=tmp_path / "a.mcap", set=END, rotate="5s")
    assert last.path.name == "a.part2.mcap"
    vary = {"identifier.P0": [1e3, 1e9]}
    parts = cosim.replay_sweep(last.path, vary=vary)
    whole = cosim.replay_sweep(log, vary=vary)
    assert parts.log == str(last.path)
    assert [row.results for row in parts.rows] == [row.results for row in whole.rows]


@pytest.mark.slow
def test_all_combinations_are_checked_before_the_first_runs(log, tmp_path):
    """The message names the one that is wrong, and nothing was written."""
    for vary, message in (
        ({"identifier.P0": [1e3, -1.0]}, r"identifier\.P0 = -1\.0: .*P0: .*-1\.0"),
        ({"plant.solver": ["RK45"]}, r"plant.solver = 'RK45': .*'plant'"),
        ({"identifer.P0": [1.0]}, r"identifer.P0 = 1.0: .*component 'identifer"),
        ({"observer.L": [[8.0, 0.0], [-50.0, 0.0]]}, r"observer.L = \[-50.0, 0.0\]: .*Hurwitz"),
    ):
        with pytest.raises(UsageError, match=message):
            cosim.replay_sweep(log, vary=vary, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_varied_key_cannot_be_set_too(log):
    """In whichever spelling."""
    message = r"set\['identifier.P0'\] or vary\['identifier.P0'\], got both"
    vary = {"components.identifier.P0": [1.0]}
    with pytest.raises(UsageError, match=message):
        cosim.replay_sweep(log, vary=vary, set={"identifier.P0": 2.0})


def test_a_replay_that_fails_is_a_row(failing, call):
    """The others go on; the exit code says that one failed."""
    sweep = cosim.replay_sweep(failing, vary={"w.y": ["t", "1/(t - 0.1)", "2*t"]})
    assert [bool(row.problem) for row in sweep.rows] == [False, True, False]
    assert "'w.y' became inf at t = 0.1 s" in sweep.rows[1].problem
    assert sweep.rows[1].results == {}
    assert sweep["w.y"] == [0.2, None, 0.4]
    assert not sweep.passed
    code, out, err = call("replay", failing.path, "--vary", "w.y=t,1/(t - 0.1)")
    assert code == 1
    assert "'1/(t - 0.1)'\tfailed" in out
    assert "row 2: failed: 'w.y' became inf at t = 0.1 s" in err


def test_logs_are_written_to_a_folder_that_is_named(failing, tmp_path):
    """In the order of the rows; those that are there are not replaced."""
    vary = {"u.amplitude": [1.0, 3.0]}
    folder = tmp_path / "new" / "logs"
    sweep = cosim.replay_sweep(failing, vary=vary, out=folder)
    paths = [row.path for row in sweep.rows]
    assert paths == [folder / "1.mcap", folder / "2.mcap"]
    assert cosim.open_log(paths[1])["u.y"][-1] == sweep["u.y"][1]
    assert cosim.replay_sweep(failing, vary=vary, out=folder, force=True).passed
    for options, message in (
        ({"out": folder}, "exists"),
        ({"out": tmp_path / "x.mcap"}, r"out: .*x\.mcap'"),
        ({"force": True}, "force=True"),
    ):
        with pytest.raises(UsageError, match=message):
            cosim.replay_sweep(failing, vary=vary, **options)


def test_progress_is_that_of_all_replays(failing):
    """From the first to the last, as one."""
    seen = []
    cosim.replay_sweep(
        failing, vary={"u.amplitude": [1.0, 3.0]}, progress=lambda *at: seen.append(at)
    )
    times = [time for time, _ in seen]
    assert times == sorted(times)
    assert seen[-1] == (0.4, 0.4)


@pytest.mark.slow
def test_the_command_line_shows_a_table(log, call):
    """Rows are the varied values, columns what the results say; --json has all of each."""
    command = ("replay", log.path, "--vary", "identifier.P0=1e3,1e9")
    code, out, err = call(*command, "--set", "observer.filter_rate=500")
    assert (code, err) == (0, "")
    title, header, *rows = out.splitlines()
    assert title == str(log.path)
    names, first, second = (line.split("\t") for line in (header, *rows))
    assert names[:3] == ["identifier.P0", "identifier.theta[0]", "identifier.theta[1]"]
    assert "identifier.theta[0] error" not in names
    assert ", error " in first[1]
    assert [first[0], second[0]] == ["1000.0", "1000000000.0"]
    assert len(first) == len(second) == len(names)
    code, out, _ = call(*command, "--json")
    found = json.loads(out)
    assert found["varied"] == ["identifier.P0"]
    assert [row["values"]["identifier.P0"] for row in found["rows"]] == [1e3, 1e9]
    assert found["rows"][0]["summary"]["scenario"] == "academic-as-printed"
    assert found["columns"] == list(found["rows"][0]["results"])
    assert call(*command, "--quiet") == (0, "", "")
    for option, value in (("--verify", ()), ("--plot", ("x.png",))):
        code, _, err = call(*command, option, *value)
        assert code == 2
        assert {option, "--vary"} <= set(err.split())


def test_a_scenario_problem_keeps_its_place(failing):
    """What is wrong with the value is said as for --set."""
    with pytest.raises(UsageError, match=r"v.y = '2 \*': .*components.v"):
        cosim.replay_sweep(failing, vary={"v.y": ["2 *"]})
    with pytest.raises(ScenarioError, match=r"components.v"):
        cosim.replay(failing, set={"v.y": "2 *"})


def test_a_recording_of_another_tool_is_replayed_with_varied_values(failing, tmp_path, call):
    """With the scenario and the map that a replay of it needs."""
    path = field_log(tmp_path)
    scenario = tmp_path / "loop.toml"
    scenario.write_text(LOOP, encoding="utf-8")
    vary = {"model.time_constant": [0.1, 0.4]}
    sweep = cosim.replay_sweep(path, vary=vary, scenario=scenario, map=BOTH)
    for row in sweep.rows:
        again = cosim.replay(path, scenario=scenario, map=BOTH, set=row.values)
        assert repr(row.summary) == repr(summarize(again))  # NaN is not equal to itself
    assert len(set(sweep["model.y"])) == 2
    wrong = {"model.time_constant": [0.1, -1.0]}
    with pytest.raises(UsageError, match=r"model.time_constant = -1.0: .*components.model"):
        cosim.replay_sweep(path, vary=wrong, scenario=scenario, map=BOTH)
    with pytest.raises(UsageError, match="scenario"):
        cosim.replay_sweep(path, vary=vary, map=BOTH)
    with pytest.raises(UsageError, match="omit scenario"):
        cosim.replay_sweep(failing, vary=vary, scenario=scenario)
    maps = [f"--map={port}={name}" for port, name in BOTH.items()]
    command = ("replay", path, "--scenario", scenario, *maps)
    code, out, _ = call(*command, "--vary", "model.time_constant=0.1,0.4")
    assert code == 0
    assert len(out.splitlines()) == 4


@pytest.mark.slow
def test_plants_of_models_are_varied_in_a_rerun(log):
    """Nothing of them is taken from the log then."""
    vary = {"u.amplitude": [1.0, 2.0]}
    with pytest.raises(UsageError, match="rerun=True"):
        cosim.replay_sweep(log, vary=vary)
    sweep = cosim.replay_sweep(log, vary=vary, rerun=True)
    run = cosim.run("academic-as-printed", set={**END, "u.amplitude": 2.0})
    assert sweep.rows[1].results["identifier.theta[0]"] == run["identifier.theta"][-1, 0]
