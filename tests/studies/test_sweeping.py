"""Replays of one log with varied values."""

from itertools import product

import numpy as np
import pytest

import cosim
from cosim.errors import Interrupted, UsageError
from cosim.report.summary import results_of, summarize
from cosim.scenario.running.replay import Replays
from cosim.studies.sweeping import combinations, show_sweep
from tests.scenario.field_recordings import BOTH, LOOP, field_log
from tests.scenario.refusals import check_refused

END = {"scenario.stop": 8.0}  # past the start of the identification at 6.461 s
FAILING = """
scenario = { name = "failing", stop = 0.2, step = 0.01 }
[components]
u = { kind = "sine", rate = 5.0 }
v = { kind = "expression", y = "2 * u.y" }
w = { kind = "expression", y = "t" }
"""
THETA = ("identifier.theta[0]", "identifier.theta[1]")


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


# --- what is varied ---


def test_combinations_are_the_full_product_in_order():
    """The last key changes first; values are those that TOML has, or a grid as studies have it."""
    found = combinations({"a.x": np.array([1.0, 2.0]), "b.y": [[0, 2], "z"]})
    values = [tuple(one.values()) for one in found]
    assert values == [(1.0, [0, 2]), (1.0, "z"), (2.0, [0, 2]), (2.0, "z")]
    assert combinations({"a.x": {"linear": [0, 1], "points": 2}}) == [{"a.x": 0.0}, {"a.x": 1.0}]


def test_a_thousand_combinations_are_the_most():
    """One more is refused before anything is built."""
    assert len(combinations({"a.x": range(10), "a.y": range(100)})) == 1000
    with pytest.raises(UsageError, match=r"vary: .*7 x 143 = 1001"):
        combinations({"a.x": range(7), "a.y": range(143)})


INVALID = [
    ({}, "vary: expected a key and its values"),
    ({"a.x": []}, r"vary\['a.x'\]: expected at least one value"),
    ({"a.x": "12"}, r"vary\['a.x'\]: expected a list .*'12'"),
    ({"a.x": [object]}, r"vary\['a.x'\]: expected a number, .* got <class 'object'>"),
    ({"a.x": {"uniform": [0, 1]}}, r"vary\['a.x'\]: .*'uniform'"),
    ({"a.x": {"linear": [0, 1]}}, r"vary\['a.x'\]: 'points'"),
    ([1.0], r"vary: .*\[1\.0\]"),
    ({1: [1.0]}, "vary: .* 1$"),
]


def test_an_invalid_list_of_values_is_refused():
    """The message names the key."""
    check_refused(INVALID, combinations)


# --- rows ---


@pytest.mark.slow
def test_each_row_is_a_replay_of_its_own(log):
    """With the values of its row and those that all have; in the order of the product.

    Its results are estimates, errors, verdicts and noise, by the names of the table.
    """
    common = {"observer.filter_rate": 500.0}
    vary = {"identifier.P0": [1e3, 1e9], "identifier.start": [7.0, 7.5]}
    sweep = cosim.replay_sweep(log.path, vary=vary, set=common)
    assert [tuple(row.values.values()) for row in sweep.rows] == list(product(*vary.values()))
    for row in sweep.rows:
        again = cosim.replay(log, set={**common, **row.values})
        assert row.summary == summarize(again)
        results = row.results
        assert results == results_of(summarize(again))
        theta = [results[name] for name in THETA]
        assert theta == again["identifier.theta"][-1].tolist()
        apart = [results[f"{name} error"] for name in THETA]
        assert apart == np.abs(np.array(theta) - [-0.1, -0.3]).tolist()
        assert isinstance(results["identifier verdict"], str)
        assert results["identifier noise"] > 0.0
    assert sweep["nothing"] == [None] * 4
    assert len(set(sweep[THETA[0]])) == 4
    assert sweep.passed


