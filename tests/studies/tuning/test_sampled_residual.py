"""The residual at the samples is what was measured there, whatever the rows make of it."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import cosim
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.tuning.sampled_residual import SampledResidual, open_residual_runner

RATE = 1.5


def written(folder, t, y, components="", connections=""):
    """Write a scenario of 10 s with a recording, and return its path."""
    rows = zip(t.tolist(), y.tolist(), strict=True)
    lines = ["t,y", *(f"{time!r},{value!r}" for time, value in rows)]
    (folder / "measured.csv").write_text("\n".join(lines))
    path = folder / "fit.toml"
    path.write_text(
        f"""
scenario = {{ name = "fit", stop = 10.0, step = 0.01 }}
[components]
u = {{ kind = "sine", rate = {RATE} }}
f = {{ kind = "lag", time_constant = 0.8, initial = 0.4 }}
g = {{ kind = "gain", K = [[1.3]] }}
measured = {{ kind = "field-data", path = "measured.csv" }}
{components}
[connections]
"f.u" = "u.y"
"g.u" = "f.y"
{connections}
"""
    )
    return path


def response(t, time_constant=0.8, gain=1.3):
    """Return g.y, in closed form."""
    a = 1.0 / time_constant
    size = a / (a * a + RATE * RATE)
    forced = size * (a * np.sin(RATE * t) - RATE * np.cos(RATE * t))
    return gain * (forced + (0.4 + size * RATE) * np.exp(-a * t))


def instants(spacing, offset):
    """Return instants of samples from 0 s to at least 10 s."""
    later = np.arange(1, int(10.0 / spacing) + 3) * spacing - offset
    return np.round(np.concatenate([[0.0], later]), 6)


def residual_of(path, metric):
    """Return the residual of the scenario as it stands."""
    with open_residual_runner(StudySubject(str(path), metrics={"objective": metric})) as runner:
        outcome = runner.run(StudyMember(0))
    assert outcome.status == "complete", outcome.reason
    return SampledResidual.of_metrics(outcome.metrics)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spacing", "offset"), [(0.037, 0.0), (0.04, 0.005), (0.02, 0.005), (0.035, 0.0)]
)
def test_standard_errors_are_those_of_regression_on_the_samples(tmp_path, spacing, offset):
    """Gauss-Newton on the samples, in closed form, has them; lines cost less than 3 % of them."""
    t = instants(spacing, offset)
    y = response(t) + 0.02 * np.random.default_rng(1).standard_normal(t.size)
    own = t <= 10.0
    fit = least_squares(lambda p: response(t[own], *p) - y[own], (1.0, 1.0))
    variance = fit.fun @ fit.fun / (own.sum() - 2)
    expected = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)) * variance)
    result = cosim.tune(
        written(tmp_path, t, y),
        minimize="rms(g.y - measured.y)",
        vary={"f.time_constant": {"log": [0.2, 3.0]}, "g.K[0][0]": {"log": [0.3, 3.0]}},
        members=60,
        starts=1,
        workers=1,
        standard_errors=True,
    )
    assert list(result.standard_errors.values()) == pytest.approx(expected, rel=0.1)
    assert (result.residual.rows, result.residual.samples) == (1001, own.sum())


def test_the_residual_of_samples_between_the_rows_is_what_was_measured(tmp_path):
    """Straight lines between the rows of the model are off by h^2 y''/8 = 5e-5."""
    t = instants(0.037, 0.0)
    noise = 0.02 * np.random.default_rng(1).standard_normal(t.size)
    found = residual_of(written(tmp_path, t, response(t) + noise), "rms(g.y - measured.y)")
    own = t <= 10.0
    assert found.problem == ""
    assert not found.are_rows
    assert found.t == pytest.approx(t[own], abs=1e-12)
    assert found.samples == pytest.approx(-noise[own], abs=1e-4)


def test_samples_at_all_rows_are_the_rows(tmp_path):
    t = np.round(np.arange(1001) * 0.01, 6)
    noise = 0.02 * np.random.default_rng(1).standard_normal(t.size)
    path = written(tmp_path, t, response(t) + noise)
    found = residual_of(path, "rms(g.y - measured.y)")
    assert found.are_rows
    assert found.rms == np.sqrt(np.mean(found.samples**2))
    assert found.samples == pytest.approx(-noise, abs=1e-4)


def test_only_samples_on_which_rows_rest_count(tmp_path):
    t = np.round(np.arange(501) * 0.02, 6)
    found = residual_of(written(tmp_path, t, response(t)), "rms(g.y - measured.y, t > 5)")
    assert (found.rows, found.t[0], found.t[-1]) == (500, 5.0, 10.0)


SENSORS = {
    "held": "period = 0.05",
    "with losses": "dropout = 0.3",
    "late and held": "period = 0.05, delay = 0.013, time_stamps = true",
}


@pytest.mark.parametrize("name", SENSORS)
def test_samples_of_sensors_count_where_they_arrive(tmp_path, name):
    """Beside a model at all rows; its residual there is that of the row."""
    t = np.array([0.0, 10.0])
    sensor = f's = {{ kind = "sensor", noise = 0.02, seed = 1, {SENSORS[name]} }}'
    path = written(tmp_path, t, 0.0 * t, sensor, '"s.u" = "g.y"')
    found = residual_of(path, "rms(g.y - s.y)")
    log = cosim.run(path)
    samples = log["s.y_samples"]
    rows = np.flatnonzero(np.isfinite(samples))
    step = len(log["g.y"]) // (len(samples) - 1)
    assert found.problem == ""
    assert found.t == pytest.approx(rows * step * 0.01)
    assert found.samples == pytest.approx(log["g.y"][rows * step] - samples[rows], abs=1e-12)


def test_held_samples_count_where_they_arrive(tmp_path):
    """They are between the rows, which have the last of them."""
    t = instants(0.037, 0.0)
    path = written(tmp_path, t, response(t))
    text = path.read_text().replace('csv" }', 'csv", interpolation = "zero-order" }')
    path.write_text(text)
    found = residual_of(path, "rms(g.y - measured.y)")
    first = np.ceil(np.round(t[t <= 10.0] * 100.0, 6)) / 100.0
    assert found.problem == ""
    assert found.t == pytest.approx(first)


def test_rows_of_samples_that_are_not_in_the_run_are_a_problem(tmp_path):
    """Of a table, and where another component is between a recording and the residual."""
    t = instants(0.037, 0.0)
    components = """
reference = { kind = "table", t = [0.0, 5.005, 10.0], y = [0.0, 1.0, 0.0] }
scaled = { kind = "gain", K = [[2.0]] }
"""
    path = written(tmp_path, t, response(t), components, '"scaled.u" = "measured.y"')
    assert "'reference' is a table" in residual_of(path, "rms(g.y - reference.y)").problem
    assert "measured.y" in residual_of(path, "rms(2 * g.y - scaled.y)").problem
    on_points = np.round(np.arange(1001) * 0.01, 6)
    path = written(
        tmp_path, on_points, response(on_points), components, '"scaled.u" = "measured.y"'
    )
    found = residual_of(path, "rms(2 * g.y - scaled.y)")
    assert found.are_rows
    assert found.problem == ""
