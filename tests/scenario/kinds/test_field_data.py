"""A file of samples in the place of the plant: estimates at the bound for the samples there are."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter
from scipy.stats import chi2

import cosim
from cosim.errors import ScenarioError
from cosim.log import open_log
from cosim.scenario.record import IDENTIFICATION, recorded_identification, recorded_warnings
from cosim.scenario.running.identifying import identifier_record
from cosim.theory.plants.descriptor import reduce
from tests.scenario.refusals import check_refused
from tests.theory.academic import THETA, academic, alpha

STOP = 40.0
MILLIMETERS = {"plant.unit": {"y": "mm"}, "observer.unit": {"y": "m"}}
HALVED = {"connections.observer.y": {"from": "plant.y", "gain": 0.5}}
STEP = 1e-2
SIGMA = 2e-2
JITTER = 1e-4
# theta, the amplitudes, x(0): what is not known of the example
TRUTH = np.array([*THETA, 1.0, 1.0, 1.0, -1.0])


def outputs_at(t, unknowns):
    """Solve the example for m values of the unknowns, shape (6, m); return y, shape (N, m)."""
    reduced = reduce(academic())
    m = unknowns.shape[1]

    def rate(t, x):
        exponentials = np.exp(unknowns[:2] * t) * unknowns[2:4]
        forced = np.outer(reduced.B_2a[:, 0], alpha(np.array(t)) @ exponentials)
        forced += np.outer(reduced.B_1a[:, 0], np.full(m, np.sin(t)))
        return (reduced.A_a @ x.reshape(2, m) + forced).ravel()

    solution = solve_ivp(
        rate, (0.0, t[-1]), unknowns[4:].ravel(), method="DOP853", rtol=1e-12, atol=1e-12, t_eval=t
    )
    x = solution.y.reshape(2, m, len(t))
    return (np.tensordot(reduced.C3[0], x, axes=1) + reduced.C4[0, 0] * np.sin(t)).T


def written(folder, t, y, *, header="t,y", form="{!r},{!r}"):
    """Write samples as a CSV file; return its path."""
    path = folder / "field.csv"
    lines = [form.format(*row) for row in zip(t.tolist(), y.tolist(), strict=True)]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def check_identifiable(log):
    """Check that verdicts have the truth in their intervals; return them."""
    parameters = log.results[IDENTIFICATION]["identifier"]["parameters"]
    for parameter, true in zip(parameters, THETA, strict=True):
        assert parameter["verdict"] == "IDENTIFIABLE"
        assert parameter["lower"] <= true <= parameter["upper"]
    return parameters


class Experiment:
    """Samples with jitter, 1 % of them lost, and the Cramer-Rao bound for those that are there."""

    def __init__(self, step, sigma):
        rng = np.random.default_rng(11)
        t = np.arange(round(STOP / step) + 1) * step
        t = t + rng.uniform(-JITTER, JITTER, len(t))
        kept = rng.random(len(t)) >= 0.01
        kept[[0, -1]] = True
        self.t = t[kept]
        self.t[0] = 0.0
        self.t[-1] = STOP
        h = 1e-5
        nearby = TRUTH[:, np.newaxis] + h * np.hstack([np.zeros((6, 1)), np.eye(6), -np.eye(6)])
        y = outputs_at(self.t, nearby)
        self.y = y[:, 0]
        self.sigma = sigma
        jacobian = (y[:, 1:7] - y[:, 7:]) / (2.0 * h)
        # an estimate rests on the samples before the last step
        jacobian = jacobian[self.t <= STOP - step]
        self.covariance = sigma**2 * np.linalg.inv(jacobian.T @ jacobian)[:2, :2]
        changes = {"scenario.step": step, "observer.filter_rate": 50.0, "identifier.period": STOP}
        self.scenario = cosim.load("academic").set(changes)

    def measured(self, seed):
        noise = np.random.default_rng(seed).standard_normal(len(self.t))
        return self.y + self.sigma * noise

    def written(self, folder, y, *, scale=1.0, **form):
        return written(folder, self.t, scale * y, **form)

    def run(self, path, changes=None, **options):
        swapped = self.scenario.swap(plant=path)
        return cosim.run(swapped.set(changes or {}), **options)


@pytest.fixture(scope="module")
def experiment():
    return Experiment(STEP, SIGMA)


@pytest.fixture(scope="module")
def plain(experiment, tmp_path_factory):
    """Return a run of the samples of seed 0, in the plainest form of a file, without verdicts."""
    folder = tmp_path_factory.mktemp("plain")
    path = experiment.written(folder, experiment.measured(0))
    return experiment.run(path, {"scenario.verdicts": False})


def error_of(log):
    return log["identifier.theta"][-1] - THETA


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "sigma", "seeds"),
    [(STEP, SIGMA, 6), pytest.param(1e-3, 1e-3, 200, marks=pytest.mark.campaign)],
)
@pytest.mark.usefixtures("without_verdicts")
def test_estimates_reach_the_bound_for_the_samples_that_are_there(step, sigma, seeds, tmp_path):
    """The errors over seeds, in units of the bound, are as chi-square says, up to 1.15."""
    experiment = Experiment(step, sigma)
    total = 0.0
    for seed in range(seeds):
        log = experiment.run(experiment.written(tmp_path, experiment.measured(seed)))
        error = error_of(log)
        total += error @ np.linalg.inv(experiment.covariance) @ error
        deviations = np.sqrt(np.diag(experiment.covariance))
        # that of the noise is known to 1.1 % from 4000 samples; the bound is that at the estimate
        np.testing.assert_allclose(log["identifier.standard_error"][-1], deviations, rtol=0.08)
    # a run at 1.15 times the bound exceeds this once in a thousand cases
    assert total < 1.15**2 * chi2.isf(1e-3, 2 * seeds)
    assert total > 0.85**2 * chi2.isf(1 - 1e-3, 2 * seeds)


def test_the_verdict_knows_the_inputs_between_the_samples(experiment, tmp_path):
    """Of one sample in 20 the verdict has the estimate of the run, and the truth in its interval.

    Straight lines from sample to sample, of u and alpha, would move theta by far more.
    """
    sparse = np.append(np.arange(0, len(experiment.t) - 1, 20), len(experiment.t) - 1)
    path = written(tmp_path, experiment.t[sparse], experiment.y[sparse])
    log = experiment.run(path, {"plant.maximum_gap": 1.0})
    parameters = check_identifiable(log)
    assert all(parameter["upper"] - parameter["lower"] < 1e-4 for parameter in parameters)
    values = [parameter["value"] for parameter in parameters]
    np.testing.assert_allclose(values, log["identifier.theta"][-1], atol=1e-6)


@pytest.mark.slow
def test_the_verdict_does_not_depend_on_the_last_bit_of_a_time_stamp(tmp_path):
    """Colored noise is that of 1001 samples, though many of the stamps are no points."""
    t = np.arange(1001) * 0.02
    assert (t != np.arange(1001) / 50).sum() > 50
    white = np.random.default_rng(1).standard_normal(1001)
    y = outputs_at(t, TRUTH[:, np.newaxis])[:, 0] + 1e-3 * lfilter([1.0], [1.0, -0.8], white)
    changes = {"scenario.step": 0.02, "scenario.stop": 20.0, "identifier.period": 20.0}
    changes["observer.filter_rate"] = 50.0
    log = cosim.run(cosim.load("academic").set(changes).swap(plant=written(tmp_path, t, y)))
    assert len(log["plant.y_samples"].shape) == 1  # one place for samples in a step
    assert identifier_record(log).data.t.tolist() == (np.arange(1001) / 50).tolist()
    check_identifiable(log)


@pytest.mark.usefixtures("without_verdicts")
def test_the_samples_reach_the_identifier_as_they_are(experiment, tmp_path):
    """Each with its own time; only y at the communication points is on straight lines, or held."""
    t = experiment.t
    y = experiment.measured(3)
    log = experiment.run(experiment.written(tmp_path, y))
    np.testing.assert_allclose(log["plant.y"], np.interp(log.time("plant.y"), t, y), atol=1e-12)
    times = log["plant.sample_times"]
    samples = log["plant.y_samples"]
    is_there = np.isfinite(times)
    np.testing.assert_array_equal(times[is_there], t)
    np.testing.assert_array_equal(samples[is_there], y)
    every = slice(None, None, len(times) - 1)  # the rows that the log keeps of the identifier
    np.testing.assert_array_equal(log["identifier.samples"], samples[every])
    np.testing.assert_array_equal(log["identifier.sample_times"], times[every])
    held = experiment.run(tmp_path / "field.csv", {"plant.interpolation": "zero-order"})
    last = np.searchsorted(t, held.time("plant.y"), side="right") - 1
    np.testing.assert_array_equal(held["plant.y"], y[last])
    np.testing.assert_array_equal(held["plant.y_samples"], samples)


@pytest.mark.slow
@pytest.mark.usefixtures("without_verdicts")
def test_a_log_replays_without_the_file(experiment, tmp_path):
    """Bit for bit: the samples are signals, and nothing else of the file is needed."""
    path = experiment.written(tmp_path, experiment.measured(4))
    out = tmp_path / "run.mcap"
    log = experiment.run(path, out=out)
    path.unlink()
    again = cosim.replay(out, out=tmp_path / "again.mcap")
    for signal in log:
        assert log[signal].tobytes() == again[signal].tobytes(), signal
    other = cosim.replay(out, set={"identifier.window": 30.0})
    assert not np.array_equal(other["identifier.theta"][-1], log["identifier.theta"][-1])
    assert open_log(out).steps == round(STOP / STEP)


@pytest.mark.parametrize(
    ("form", "names", "changes"),
    [
        ({"header": "t,x[0],x[1]", "form": "{0!r},0,{1!r}"}, {"observer.y": "x[1]"}, {}),
        ({"header": "t,level", "scale": 1e3}, {"plant.y": "level"}, MILLIMETERS),
        ({"scale": 2.0}, {}, HALVED),
    ],
)
@pytest.mark.usefixtures("without_verdicts")
def test_maps_units_and_gains_of_y_are_those_of_its_samples(
    experiment, plain, tmp_path, form, names, changes
):
    """An element of another name, a unit that the file has not, a gain of the connection."""
    path = experiment.written(tmp_path, experiment.measured(0), **form)
    log = cosim.run(experiment.scenario.swap(plant=path, map=names).set(changes))
    theta = plain["identifier.theta"][-1]
    np.testing.assert_allclose(log["identifier.theta"][-1], theta, rtol=1e-6)


@pytest.mark.slow
def test_data_that_differ_from_the_model_are_warned_of(experiment, tmp_path):
    """Signals that the file lacks, connections that have no effect, and the units."""
    path = experiment.written(tmp_path, experiment.y, header="t,y [mm]")
    log = experiment.run(path, out=tmp_path / "run.mcap")
    warnings = "\n".join(text for _, text in recorded_warnings(log))
    for text in (
        "has no 'plant.x_a': the report leaves out 'observer.x_a'",
        "has no inputs: the connections to u, delta are left out, and what [truth] compares with",
        "kind field-data (was model exchange)",
        "units that cannot be compared with what is connected: y unit mm",
    ):
        assert text in warnings
    assert "samples causality" not in warnings


def test_times_in_another_unit_are_suspected(experiment, tmp_path):
    """In ms without a unit two samples are left of 4000: no error, and a number neither."""
    path = experiment.written(tmp_path, experiment.y, form="{:.9f}e3,{!r}")
    changes = {"scenario.stop": 15.0, "identifier.period": 1.0}
    log = experiment.run(path, changes, out=tmp_path / "run.mcap")
    warnings = "\n".join(text for _, text in recorded_warnings(log))
    assert "2 of 3" in warnings
    assert "samples are within the run, 0 s to 15 s, as their median distance is 10" in warnings
    assert "are the times in another unit than s?" in warnings
    assert recorded_identification(log)["identifier"].problem


HALF = {
    "components.half": {"kind": "gain", "K": 1.0},
    "connections.half.u": "plant.y",
    "connections.observer.y": "half.y",
}
INTERPOLATED = "y is interpolated between the samples of 'plant'"
WRONG_OPTIONS = [
    ({"scenario.stop": 41.0}, "0.0 s to 41.0 s"),
    ({"plant.offset": 1.0}, "start_time = 0.0 and stop = 39.0 of [scenario] are inside"),
    ({"plant.maximum_gap": 1e-3}, "maximum_gap = 0.001 s"),
    ({"plant.time_unit": "ms"}, "from 0.0 s to 40.0 s, got 0.0 s to 0.04 s"),
    ({"plant.columns": {"y": "level"}}, "has no column 'level'"),
    ({"plant.columns": {"level": "y"}}, "'plant' has no output 'y'"),
    ({"connections.observer.y": {"from": "plant.y", "gain": [[1.0]]}}, INTERPOLATED),
    ({"connections.observer.y": "plant.y[0]"}, INTERPOLATED),
    (HALF, INTERPOLATED),
    ({"plant.kind": "field"}, "unknown kind 'field'; did you mean 'field-data'?"),
]


def test_wrong_options_are_refused(experiment, tmp_path):
    """Before the run, with the way out, in one line."""
    path = experiment.written(tmp_path, experiment.y)

    def refuse(changes):
        experiment.run(path, changes)

    cases = [(changes, re.escape(text)) for changes, text in WRONG_OPTIONS]
    check_refused(cases, refuse, ScenarioError)
    # it is no problem of the identifier, which asks how many samples there are
    with pytest.raises(ScenarioError, match=r"\A.*plant.*cannot be read.*\Z"):
        experiment.run(tmp_path / "missing.csv")


def test_too_many_samples_in_a_step_are_refused(experiment, tmp_path):
    """Every one of them has a place in the log, so there is a limit."""
    t = np.array([0.0, *(2.0 + 1e-6 * np.arange(1500)), *np.arange(2.1, 41.0, 0.1)])
    path = written(tmp_path, t, 0.0 * t)
    with pytest.raises(ScenarioError, match=r"at most 1000 .*1499 .*4000"):
        experiment.run(path, {"plant.maximum_gap": 3.0})


@pytest.mark.slow
def test_the_verdict_and_the_log_rest_on_the_samples(experiment, tmp_path):
    """Good data are identifiable; a later fit of the log is that of the run, gain applied."""
    out = tmp_path / "run.mcap"
    path = experiment.written(tmp_path, experiment.measured(6), scale=2.0)
    experiment.run(path, HALVED, out=out)
    log = open_log(out)
    recorded = dict(log.results[IDENTIFICATION]["identifier"])
    assert [one["verdict"] for one in recorded["parameters"]] == 2 * ["IDENTIFIABLE"]
    record = identifier_record(log)
    of_the_log = cosim.identify(log).assessment.to_dict()
    assert of_the_log == {key: recorded[key] for key in of_the_log}
    np.testing.assert_array_equal(record.data.t[record.data.measured[:, 0]], experiment.t)


@pytest.mark.usefixtures("without_verdicts")
def test_estimates_come_online_before_the_regression_has_values(experiment, tmp_path):
    """The grid of starts takes the samples too; what is said there is true."""
    path = experiment.written(tmp_path, experiment.measured(1))
    log = experiment.run(path, {"identifier.period": 0.5, "scenario.stop": 8.0})
    theta = log["identifier.theta"]
    error = log["identifier.standard_error"]
    first = int(np.isfinite(theta).all(axis=1).argmax())
    assert 0.0 < log.time("identifier.theta")[first] < 6.4  # T_id is 6.46 s at filter_rate 1e3
    assert (np.abs(theta[first:] - THETA) < 5.0 * error[first:]).all()
