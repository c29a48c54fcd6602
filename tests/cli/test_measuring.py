"""The command metrics, against the dataset of a study whose members are run alone."""

import json
import re
import shlex

import pytest

import cosim
from cosim.cli import main
from cosim.studies.plan import RecordedStudy
from tests.studies.test_tuning import write_fit

METRICS = {
    "error": "rms(observer.delta - delta.y, t > 0.1)",
    "late": "first(t, abs(observer.delta - delta.y) < 1e-2 for 10 ms)",
    "never": "first(t, plant.y > 1e9)",
    "joined": "max(abs(plant.y)) - std(plant.y) / integral(plant.y)",
}


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Return what runs a command line in a folder of its own, and returns what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments, code=0):
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        captured = capsys.readouterr()
        assert (ended.value.code or 0) == code, captured.err
        return captured.out + captured.err

    return run


def plain(folder):
    vary = {
        "observer.filter_rate": {"log-uniform": [100.0, 1e3]},
        "plant.x_a0[0]": {"normal": [1.0, 0.1]},
    }
    return {
        "source": "academic-noisy",
        "vary": vary,
        "samples": 3,
        "seeds": 2,
        "set": {"scenario.stop": 0.5},
        "metrics": METRICS,
    }


def fmu(folder):
    write_fit(folder)
    return {
        "source": "fit.toml",
        "vary": {"plant.start.A": {"uniform": [-4.0, -1.0]}},
        "samples": 2,
        "metrics": {"rms": "rms(plant.y - measured.y)", "mean": "mean(plant.y, t > 0.1)"},
    }


def replays(folder):
    cosim.run("academic", set={"scenario.stop": 0.5}, out=folder / "field.mcap")
    vary = {"observer.filter_rate": [123.4, 1234.5]}
    return {"source": "academic", "replay": "field.mcap", "vary": vary, "metrics": METRICS}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [plain, fmu, replays])
def test_a_member_that_is_run_alone_has_the_bits_of_its_study(call, tmp_path, kind):
    """By the command that is printed, and from its log; in Python, too."""
    options = kind(tmp_path)
    study = cosim.study(**options, out="x", workers=1)
    assert study.failures == {}
    command_of = RecordedStudy.read(study.text).command_of(study)
    names = list(options["metrics"])
    for number, row in enumerate(study.table(names).to_pylist()):
        log = f"{number}.mcap"
        call(*shlex.split(command_of(number))[1:], "--out", log, "-q")
        recorded = {name: None if row[name] is None else row[name].hex() for name in names}
        values = json.loads(call("metrics", log, "--of", "x", "--json"))
        assert {n: v if v is None else v.hex() for n, v in values.items()} == recorded
        assert cosim.metrics(log, options["metrics"]) == values
    printed = call("metrics", log, "--of", "x")
    shown = dict(line.split("\t") for line in printed.splitlines() if line.strip())
    assert shown == {n: "no value" if v is None else repr(v) for n, v in values.items()}


def test_expressions_may_have_names(call):
    """The first sign of equality ends one, unless it is a comparison."""
    call("run", "academic", "--stop", "0.01", "--out", "a.mcap", "-q")
    expressions = ["count(t, t >= 0)", "n = count(t, t == 0)", "a b=last(t)"]
    values = json.loads(call("metrics", "a.mcap", *expressions, "--json"))
    assert values == {"count(t, t >= 0)": 11.0, "n": 1.0, "a b": 0.01}
    run = cosim.run("academic", set={"scenario.stop": 0.01})
    assert cosim.metrics(run, {"last": "last(t)"}) == {"last": 0.01}


def test_rows_that_a_log_lacks_are_said(call):
    """The metrics are those of the rows that it has."""
    call("run", "academic", "--stop", "0.1", "--set", "record.every=10", "--out", "a.mcap", "-q")
    printed = call("metrics", "a.mcap", "count(plant.y)")
    assert "count(plant.y)\t11.0" in printed
    assert "a.mcap has rows at every 10 steps only; metrics of the whole run" in printed
    call("run", "academic", "--stop", "0.1", "--out", "b.mcap", "-q")
    call("cut", "b.mcap", "--to", "0.05", "--out", "c.mcap")
    assert "c.mcap is a part of the log of its run" in call("metrics", "c.mcap", "last(t)")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "expected an expression, .*--of"),
        (["rms("], r"metrics\.rms\(: metric 'rms\('"),
        (["last(plant.z)"], "'plant' has no signal 'z'"),
        (["a=last(t)", "a=initial(t)"], "metric 'a': given twice"),
        (["--of", "none"], "dataset of a study"),
        (["--of", "a", "--of", "b"], "--of: .*given 2 times"),
    ],
)
def test_a_wrong_metric_is_refused(call, arguments, text):
    """With its place."""
    call("run", "academic", "--stop", "0.01", "--out", "a.mcap", "-q")
    assert re.search(text, call("metrics", "a.mcap", *arguments, code=2))


def test_a_log_that_is_not_there_is_refused(call):
    """By its name."""
    assert "none.mcap" in call("metrics", "none.mcap", "last(t)", code=2)


@pytest.mark.usefixtures("members_in_this_process")
@pytest.mark.slow
def test_a_study_without_metrics_is_refused(call):
    """As it says nothing of what to compute."""
    cosim.study("academic", set={"scenario.stop": 0.01}, out="x", workers=1)
    call("run", "academic", "--stop", "0.01", "--out", "a.mcap", "-q")
    assert "this study has no metrics" in call("metrics", "a.mcap", "--of", "x", code=2)


@pytest.mark.usefixtures("members_in_this_process")
@pytest.mark.slow
def test_a_log_of_another_scenario_than_the_study_is_noticed(call, tmp_path):
    folder = tmp_path / "study"
    cosim.study(**plain(folder), out=folder, workers=1)
    for scenario, is_noticed in (("academic-noisy", False), ("academic", True)):
        cosim.run(scenario, set={"scenario.stop": 0.5}, out=tmp_path / f"{scenario}.mcap")
        text = call("metrics", f"{scenario}.mcap", "--of", "study")
        assert ("these may not be metrics of a member of study: " in text) == is_noticed
