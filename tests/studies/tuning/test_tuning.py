"""Scenarios are tuned by members in workers; a dataset makes a tuning go on where it was."""

import json
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

import cosim
from cosim.cli.app import main
from cosim.errors import CosimError, UsageError
from cosim.studies.dataset import StudyDataset
from cosim.studies.tuning.searching import TuningSearch
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.studies.tuning.task import TuningTask, is_rms
from cosim.studies.tuning.tuning import tune_task
from tests.studies.fitted_fmu import (
    EXPRESSION,
    TIMES,
    A,
    B,
    record,
    response,
    task_of,
    write_fit,
)
from tests.studies.tuning.lags import LAG, rows_of

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


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    return write_fit(tmp_path_factory.mktemp("fit"))


@pytest.fixture
def lag(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return path


def lag_task(path, expression="abs(last(plant.y) - 0.5)", **options):
    search = TuningSearch(
        SearchSpace((BoundedKey("plant.time_constant", 0.1, 10.0, True),)), "", **options
    )
    return TuningTask(str(path), expression, search)


@pytest.mark.slow
def test_two_parameters_of_an_fmu_come_from_a_recording_with_noise(fit, tmp_path):
    """Within three standard errors of the truth, and the result of curve_fit on the closed form."""
    measured = record(fit.parent, 1)
    solution, covariance = curve_fit(response, TIMES, measured, p0=[-1.0, 1.0])
    expected = np.sqrt(np.diag(covariance))
    result = tune_task(task_of(fit, with_errors=True), out=tmp_path / "d", workers=2)
    found = np.array(list(result.best.point.values()))
    errors = np.array(list(result.errors.errors.values()))
    assert len(result.trials) <= 200
    assert result.errors.samples == TIMES.size
    assert (np.abs(found - [A, B]) <= 3.0 * errors).all()
    assert (np.abs(found - solution) <= 0.1 * expected).all()
    assert errors == pytest.approx(expected, rel=0.02)
    residual = response(TIMES, *found) - measured
    neighbours = residual[1:] @ residual[:-1] / (residual @ residual)
    assert result.residual.neighbours == pytest.approx(neighbours, abs=1e-9)
    assert result.residual.rows == TIMES.size
    assert "501 samples of the residual are white with a constant" in result.statements[-1]


@pytest.mark.campaign
def test_standard_errors_of_an_fmu_cover_the_truth_over_many_seeds(tmp_path):
    """Of 100 seeds 95: fewer than 87 have a probability below 1 % for each of both."""
    path = write_fit(tmp_path)
    hits = np.zeros(2, int)
    for seed in range(100):
        record(tmp_path, seed)
        task = task_of(path, with_errors=True, starts=1, members=100)
        intervals = tune_task(task, workers=1).errors.intervals.values()
        hits += [low < truth < high for (low, high), truth in zip(intervals, [A, B], strict=True)]
    assert (hits >= 87).all()


@pytest.mark.slow
def test_a_tuning_that_is_killed_and_goes_on_ends_as_an_undisturbed_one(lag, tmp_path):
    """Its dataset is the same, row for row and bit for bit, but for times and workers."""
    task = lag_task(lag, "rms(plant.y - 0.5)", with_errors=True, members=40)
    whole = tune_task(task, out=tmp_path / "whole", workers=1)
    arguments = ["tune", str(lag), f"--minimize={task.expression}", "--members=40", "--workers=1"]
    arguments += ["--vary=plant.time_constant=log:0.1:10", "--standard-errors"]
    command = [sys.executable, "-c", KILLED, "17", *arguments, f"--out={tmp_path / 'killed'}"]
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert len(StudyDataset.open(tmp_path / "killed")) == 17
    assert len(whole.trials) > 17
    again = tune_task(task, out=tmp_path / "killed", workers=1)
    assert again.to_dict() == whole.to_dict()
    assert rows_of(tmp_path / "killed") == rows_of(tmp_path / "whole")


def test_a_tuning_that_is_run_again_runs_nothing(lag, tmp_path):
    """Its progress counts every member once, as that of the first; the dataset has them all."""
    task = lag_task(lag, members=12)
    results = []
    rows = []
    for _ in range(2):
        seen = []
        results.append(
            tune_task(
                task,
                out=tmp_path / "d",
                workers=1,
                progress=lambda *counts, seen=seen: seen.append(counts),
            )
        )
        assert list(dict.fromkeys(seen)) == [(k, 12, 0) for k in range(1, 13)]
        rows.append(StudyDataset.open(tmp_path / "d").read().to_pylist())
    assert results[0] == results[1]
    assert rows[0] == rows[1]  # wall times, too
    shown = [(row["plant.time_constant"], row["objective"]) for row in rows[0]]
    assert shown == [(*trial.point.values(), trial.objective) for trial in results[0].trials]


def test_the_dataset_is_shown_as_that_of_a_study(lag, tmp_path, capsys):
    """By its best members: no statistics are told of values that a search chose."""
    result = tune_task(lag_task(lag, members=12), out=tmp_path / "d", workers=1)
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["study", "show", str(tmp_path / "d"), "--worst", "2"])
    first, wall, title, heads, best, second, alone = capsys.readouterr().out.splitlines()
    assert first == (
        "tuning of lag: cobyqa, minimize abs(last(plant.y) - 0.5); 12 members of at most 12, "
        "none failed"
    )
    assert wall.startswith("wall time: ")
    assert title == "best members"
    assert heads.split() == ["member", "objective", "plant.time_constant"]
    costs = sorted((trial.objective, trial.number, trial.point) for trial in result.trials)
    for line, (objective, number, point) in zip((best, second), costs, strict=False):
        (value,) = point.values()
        assert line.split() == [str(number), f"{objective:.6g}", f"{value:.6g}"]
    assert alone == f"member {result.best.number} alone: {result.command}"
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["study", "show", str(tmp_path / "d"), "--json"])
    content = json.loads(capsys.readouterr().out)
    assert content["best"][0]["objective"] == result.best.objective
    assert content["best"][0]["values"] == result.estimate
    assert content["best"][0]["command"] == result.command
    assert content["search"]["maximize"] is False
    assert "statistics" not in content
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["study", "show", str(tmp_path / "d"), "--member", "3"])
    row = rows_of(tmp_path / "d")[3]
    command = f"cosim run {lag} --set plant.time_constant={row['plant.time_constant']!r}"
    assert command in capsys.readouterr().out


