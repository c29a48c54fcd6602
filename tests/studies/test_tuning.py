"""Tunings of scenarios: found, resumed, refused, verified."""

import json
import shutil

import numpy as np
import pytest
from scipy.optimize import curve_fit

import cosim
from cosim.cli.app import main
from cosim.errors import DatasetError, UsageError
from cosim.studies.dataset import StudyDataset
from cosim.studies.studying import executor_of
from cosim.studies.verifying import verify_study
from tests.fmi.small import able, compiled

LAG = """
scenario = { name = "lag", stop = 2.0, step = 0.01 }
[components]
u = { kind = "constant", value = 1.0 }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
limit = { kind = "limit", lower = 0.2, upper = 0.4 }
pole = { kind = "expression", y = "1 / (0.9 - plant.y)" }
[connections]
"plant.u" = "u.y"
"limit.u" = "u.y"
"""
FIT = """
scenario = { name = "fit", stop = 5.0, step = 0.01 }
[components]
plant = { kind = "fmu", path = "plant.fmu", start = { A = -1.0, B = 1.0, C = 1.0 } }
one = { kind = "constant", value = 1.0 }
measured = { kind = "field-data", path = "measured.csv" }
[connections]
"plant.u" = "one.y"
"""
A, B = -1.6, 2.4
KEY = "plant.time_constant"
GOAL = "abs(last(plant.y) - 0.5)"


@pytest.fixture
def lag(tmp_path):
    """Return a scenario, beside tables that its plant may be swapped for."""
    for name, value in (("low", 0.5), ("high", 0.9)):
        (tmp_path / f"{name}.csv").write_text(f"time,y\n0,{value}\n2,{value}\n")
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return path


def response(t, a, b):
    """Return y of the FMU in closed form."""
    return -b / a * (1.0 - np.exp(a * t))


