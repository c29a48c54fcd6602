"""Tunings of scenarios, from the command and from Python: found, resumed, refused, judged."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import curve_fit

import cosim
from cosim.cli.app import main
from cosim.errors import CosimError, UsageError
from cosim.studies.dataset import StudyDataset
from tests.studies.fitted_fmu import EXPRESSION, TIMES, A, B, record, response, write, write_fit

LAG = """
scenario = { name = "lag", stop = 2.0, step = 0.01 }
[components]
u = { kind = "constant", value = 1.0 }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
[connections]
"plant.u" = "u.y"
"""
KILLED = """
import os, signal, sys
from cosim.cli.app import main
from cosim.studies.dataset import StudyDataset

add = StudyDataset.add
left = int(sys.argv[1])


def killed(self, member, outcome):
    global left
    add(self, member, outcome)
    left -= 1
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)


StudyDataset.add = killed
main(sys.argv[2:])
"""
GOAL = "abs(last(plant.y) - 0.5)"
BOUNDS = {"plant.time_constant": {"log": [0.1, 10.0]}}
FIT = {"plant.start.A": {"linear": [-10.0, -0.1]}, "plant.start.B": {"log": [0.1, 10.0]}}


@pytest.fixture
def lag(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return path


def tuned(path, **given):
    """Tune the lag."""
    return cosim.tune(path, **{"minimize": GOAL, "vary": BOUNDS, "workers": 1, **given})


def tune_fit(path, **given):
    """Tune the FMU to the recording."""
    fit = {"minimize": EXPRESSION, "vary": FIT, "standard_errors": True, "workers": 1}
    return cosim.tune(path, **fit, **given)


def rows_of(place):
    """Return the rows of a dataset, without what differs from run to run."""
    table = StudyDataset.open(place).read().drop_columns(["wall_time", "worker", "log"])
    return table.to_pylist()


def test_the_closed_form_is_found(lag):
    """1 - exp(-2 / T) = 0.5 has T = 2 / log 2; the first run is that of the scenario."""
    result = tuned(lag, members=60, starts=1)
    assert result.estimate["plant.time_constant"] == pytest.approx(2.0 / np.log(2.0), rel=1e-4)
    assert result.standard_errors is None
    assert result.history[0]["values"] == {"plant.time_constant": 0.7}
    assert result.history[0]["objective"] == pytest.approx(0.5 - np.exp(-2.0 / 0.7), abs=1e-5)
    assert len(result.history) <= 60
    assert repr(result).startswith(f"<TuningResult {GOAL}: ")
    assert result.best_end.converged
    outside = {"plant.time_constant": {"log": [1.0, 4.0]}}  # the middle is tried, then
    assert tuned(lag, vary=outside, members=1).estimate == {"plant.time_constant": 2.0}


@pytest.mark.slow
def test_two_parameters_of_an_fmu_come_from_a_recording_with_noise(tmp_path):
    """Within three standard errors of the truth, and the result of curve_fit on the closed form."""
    fit = write_fit(tmp_path)
    measured = record(tmp_path, 1)
    solution, covariance = curve_fit(response, TIMES, measured, p0=[-1.0, 1.0])
    expected = np.sqrt(np.diag(covariance))
    result = tune_fit(fit)
    found = np.array(list(result.estimate.values()))
    errors = np.array(list(result.standard_errors.values()))
    assert len(result.trials) <= 200
    assert (np.abs(found - [A, B]) <= 3.0 * errors).all()
    assert (np.abs(found - solution) <= 0.1 * expected).all()
    assert errors == pytest.approx(expected, rel=0.02)
    residual = response(TIMES, *found) - measured
    neighbours = residual[1:] @ residual[:-1] / (residual @ residual)
    assert result.residual.neighbours == pytest.approx(neighbours, abs=1e-9)
    assert (result.errors.samples, result.residual.rows) == (TIMES.size, TIMES.size)


@pytest.mark.slow
def test_noise_that_is_colored_or_a_model_that_is_wrong_is_said(tmp_path):
    """Samples that follow each other say less; what has structure has no standard errors."""
    fit = write_fit(tmp_path)
    white = 0.01 * np.random.default_rng(2).standard_normal(TIMES.size)
    colored = np.array([white[: k + 1] @ 0.8 ** np.arange(k, -1, -1) for k in range(TIMES.size)])
    found = {}
    for name, y in {
        "colored": response(TIMES, A, B) + colored,
        "wrong": response(TIMES, A, B) + 0.05 * np.sin(3.0 * TIMES),
    }.items():
        write(tmp_path, y)
        found[name] = tune_fit(fit, starts=1, members=100)
    assert found["colored"].errors.samples < 150
    assert "by their color" in " ".join(found["colored"].statements)
    assert found["wrong"].errors is None
    assert "samples" in found["wrong"].errors_problem


@pytest.mark.campaign
def test_standard_errors_of_an_fmu_cover_the_truth_over_many_seeds(tmp_path):
    """Of 100 seeds 95: fewer than 87 have a probability below 1 % for each of both."""
    fit = write_fit(tmp_path)
    hits = np.zeros(2, int)
    for seed in range(100):
        record(tmp_path, seed)
        result = tune_fit(fit, starts=1, members=100)
        intervals = result.errors.intervals.values()
        hits += [low < truth < high for (low, high), truth in zip(intervals, [A, B], strict=True)]
    assert (hits >= 87).all()


@pytest.mark.slow
def test_a_tuning_that_is_killed_and_goes_on_ends_as_an_undisturbed_one(lag, tmp_path):
    """Its dataset is the same, row for row and bit for bit, but for times and workers."""
    given = {"minimize": "rms(plant.y - 0.5)", "standard_errors": True, "members": 40}
    whole = tuned(lag, **given, out=tmp_path / "whole")
    arguments = ["tune", str(lag), "--minimize=rms(plant.y - 0.5)", "--members=40", "--workers=1"]
    arguments += ["--vary=plant.time_constant=log:0.1:10", "--standard-errors"]
    command = [sys.executable, "-c", KILLED, "17", *arguments, f"--out={tmp_path / 'killed'}"]
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert len(StudyDataset.open(tmp_path / "killed")) == 17
    again = tuned(lag, **given, out=tmp_path / "killed")
    assert again.to_dict() == whole.to_dict()
    assert rows_of(tmp_path / "killed") == rows_of(tmp_path / "whole")


def test_a_tuning_that_is_run_again_runs_nothing(lag, tmp_path):
    """The dataset has all members."""
    results, rows = [], []
    for _ in range(2):
        results.append(tuned(lag, members=12, out=tmp_path / "d"))
        rows.append(StudyDataset.open(tmp_path / "d").read().to_pylist())
    assert results[0] == results[1]
    assert rows[0] == rows[1]  # wall times, too
    shown = [(row["plant.time_constant"], row["objective"]) for row in rows[0]]
    assert shown == [(*trial.point.values(), trial.objective) for trial in results[0].trials]


def test_the_dataset_is_shown_by_its_best_members(lag, tmp_path, capsys):
    """No statistics are told of values that a search chose."""
    result = tuned(lag, members=12, out=tmp_path / "d")
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["study", "show", str(tmp_path / "d"), "--json"])
    content = json.loads(capsys.readouterr().out)
    assert content["best"][0]["values"] == result.estimate
    assert content["search"]["maximize"] is False
    assert "statistics" not in content
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["study", "show", str(tmp_path / "d"), "--worst", "2"])
    assert f"member {result.best.number} alone: {result.command}" in capsys.readouterr().out


@pytest.mark.slow
def test_swapped_models_are_searched_with_optuna(lag, tmp_path):
    """The recording that ends at a half is the best, without any trial of a third one."""
    paths = [tmp_path / "low.csv", tmp_path / "high.csv"]
    for path, value in zip(paths, (0.5, 0.9), strict=True):
        path.write_text(f"time,y\n0,{value}\n2,{value}\n")
    result = tuned(lag, vary={"plant": list(map(str, paths))}, method="optuna", members=9)
    assert result.estimate == {"swap.plant": str(paths[0])}
    assert (result.best.objective, len(result.history)) == (0.0, 2)
    assert f"--swap plant={paths[0]}" in result.command


def test_a_log_is_replayed_by_every_trial(lag, tmp_path):
    """The estimate is that of the run that recorded it."""
    log = tmp_path / "lag.mcap"
    cosim.run(lag, out=log, set={"plant.time_constant": 1.25})
    result = tuned(log, members=3, starts=1)
    assert result.history[0]["values"] == {"plant.time_constant": 1.25}
    assert "cosim replay" in result.command


def test_another_search_does_not_go_on_in_a_dataset(lag, tmp_path):
    given = {"members": 3, "out": tmp_path / "d"}
    tuned(lag, **given)
    for other, what in [
        ({"seed": 2}, "another study: the seed changed; choose"),
        ({"minimize": "last(plant.y)"}, "the objective changed"),
        ({"set": {"scenario.stop": 1.0}}, "key scenario.stop changed"),
    ]:
        with pytest.raises(CosimError) as caught:
            tuned(lag, **given, **other)
        assert what in str(caught.value)
    tuned(lag, **given, seed=2, new=True)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"minimize": "last(plant.z)"}, "minimize: the run has no"),
        ({"minimize": "last(plant.y"}, r"minimize: metric 'last\(plant.y'"),
        ({"minimize": None}, "minimize and maximize: expected a metric"),
        ({"vary": {"plant.tim": {"linear": [0.1, 1.0]}}}, "plant.tim = 0.1: unknown key 'tim'"),
        ({"vary": {"plant.time_constant": {"linear": [-2.0, -1.0]}}}, "plant.time_constant = -"),
        ({"vary": {"plant.time_constant": {"log": [1.0]}}}, "bounds, such as {'linear'"),
        ({"samples": 0}, "samples: .*got 0"),
        ({"members": 2.5}, "members: .*2.5"),
        ({"replay": ["a.mcap"]}, "replay: .*no file matches "),
        ({"set": {"plant.initial": float("nan")}}, "plant.initial"),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(lag, tmp_path, given, words):
    """And leaves the dataset that is there."""
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "study.json").write_text("{}")
    with pytest.raises(UsageError, match=words):
        tuned(lag, out=tmp_path / "d", new=True, **given)
    assert [path.name for path in (tmp_path / "d").iterdir()] == ["study.json"]


def test_a_first_member_that_fails_ends_the_tuning_and_leaves_no_dataset(lag, tmp_path):
    """A value that grows without end."""
    grows = '[components]\ngrows = { kind = "expression", y = "1 / (0.5 - t)" }'
    lag.write_text(lag.read_text().replace("[components]", grows))
    with pytest.raises(UsageError, match=r"(?s)the first member fails.*nothing was tuned.* set"):
        tuned(lag, members=3, out=tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_tuning_says_what_its_members_warn_of():
    """In its statements, and in Python as a warning."""
    held = {"scenario.input_interpolation": "zero-order", "observer.filter": "first-order"}
    with pytest.warns(cosim.CosimWarning, match="members warn, such as 0: observer: "):
        result = cosim.tune(
            "academic",
            minimize="rms(observer.delta - delta.y)",
            vary={"observer.filter_rate": {"linear": [500.0, 900.0]}},
            set={"scenario.stop": 0.01, **held},
            members=3,
            workers=1,
        )
    assert len(result.warnings) > 1
    assert set(result.warnings) <= set(result.statements)