@pytest.mark.slow
def test_swapped_models_are_searched_with_optuna(lag, tmp_path):
    """The recording that ends at a half is the best, without any trial of a third one."""
    paths = [tmp_path / "low.csv", tmp_path / "high.csv"]
    for path, value in zip(paths, (0.5, 0.9), strict=True):
        path.write_text(f"time,y\n0,{value}\n2,{value}\n")
    result = cosim.tune(
        lag,
        minimize="abs(last(plant.y) - 0.5)",
        vary={"plant": list(map(str, paths))},
        method="optuna",
        members=9,
        workers=1,
    )
    assert result.estimate == {"swap.plant": str(paths[0])}
    assert result.best.objective == 0.0
    assert len(result.history) == 2
    assert f"--swap plant={paths[0]}" in result.command


def test_another_search_does_not_go_on_in_a_dataset(lag, tmp_path):
    tune_task(lag_task(lag, members=3), out=tmp_path / "d", workers=1)
    for other, what in [
        (
            lag_task(lag, members=3, seed=2),
            "another study: the seed changed; choose",
        ),
        (lag_task(lag, "last(plant.y)", members=3), "the objective changed"),
        (
            replace(lag_task(lag, members=3), set={"scenario.stop": 1.0}),
            "key scenario.stop changed",
        ),
    ]:
        with pytest.raises(CosimError) as caught:
            tune_task(other, out=tmp_path / "d", workers=1)
        assert what in str(caught.value)
    tune_task(other, out=tmp_path / "d", new=True, workers=1)


def test_a_first_point_that_is_refused_is_named_by_its_key(lag):
    """There is no table of cases in which it could stand."""
    search = TuningSearch(SearchSpace((BoundedKey("plant.time_constant", -2.0, -1.0),)), "")
    with pytest.raises(UsageError) as caught:
        tune_task(TuningTask(str(lag), "last(plant.y)", search), workers=1)
    assert str(caught.value).startswith("plant.time_constant = -1.5: components.plant: ")


@pytest.mark.parametrize(
    ("expression", "key", "message"),
    [
        ("last(plant.z)", "plant.time_constant", "minimize: the run has no"),
        ("last(plant.y)", "plant.tim", "plant.tim = 0.1: unknown key 'tim'"),
        ("last(plant.y", "plant.time_constant", "minimize: metric 'last(plant.y'"),
    ],
)
def test_errors_are_said_before_anything_runs(lag, expression, key, message):
    search = TuningSearch(SearchSpace((BoundedKey(key, 0.1, 10.0),)), "")
    with pytest.raises(UsageError) as caught:
        tune_task(TuningTask(str(lag), expression, search), workers=1)
    assert message in str(caught.value)


