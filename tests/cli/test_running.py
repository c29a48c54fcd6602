"""``cosim run`` and ``cosim replay``: what they write and print, and when they fail."""

import json
import re
import sys

import pytest

import cosim
from tests.fmi.eventful import build

SHORT = ("--stop", "0.1")
ROTATED = ("run", "academic", "--stop", "1", "--rotate", "0.4s", "--out", "run.mcap")
HEAD = 'scenario = { name = "x", stop = 1.0, step = 0.1 }\n[components]\n'


def fails_at(time):
    """Return a scenario whose value becomes infinite at a time [s]."""
    head = HEAD.replace("step = 0.1", "step = 0.01")
    return f'{head}u = {{ kind = "expression", y = "log({time} - t)" }}\n'


# --- what is written and printed ---


def test_a_run_without_a_path_gets_one_of_its_own(call, tmp_path):
    """``logs/<scenario>.mcap``, then -2, -3; it is in the table, and nothing is on stderr."""
    for name in ("academic.mcap", "academic-2.mcap", "academic-3.mcap"):
        code, out, err = call("run", "academic", *SHORT)
        assert (code, err) == (0, "")
        assert f"log\tlogs/{name}" in out.splitlines()
        assert (tmp_path / "logs" / name).is_file()


def test_a_log_is_replaced_by_a_run_and_not_by_a_refusal(call, tmp_path):
    """Also where the scenario is refused after its text is read: the old log stays as it is."""
    path = tmp_path / "a.mcap"
    path.write_bytes(b"old")
    (tmp_path / "chase.toml").write_text(
        f'{HEAD}x = {{ kind = "lag", time_constant = 1.0 }}\n'
        '[connections]\n"x.u" = { from = "x.y", offset = 1.0 }\n'
    )
    for arguments in (["chase.toml"], ["academic", "--plot", "x.xyz"]):
        assert call("run", *arguments, "--out", "a.mcap", "--force")[0] == 2
        assert path.read_bytes() == b"old"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.mcap", "chase.toml"]
    assert call("run", "academic", *SHORT, "--out", "a.mcap", "--force")[0] == 0
    assert cosim.open_log(path).status == "complete"


def test_json_is_one_document_with_the_same_content(call):
    code, out, err = call("run", "academic", *SHORT, "--json", "--profile")
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert (found["steps"], found["status"], found["log"]) == (
        100,
        "complete",
        "logs/academic.mcap",
    )
    unknown = {"estimate": "identifier.theta[0]", "value": None, "truth": -0.1, "error": None}
    assert found["values"][0] == unknown
    assert found["last"] == {}, "there is a truth"
    assert set(found["profile"]) >= {"plant", "observer", "recorder and master"}


def test_quiet_says_nothing_and_computes_nothing_for_it(call, monkeypatch):
    monkeypatch.setattr("cosim.report.tables.run.summarize", None)
    assert call("run", "academic", *SHORT, "--quiet") == (0, "", "")


@pytest.mark.parametrize(
    ("table", "interpolation", "said"),
    [
        ("a,y\n0,1\n1,1\n2,3\n", "linear", {"unit", "c"}),
        ("t [s],y [mm]\n0,1\n0.1,1\n0.2,1\n0.3,1\n5,2\n", "zero-order", set()),
    ],
    ids=["no units", "units, and a sample that is held for long"],
)
def test_quiet_keeps_what_times_and_units_are_taken_for(call, tmp_path, table, interpolation, said):
    """A wrong guess there is a wrong result; the name of a component is no question of units."""
    (tmp_path / "x.csv").write_text(table)
    (tmp_path / "x.toml").write_text(
        f"""{HEAD.replace("stop = 1.0", "stop = 2.0")}
        unit = {{ kind = "field-data", path = "x.csv", interpolation = "{interpolation}" }}
        b = {{ kind = "constant", value = 1.0, unit = "mm" }}
        c = {{ kind = "gain", K = [[1.0, 0.0], [0.0, 1.0]], unit = {{ u = "m" }} }}
        [connections]
        "c.u" = ["unit.y", "b.y"]
        """
    )
    code, out, err = call("run", "x.toml", "--quiet")
    assert (code, out) == (0, "")
    assert {line.split(":")[1].strip() for line in err.splitlines()} == said


def test_step_stop_set_and_plot_reach_the_run_and_its_replay(call, monkeypatch):
    drawn = []
    monkeypatch.setattr("cosim.report.plots.runs.plot_run", lambda *given: drawn.append(given))
    changes = ("--step", "0.002", "--set", "observer.filter_rate=500")
    call("run", "academic", "--stop", "0.2", *changes, "--out", "a.mcap", "--plot", "run.png")
    log = cosim.open_log("a.mcap")
    assert (log.step_ns, log.time("plant")[-1]) == (2_000_000, 0.2)
    assert json.loads(log.metadata["cosim.component.observer"]["table"])["filter_rate"] == 500
    code, out, _ = call("replay", "a.mcap", "--stop", "0.1", "--plot", "again.png")
    assert code == 0
    assert "0.1 s in 50 steps" in out
    assert [(run.steps, str(out)) for run, out in drawn] == [(100, "run.png"), (50, "again.png")]