def write_fit(folder, spacing=0.01):
    """Write fit.toml with an FMU x' = A x + B u, y = x; return its recording with 1 % noise."""
    able(compiled(folder), folder / "plant.fmu", A=-1.0, B=1.0, C=1.0)
    (folder / "fit.toml").write_text(FIT)
    t = np.round(np.arange(0.0, 5.0 + spacing, spacing), 6)
    y = response(t, A, B) + 0.01 * (-B / A) * np.random.default_rng(1).standard_normal(t.size)
    rows = zip(t.tolist(), y.tolist(), strict=True)
    (folder / "measured.csv").write_text("t,y\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows))
    return t, y


def tuned(path, **given):
    """Tune the lag."""
    vary = {KEY: {"log": [0.1, 10.0]}}
    return cosim.tune(path, **{"minimize": GOAL, "vary": vary, "workers": 1, **given})


def rows_of(place, *without):
    """Return the rows of a dataset, perhaps without some columns."""
    return StudyDataset.open(place).read().drop_columns(list(without)).to_pylist()


def test_the_closed_form_is_found(lag):
    """1 - exp(-2 / T) = 0.5 has T = 2 / log 2; the first run is that of the scenario."""
    result = tuned(lag, starts=1)
    assert result.estimate[KEY] == pytest.approx(2.0 / np.log(2.0), rel=1e-4)
    assert result.best_end.converged
    first = result.history[0]
    assert first["values"] == {KEY: 0.7}
    assert first["objective"] == pytest.approx(0.5 - np.exp(-2.0 / 0.7), abs=1e-5)
    assert repr(result).startswith(f"<TuningResult {GOAL}: ")
    outside = {KEY: {"log": [1.0, 4.0]}}  # the middle is tried, then
    assert tuned(lag, vary=outside, members=1).estimate == {KEY: 2.0}


@pytest.mark.slow
@pytest.mark.parametrize(("spacing", "most"), [(0.01, 0.02), (0.037, 0.1)])
def test_two_parameters_of_an_fmu_come_from_a_recording_with_noise(tmp_path, spacing, most):
    """Within three standard errors of the truth; they are those of curve_fit on the samples.

    Rows on lines between samples cost less than 3 % of them.
    """
    t, measured = write_fit(tmp_path, spacing)
    own = t <= 5.0
    solution, covariance = curve_fit(response, t[own], measured[own], p0=[-1.0, 1.0])
    result = cosim.tune(
        tmp_path / "fit.toml",
        minimize="rms(plant.y - measured.y)",
        vary={"plant.start.A": {"linear": [-10.0, -0.1]}, "plant.start.B": {"log": [0.1, 10.0]}},
        standard_errors=True,
        starts=1,
        members=100,
        workers=1,
    )
    found = np.array(list(result.estimate.values()))
    errors = np.array(list(result.standard_errors.values()))
    expected = np.sqrt(np.diag(covariance))
    assert errors == pytest.approx(expected, rel=most)
    assert (np.abs(found - [A, B]) <= 3.0 * errors).all()
    assert (np.abs(found - solution) <= 5.0 * most * expected).all()
    residual = response(t, *found)[own] - measured[own]
    neighbours = residual[1:] @ residual[:-1] / (residual @ residual)
    assert result.residual.neighbours == pytest.approx(neighbours, abs=1e-3)
    assert (result.residual.rows, result.errors.samples) == (501, own.sum())


@pytest.mark.slow
def test_a_tuning_that_was_killed_goes_on_and_one_that_is_whole_runs_nothing(lag, tmp_path):
    """Its dataset is the same, row for row and bit for bit, but for times and workers."""
    killed, place = tmp_path / "killed", tmp_path / "whole"

    def kill(done, *_):
        if done == 17:  # what is on the disk then; of 30 members 15 are for the errors
            shutil.copytree(place, killed)

    given = {"minimize": "rms(plant.y - 0.5)", "standard_errors": True, "members": 30}
    whole = tuned(lag, **given, out=place, progress=kill)
    rows = rows_of(place)
    assert len(rows_of(killed)) == 17
    assert tuned(lag, **given, out=killed).to_dict() == whole.to_dict()
    own = ("wall_time", "worker")
    assert rows_of(killed, *own) == rows_of(place, *own)
    assert tuned(lag, **given, out=place) == whole
    assert rows_of(place) == rows
    assert [row[KEY] for row in rows] == [trial.point[KEY] for trial in whole.trials]


def test_the_dataset_is_shown_by_its_best_members(lag, tmp_path, capsys):
    """No statistics are told of values that a search chose."""
    result = tuned(lag, members=12, out=tmp_path / "d")
    for option in ("--worst=2", "--json"):
        with pytest.raises(SystemExit, match=r"^0$"):
            main(["study", "show", str(tmp_path / "d"), option])
    lines, _, content = capsys.readouterr().out.partition("{")
    assert f"member {result.best.number} alone: {result.command}" in lines
    shown = json.loads("{" + content)
    assert shown["best"][0]["values"] == result.estimate
    assert shown["search"]["maximize"] is False
    assert "statistics" not in shown


@pytest.mark.slow
def test_swapped_models_are_searched_with_optuna_and_verified(lag, tmp_path):
    """The recording that ends at a half is the best, without any trial of a third one.

    Of a member that failed, too, the file must not have changed; nor where a link points to.
    """
    low, high, link = (tmp_path / f"{name}.csv" for name in ("low", "high", "link"))
    link.symlink_to(low)
    place = tmp_path / "d"
    vary = {"plant": [str(high), str(link)]}
    result = tuned(lag, vary=vary, method="optuna", members=9, out=place)
    assert result.estimate == {"swap.plant": str(link)}
    assert (result.best.objective, len(result.history), len(result.failed)) == (0.0, 2, 1)
    assert result.stop_reason == "all combinations of the values were tried"
    assert f"--swap plant={link}" in result.command
    assert verify_study(place).differences == ()
    for path, old, new, what in (
        (low, "0.5", "0.6", r"table \S*low.csv changed"),
        (high, "0.9", "0.8", r"table \S*high.csv changed"),
        (lag, "1.0", "1.1", "key components.u changed"),
    ):
        content = path.read_text()
        path.write_text(content.replace(old, new))
        with pytest.raises(DatasetError, match=what):
            verify_study(place)
        path.write_text(content)
    link.unlink()
    link.symlink_to(high)
    with pytest.raises(DatasetError, match=r"table \S*low.csv is no longer part of it"):
        verify_study(place)


def test_values_that_never_ran_together_are_not_refused(lag, tmp_path):
    """Each of two bounds would be wrong beside some values of the other."""
    vary = {"limit.lower": {"linear": [0.0, 1.0]}, "limit.upper": {"linear": [0.1, 2.0]}}
    result = tuned(lag, minimize="last(limit.y)", vary=vary, members=25, out=tmp_path / "d")
    failed = {trial.number for trial in result.failed}
    chosen = sorted([min(failed), max(set(range(25)) - failed)])
    found = verify_study(tmp_path / "d", members=chosen)
    assert (found.members, found.differences, found.is_searched) == (tuple(chosen), (), True)
    assert found.values == ("status", "steps", "objective")


def test_a_log_is_replayed_by_every_trial(lag, tmp_path):
    """The first one has the value of the run that recorded it."""
    log = tmp_path / "lag.mcap"
    cosim.run(lag, out=log, set={KEY: 1.25})
    result = tuned(log, members=3, starts=1)
    assert result.history[0]["values"] == {KEY: 1.25}
    assert "cosim replay" in result.command


def test_beside_a_cluster_the_first_member_runs_on_this_machine(lag, monkeypatch):
    places = []

    def executor_there(plan, workers, scheduler, notice):
        executor = executor_of(plan, workers, None, notice)
        run = executor.run
        executor.run = lambda members: run(places.append(scheduler) or members)
        return executor

    monkeypatch.setattr("cosim.studies.tuning.executor_of", executor_there)
    tuned(lag, method="global", scheduler="tcp://host:8786", members=11)
    assert places == [None, "tcp://host:8786"]


def test_another_search_does_not_go_on_in_a_dataset(lag, tmp_path):
    given = {"members": 3, "out": tmp_path / "d"}
    tuned(lag, **given)
    for other, what in [
        ({"seed": 2}, "another study: the seed changed; choose"),
        ({"minimize": "last(plant.y)"}, "the objective changed"),
        ({"set": {"scenario.stop": 1.0}}, "key scenario.stop changed"),
    ]:
        with pytest.raises(DatasetError, match=what):
            tuned(lag, **given, **other)
    tuned(lag, **given, seed=2, new=True)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"minimize": "last(plant.z)"}, "minimize: the run has no"),
        ({"minimize": "last(plant.y"}, r"minimize: metric 'last\(plant.y'"),
        ({"vary": {"plant.tim": {"linear": [0.1, 1.0]}}}, "plant.tim = 0.1: unknown key 'tim'"),
        ({"vary": {KEY: {"linear": [-2.0, -1.0]}}}, "plant.time_constant = -"),
        ({"vary": {KEY: {"log": [1.0]}}}, "bounds, such as {'linear'"),
        ({"samples": 0}, "samples: .*got 0"),
        ({"members": 2.5}, "members: .*2.5"),
        ({"replay": ["a.mcap"]}, "replay: .*no file matches "),
        ({"set": {"plant.initial": float("nan")}}, "plant.initial"),
        (
            {"set": {"plant.initial": 0.9}},
            "(?s)the first member fails, .*'pole.y' became inf.* set",
        ),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(lag, tmp_path, given, words):
    """And leaves the dataset that is there."""
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "study.json").write_text("{}")
    with pytest.raises(UsageError, match=words):
        tuned(lag, out=tmp_path / "d", new=True, **given)
    assert [path.name for path in (tmp_path / "d").iterdir()] == ["study.json"]


def test_a_tuning_says_what_its_members_warn_of():
    """In its statements, and in Python as a warning."""
    held = {"scenario.input_interpolation": "zero-order", "observer.filter": "first-order"}
    vary = {"observer.filter_rate": {"linear": [500.0, 900.0]}}
    given = {"minimize": "rms(observer.delta - delta.y)", "set": {"scenario.stop": 0.01, **held}}
    with pytest.warns(cosim.CosimWarning, match="members warn, such as 0: observer: "):
        result = tuned("academic", vary=vary, members=3, **given)
    assert len(result.warnings) > 1
    assert set(result.warnings) <= set(result.statements)