@pytest.mark.slow
def test_all_combinations_are_checked_before_the_first_runs(log, tmp_path):
    """The message names the one that is wrong, and nothing was written."""
    cases = [
        ({"identifier.P0": [1e3, -1.0]}, r"identifier\.P0 = -1\.0: .*P0: .*-1\.0"),
        ({"plant.solver": ["RK45"]}, r"plant.solver = 'RK45': .*'plant'"),
        ({"identifer.P0": [1.0]}, r"identifer.P0 = 1.0: .*component 'identifer"),
        ({"observer.L": [[8.0, 0.0], [-50.0, 0.0]]}, r"observer.L = \[-50.0, 0.0\]: .*Hurwitz"),
        ({"u.amplitude": [1.0, 2.0]}, "rerun=True"),  # the plant and its input are of the log
    ]
    check_refused(cases, lambda vary: cosim.replay_sweep(log, vary=vary, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_varied_key_cannot_be_set_too(failing):
    """In whichever spelling; and a wrong value is named with its key."""
    vary = {"components.u.amplitude": [1.0]}
    with pytest.raises(UsageError, match=r"'u.amplitude' \(\w+\) and 'u.amplitude' \(\w+\), got"):
        cosim.replay_sweep(failing, vary=vary, set={"u.amplitude": 2.0})
    with pytest.raises(UsageError, match=r"v.y = '2 \*': .*components.v"):
        cosim.replay_sweep(failing, vary={"v.y": ["2 *"]})


def test_a_replay_that_fails_is_a_row_and_an_interruption_is_none(failing, monkeypatch):
    """The others go on."""
    sweep = cosim.replay_sweep(failing, vary={"w.y": ["t", "1/(t - 0.1)", "2*t"]})
    assert [bool(row.problem) for row in sweep.rows] == [False, True, False]
    assert "'w.y' became inf at t = 0.1 s" in sweep.rows[1].problem
    assert sweep["w.y"] == [0.2, None, 0.4]
    _, table = show_sweep(sweep)
    assert [cell == "failed" for cell in table.columns[1].cells] == [False, True, False]
    assert not sweep.passed

    def interrupted(*_, **__):
        raise Interrupted("Ctrl-C")

    monkeypatch.setattr(Replays, "record", interrupted)
    with pytest.raises(Interrupted):
        cosim.replay_sweep(failing, vary={"u.amplitude": [1.0]})


def test_logs_of_replays_are_written_to_a_folder_that_is_named(failing, tmp_path):
    """In the order of the rows; those that are there are not replaced."""
    vary = {"u.amplitude": [1.0, 3.0]}
    folder = tmp_path / "new" / "logs"
    sweep = cosim.replay_sweep(failing, vary=vary, out=folder)
    first, second = sweep["u.y"]
    assert second == pytest.approx(3.0 * first)
    assert [row.path for row in sweep.rows] == [folder / "1.mcap", folder / "2.mcap"]
    assert cosim.open_log(folder / "2.mcap")["u.y"][-1] == second
    cases = [({"out": folder}, "exists"), ({"out": tmp_path / "x.mcap"}, r"out: .*x\.mcap'")]
    cases.append(({"force": True}, "force=True"))
    check_refused(cases, lambda options: cosim.replay_sweep(failing, vary=vary, **options))


def test_a_recording_of_another_tool_is_replayed_with_varied_values(tmp_path):
    """With the scenario and the map that a replay of it needs."""
    path = field_log(tmp_path)
    (tmp_path / "loop.toml").write_text(LOOP, encoding="utf-8")
    needed = {"scenario": tmp_path / "loop.toml", "map": BOTH}
    sweep = cosim.replay_sweep(path, vary={"model.time_constant": [0.1, 0.4]}, **needed)
    ends = [cosim.replay(path, set=row.values, **needed)["model.y"][-1] for row in sweep.rows]
    assert sweep["model.y"] == ends
    assert len(set(ends)) == 2
    wrong = {"model.time_constant": [0.1, -1.0]}
    with pytest.raises(UsageError, match=r"model.time_constant = -1.0: .*components.model"):
        cosim.replay_sweep(path, vary=wrong, **needed)