def test_without_matplotlib_a_plot_names_the_way_out(call, tmp_path, monkeypatch):
    """Before anything is run for it."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, _, err = call("run", "academic", "--out", "a.mcap", "--plot", "a.png")
    assert code == 2
    assert "pip install -e '.[plot]'" in err
    assert not (tmp_path / "a.mcap").exists()


def test_a_run_that_an_fmu_ends_says_why(call, tmp_path):
    """It requests the end at 0.325 s; the reason is in the table, in JSON and in the log."""
    (tmp_path / "x.toml").write_text(
        f'{HEAD}plant = {{ kind = "fmu", path = "{build("ENDS")}", start = {{ p = 0.325 }} }}\n'
        'zero = { kind = "constant", value = 0.0 }\n'
        '[connections]\n"plant.u" = "zero.y"\n"plant.d" = "zero.y"\n'
    )
    reason = "'plant' stopped at t = 0.3 s: the FMU requests the end of the run"
    code, out, err = call("run", "x.toml", "--out", "x.mcap")
    assert (code, err.count("\n")) == (0, 1)  # its warning
    assert "x: 0.3 s in 3 steps" in out
    for text in (out, call("info", "x.mcap")[1]):
        assert f"stop reason\t{reason}" in text.splitlines()
    found = json.loads(call("run", "x.toml", "--json")[1])
    assert (found["status"], found["reason"]) == ("complete", reason)


# --- what fails ---


@pytest.mark.parametrize(
    ("time", "said"),
    [
        (0.5, "holds the run up to t = 0.49 s"),
        (0.01, "holds the run up to t = 0.0 s"),
        (0, "has no row of the run"),
    ],
)
def test_a_failed_run_is_exit_1_and_leaves_a_valid_log(call, tmp_path, time, said):
    """Everything before the value that is not finite is kept, and the log says that it failed."""
    (tmp_path / "bad.toml").write_text(fails_at(time))
    code, out, err = call("run", "bad.toml", "--out", "bad.mcap")
    assert (code, out) == (1, "")
    first, last = err.splitlines()
    assert re.search(rf"^cosim: 'u\.y' .*-inf at t = {float(time)} s", first)
    assert last == f"cosim: bad.mcap {said}"
    assert json.loads(call("info", "bad.mcap", "--json")[1])["run"]["status"] == "failed"


def test_warnings_fail_a_run_where_they_are_to(call):
    """Each once, with what it says; a run without one passes."""
    plain = ("run", "academic", *SHORT, "--quiet", "--no-verdicts")
    held = (*plain, "--set", "scenario.input_interpolation=zero-order")
    assert call(*held) == call(*plain, "--fail-on", "warning") == (0, "", "")
    code, _, err = call(*held, "--fail-on", "warning")
    observer, step = err.splitlines()
    assert code == 1
    assert observer.startswith("cosim: --fail-on warning: observer: ")
    assert step.startswith("cosim: --fail-on warning: scenario.step: ")


def test_an_assertion_is_one_of_the_run_and_of_its_replay(call):
    """One that does not hold is a line with what its metrics are."""
    given = ("--quiet", "--no-verdicts", "--assert", "last(plant.y) < 1")
    assert call("run", "academic", *SHORT, *given, "--out", "a.mcap") == (0, "", "")
    false = "rms(observer.delta) < 0.1"
    for command in (("run", "academic", *SHORT), ("replay", "a.mcap")):
        code, out, err = call(*command, *given, "--assert", false)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert err.startswith(f"cosim: --assert {false}: rms(observer.delta) = ")


def test_a_verdict_that_is_asked_for_and_not_made_fails(call):
    """A scenario may switch verdicts off: nobody then says that all is well."""
    options = ("--set", "scenario.verdicts=false", "--fail-on", "inconsistent")
    code, _, err = call("run", "academic", *SHORT, *options)
    assert code == 1
    assert "--fail-on inconsistent: identifier: no verdict was made" in err


@pytest.mark.slow
def test_an_estimate_that_contradicts_its_data_fails(call):
    """Its alpha is another one than that of the disturbance; the sentence is on stderr anyway."""
    wrong = ("--set", "regressor.terms[0].alpha=1.0 + sin(9*t)", "--stop", "0.5", "--quiet")
    code, _, err = call("run", "academic", *wrong)
    assert code == 0
    assert err.startswith("warning: identifier.theta[0], identifier.theta[1]: INCONSISTENT: ")
    code, _, err = call("run", "academic", *wrong, "--fail-on", "no-estimate,inconsistent")
    assert code == 1
    assert err.splitlines()[-1].startswith("cosim: --fail-on inconsistent: identifier.theta[0]")


# --- logs in several files ---


@pytest.mark.slow
def test_the_files_and_the_end_of_the_whole_run_are_shown(call, tmp_path):
    """As a table and as JSON."""
    code, out, err = call(*ROTATED)
    assert (code, err) == (0, "")
    status, steps, digest, *logs = out.splitlines()[:6]
    names = ["run.mcap", "run.part2.mcap", "run.part3.mcap"]
    assert (status, steps) == ("status\tcomplete", "steps\t1000, up to 1.0 s")
    assert logs == [f"log\t{name}" for name in names]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert digest.startswith("content hash\t")
    assert "part 2 of its log, from 0.4 s to 0.799 s" in call("info", "run.part2.mcap")[1]
    shown = json.loads(call(*ROTATED, "--force", "--json")[1])
    assert (shown["status"], shown["steps"], shown["end"]) == ("complete", 1000, 1.0)
    assert (shown["logs"], "u.y" in shown["results"]["last"]) == (names, True)


def test_a_run_that_fails_names_the_last_of_its_files(call, tmp_path):
    (tmp_path / "bad.toml").write_text(fails_at(0.5))
    code, _, err = call("run", "bad.toml", "--out", "bad.mcap", "--rotate", "0.2s")
    assert code == 1
    assert err.splitlines()[-1] == (
        "cosim: bad.part3.mcap is the last of several files, which hold the run up to t = 0.49 s"
    )
    names = ["bad.mcap", "bad.part2.mcap", "bad.part3.mcap"]
    assert call("merge", *names, "-o", "whole.mcap")[1].startswith("whole.mcap: failed, 'u.y'")


# --- recordings of other tools ---