def test_a_variable_that_an_fmu_has_not_is_refused(fit, tmp_path):
    search = TuningSearch(SearchSpace((BoundedKey("plant.start.Q", 0.1, 10.0),)), "")
    with pytest.raises(UsageError, match=r"small: no variable 'Q'; .*: u, v, x, y, z, A, B"):
        tune_task(TuningTask(str(fit), EXPRESSION, search), workers=1, out=tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_first_member_that_fails_ends_the_tuning_and_leaves_no_dataset(lag, tmp_path):
    """Nor does it remove the one that is there."""
    divided = {"scenario.stop": 1.0}  # by zero, at 0.5 s
    grows = '[components]\ngrows = { kind = "expression", y = "1 / (0.5 - t)" }'
    lag.write_text(lag.read_text().replace("[components]", grows).replace("2.0, s", "0.1, s"))
    task = replace(lag_task(lag, members=3), set=divided)
    old = tmp_path / "old"
    old.mkdir()
    (old / "study.json").write_text("{}")
    for place in (tmp_path / "fresh", old):
        with pytest.raises(
            UsageError, match=r"(?s)the first member fails.*nothing was tuned.* set"
        ):
            tune_task(task, out=place, workers=1, new=True)
    assert not (tmp_path / "fresh").exists()
    assert [path.name for path in old.iterdir()] == ["study.json"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "workers: .*got 0"),
        ({"workers": 1.5}, "workers: .*1.5"),
        ({"new": "yes"}, "new: .*'yes'"),
        ({"timeout": -1.0}, "timeout: "),
        ({"members": 2.5}, "members: .*2.5"),
        ({"minimize": 3}, "minimize: .*got 3"),
        ({"vary": {"plant.time_constant": {"log": [1.0]}}}, "bounds, such as {'linear'"),
        ({"vary": ["plant.time_constant"]}, r"vary: .*\['plant.time_constant'\]"),
        ({"replay": ["a.mcap"]}, "replay: .*no file matches "),
    ],
)
def test_wrong_options_leave_the_dataset_that_is_there(lag, tmp_path, options, message):
    place = tmp_path / "d"
    place.mkdir()
    (place / "study.json").write_text("{}")
    given = {
        "minimize": "last(plant.y)",
        "vary": {"plant.time_constant": {"log": [0.1, 10.0]}},
        "new": True,
        **options,
    }
    with pytest.raises(UsageError, match=message):
        cosim.tune(lag, out=place, **given)
    assert [path.name for path in place.iterdir()] == ["study.json"]


@pytest.mark.slow
def test_a_trial_at_a_bound_may_fail():
    """At 0 the algebraic state is not determined, and below a half the observer is not stable."""
    key = "models.academic.A[2][2]"
    result = cosim.tune(
        "academic",
        maximize="max(abs(plant.x_b))",
        vary={key: {"linear": [0.0, 1.0]}},
        set={"scenario.stop": 0.1},
        members=20,
        workers=1,
    )
    assert result.failed
    assert all(trial.point[key] < 0.5 for trial in result.failed)
    assert 0.5 < result.estimate[key] < 1.0


def test_python_and_the_command_tune_the_same(lag, tmp_path):
    """1 - exp(-2 / T) = 0.5 has T = 2 / log 2; its first run is that of the scenario."""
    result = cosim.tune(
        lag,
        minimize="abs(last(plant.y) - 0.5)",
        vary={"plant.time_constant": {"log": [0.1, 10.0]}},
        members=60,
        starts=1,
        workers=1,
    )
    assert result.estimate["plant.time_constant"] == pytest.approx(2.0 / np.log(2.0), rel=1e-4)
    assert result.standard_errors is None
    assert result.history[0]["values"] == {"plant.time_constant": 0.7}
    assert result.history[0]["objective"] == pytest.approx(0.5 - np.exp(-2.0 / 0.7), abs=1e-5)
    assert len(result.history) <= 60
    assert repr(result).startswith("<TuningResult abs(last(plant.y) - 0.5): ")
    assert result.statements[0].startswith("COBYQA converged")


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("rms(a.y - b.y)", True),
        (" rms(a.y, t > 5) ", True),
        ("rms(a.y) + rms(b.y)", False),
        ("(rms(a.y)) * (2)", False),
        ("2 * rms(a.y)", False),
        ("max(a.y)", False),
        ("rms(", False),
    ],
)
def test_an_rms_is_told_from_what_has_one_in_it(expression, expected):
    assert is_rms(expression) is expected


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
    assert any(text.endswith("do not trust delta") for text in result.warnings)
    assert set(result.warnings) <= set(result.statements)
