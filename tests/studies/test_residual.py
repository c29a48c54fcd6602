"""The residual is what was measured at its samples; what is said of its noise is right."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import interp1d
from scipy.optimize import least_squares
from scipy.signal import lfilter

import cosim
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.residual import (
    Lines,
    ResidualCheck,
    SampledResidual,
    check_residual,
    residual_at,
    residual_of,
)
from cosim.studies.standard_errors import moved_points
from cosim.studies.tuning_result import with_residual
from tests.studies.test_standard_errors import DECAY, LINE, T, decay, fitted, line

RATE = 1.5
ROWS = 500


def white(seed, rows=T.size):
    return np.random.default_rng(seed).standard_normal(rows)


def written(folder, t, y, components="", connections="", options=""):
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
measured = {{ kind = "field-data", path = "measured.csv"{options} }}
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


def instants(spacing, offset=0.0):
    """Return instants of samples from 0 s to at least 10 s."""
    later = np.arange(1, int(10.0 / spacing) + 3) * spacing - offset
    return np.round(np.concatenate([[0.0], later]), 6)


def residual(path, metric="rms(g.y - measured.y)"):
    """Return the residual of the scenario as it stands."""
    return residual_of(StudySubject(str(path), metrics={"objective": metric}), StudyMember(0))


@pytest.mark.slow
@pytest.mark.parametrize(("spacing", "offset"), [(0.037, 0.0), (0.02, 0.005)])
def test_standard_errors_are_those_of_regression_on_the_samples(tmp_path, spacing, offset):
    """Gauss-Newton on the samples, in closed form, has them; lines cost less than 3 % of them.

    An offset of the recording leaves no interval.
    """
    t = instants(spacing, offset)
    y = response(t) + 0.02 * white(1, t.size)
    own = t <= 10.0
    fit = least_squares(lambda p: response(t[own], *p) - y[own], (1.0, 1.0))
    variance = fit.fun @ fit.fun / (own.sum() - 2)
    expected = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)) * variance)
    options = {"minimize": "rms(g.y - measured.y)", "standard_errors": True, "starts": 1}
    vary = {"f.time_constant": {"log": [0.2, 3.0]}, "g.K[0][0]": {"log": [0.3, 3.0]}}
    path = written(tmp_path, t, y)
    result = cosim.tune(path, **options, vary=vary, members=60, workers=1)
    assert list(result.standard_errors.values()) == pytest.approx(expected, rel=0.1)
    assert (result.residual.rows, result.residual.samples) == (1001, own.sum())
    written(tmp_path, t, y + 0.1)
    result = cosim.tune(path, **options, vary=vary, members=60, workers=1)
    assert result.standard_errors is None
    assert "noise does not explain the residual" in result.errors_problem


def test_the_residual_of_samples_between_the_rows_is_what_was_measured(tmp_path):
    """Straight lines between the rows of the model are off by h^2 y''/8 = 5e-5."""
    t = instants(0.037)
    noise = 0.02 * white(1, t.size)
    path = written(tmp_path, t, response(t) + noise)
    found = residual(path)
    own = t <= 10.0
    assert found.problem == ""
    assert found.t == pytest.approx(t[own], abs=1e-12)
    assert found.samples == pytest.approx(-noise[own], abs=1e-4)
    subject = StudySubject(str(path), metrics={"objective": "rms(g.y - measured.y)"})
    moved = [StudyMember(0), StudyMember(1, {"g.K[0][0]": 1.4})]
    checked, differences = residual_at(subject, moved)
    assert (checked.rows, checked.samples) == (1001, own.sum())
    # W' of lines that average 1 counts the rows beside each sample
    expected = np.interp(found.t, t, response(t, gain=0.1))[1:-1] * 3.7
    assert differences[1:-1, 0] == pytest.approx(expected, abs=0.06)
    assert residual_at(subject, [StudyMember(0, {"g.K[0][0]": "x"})]) == (None, None)


def test_only_samples_on_which_rows_rest_count(tmp_path):
    """Samples at all rows are the rows, of which W is 1."""
    t = np.round(np.arange(1001) * 0.01, 6)
    noise = 0.02 * white(1, t.size)
    found = residual(written(tmp_path, t, response(t) + noise))
    assert found.weighed is None
    assert found.rms == np.sqrt(np.mean(found.samples**2))
    assert found.samples == pytest.approx(-noise, abs=1e-4)
    t = t[::2]
    found = residual(written(tmp_path, t, response(t)), "rms(g.y - measured.y, t > 5)")
    assert (found.rows, found.t[0], found.t[-1]) == (500, 5.0, 10.0)


@pytest.mark.parametrize(
    "options", ["dropout = 0.3", "period = 0.05, delay = 0.013, time_stamps = true"]
)
def test_samples_of_sensors_count_where_they_arrive(tmp_path, options):
    """Beside a model at all rows; its residual there is that of the row."""
    t = np.array([0.0, 10.0])
    sensor = f's = {{ kind = "sensor", noise = 0.02, seed = 1, {options} }}'
    path = written(tmp_path, t, 0.0 * t, sensor, '"s.u" = "g.y"')
    found = residual(path, "rms(g.y - s.y)")
    log = cosim.run(path)
    samples = log["s.y_samples"]
    rows = np.flatnonzero(np.isfinite(samples))
    step = len(log["g.y"]) // (len(samples) - 1)
    assert found.problem == ""
    assert found.t == pytest.approx(rows * step * 0.01)
    assert found.samples == pytest.approx(log["g.y"][rows * step] - samples[rows], abs=1e-12)


def test_held_samples_count_where_they_arrive(tmp_path):
    """They are between the rows, which have the last of them."""
    t = instants(0.037)
    hold = ', interpolation = "zero-order"'
    found = residual(written(tmp_path, t, response(t), options=hold))
    assert found.problem == ""
    assert found.t == pytest.approx(np.ceil(np.round(t[t <= 10.0] * 100.0, 6)) / 100.0)


def test_rows_of_samples_that_are_not_in_the_run_are_a_problem(tmp_path):
    """Of a table, and where another component is between a recording and the residual."""
    components = """
reference = { kind = "table", t = [0.0, 5.005, 10.0], y = [0.0, 1.0, 0.0] }
scaled = { kind = "gain", K = [[2.0]] }
"""
    for t, problem in ((instants(0.037), "measured.y"), (np.arange(1001) * 0.01, "")):
        t = np.round(t, 6)
        path = written(tmp_path, t, response(t), components, '"scaled.u" = "measured.y"')
        assert "'reference' is a table" in residual(path, "rms(g.y - reference.y)").problem
        found = residual(path, "rms(2 * g.y - scaled.y)")
        assert (problem in found.problem, bool(found.problem)) == (True, bool(problem))


# --- its noise ---


def checked(values, problem=""):
    largest = np.abs(values).max()
    rms = float(np.sqrt(np.mean((values / largest) ** 2)) * largest)
    t = np.arange(values.size) * 0.01
    return check_residual(SampledResidual(values.size, rms, t, values, problem=problem))


def test_white_noise_of_any_size_is_what_noise_leaves():
    """The three tests of identification fail once in a thousand residuals."""
    for seed in range(8):
        for size in (1.0, 1e-200):
            found = checked(size * white(seed, ROWS))
            assert (found.problem, found.independent) == ("", ROWS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [
        white(1, ROWS) + 0.4,
        white(1, ROWS) + np.linspace(-0.8, 0.8, ROWS),
        lfilter([1.0], [1.0, -0.9], white(1, ROWS)),
    ],
)
def test_what_a_wrong_model_would_leave_is_a_problem(values):
    """An offset, a trend, a memory that is long for the record."""
    assert checked(values).problem.startswith("noise does not explain the residual: ")


def test_independent_samples_are_those_of_the_closed_form():
    """Of AR(1) the share is (1 - a)/(1 + a), which is known to 4 times 2 (1 - a^2)^-1/2 N^-1/2.

    AR(1) of 0.4 in 251 samples is what the tests of all lags refuse or call white.
    """
    found = checked(lfilter([1.0], [1.0, -0.5], white(1, 4000)))
    assert found.problem == ""
    assert found.independent == pytest.approx(4000 / 3.0, rel=0.15)
    short = [checked(lfilter([1.0], [1.0, -0.4], white(seed, 251))) for seed in range(12)]
    shares = [one.independent / 251 for one in short if not one.problem]
    assert len(shares) > 4
    assert np.median(shares) == pytest.approx(0.6 / 1.4, rel=0.3)


def test_rows_between_samples_do_not_count():
    """Of straight lines between samples the rms is smaller, by 2/3 of the variance for many."""
    noise = white(1, ROWS)
    t = np.arange(ROWS) * 0.05
    whole = SampledResidual(5 * (ROWS - 1) + 1, np.sqrt(2.0 / 3.0), t, noise, noise)
    found = check_residual(whole)
    assert (found.rows, found.samples, found.independent) == (2496, ROWS, ROWS)
    assert found.neighbours == pytest.approx(noise[1:] @ noise[:-1] / (noise @ noise), rel=1e-9)
    assert found.ratio == pytest.approx(np.sqrt(1.5 * np.mean(noise**2)), rel=1e-9)
    few = check_residual(SampledResidual(21, 1.0, t[:5], noise[:5], noise[:5]))
    assert few.problem.startswith("5 samples are too few")
    assert checked(white(1, 9)) is None
    for value in (0.0, np.inf):
        same = np.full(20, value)
        assert check_residual(SampledResidual(20, value, same, same)) is None


@pytest.mark.parametrize(("spacing", "offset"), [(37, 0), (40, 5), (7, 0)])
@pytest.mark.parametrize("hold", [False, True])
def test_errors_of_values_between_samples_are_those_of_what_the_rows_rest_on(spacing, offset, hold):
    """With y = X p + W e the covariance of least squares is s^2 (X'X)^-1 X'W W'X (X'X)^-1.

    The step is 5 ms; spacing and offset of the samples are in ms.
    """
    knots = np.arange(-offset, 1000 + spacing, spacing) / 1000.0
    knots[0] = 0.0
    lines = Lines(knots, T, hold=hold)
    kind = "previous" if hold else "linear"
    W = interp1d(knots, np.eye(knots.size), kind=kind, axis=0)(T)
    noise = 0.1 * white(2, knots.size)
    assert lines.of(noise) == pytest.approx(W @ noise, abs=1e-9)
    assert lines.back(T) == pytest.approx(W.T @ T, abs=1e-9)
    X = np.stack([T, np.ones(T.size)], axis=1)
    C = np.linalg.inv(X.T @ X)
    measured = line(T, 3.0, -2.0) + W @ noise
    result = fitted(line, LINE, measured)
    best = [*result.estimate.values()]
    at_samples = line(knots, *best) - line(knots, 3.0, -2.0) - noise
    points, units = moved_points(result.errors, result.search, result.best.point)
    moves = [lines.back(X @ list(point.values()) - X @ best) for point in points]
    sampled = SampledResidual(T.size, result.best.objective, knots, at_samples, at_samples)
    moved = np.stack(moves, axis=1) / units
    result = with_residual(result, check_residual(sampled), moved, None)
    s = np.sqrt(at_samples @ at_samples / (knots.size - 2))
    expected = s * np.sqrt(np.diag(C @ X.T @ W @ W.T @ X @ C))
    assert list(result.standard_errors.values()) == pytest.approx(expected, rel=0.01)


def found_for(residual, samples=None):
    """Return the fit of a decay with a residual of these properties, and what that leaves of it."""
    result = fitted(decay, DECAY, decay(T, 2.0, 3.0) + 0.02 * white(1))
    of_all = ResidualCheck(T.size, T.size, 1.0, 0.1, "", T.size, np.inf)
    return result, with_residual(result, replace(of_all, **residual), None, samples)


def test_white_samples_leave_the_errors_as_they_are():
    before, result = found_for({})
    assert result.errors == before.errors
    assert "201 samples" in result.statements[-1]
    assert "whiteness is not rejected" in result.statements[-1]


def test_fewer_independent_samples_widen_the_errors():
    """By the root of their numbers less two values, and by their deviation.

    A color that is known to 8 degrees of freedom widens the interval.
    """
    before, result = found_for({"rows": 1001, "ratio": 1.2, "independent": 52, "freedom": 8.0})
    ratio = 1.2 * np.sqrt(199.0 / 50.0)
    for key, error in before.errors.errors.items():
        assert result.errors.errors[key] == pytest.approx(ratio * error, rel=1e-9)
    low, high = result.errors.intervals["k"]
    # Student's quantile of 8 degrees
    assert high - low == pytest.approx(2.0 * 2.306 * result.errors.errors["k"], rel=1e-4)
    assert result.errors.samples == 52
    assert "52 of the 201 samples" in result.statements[-1]
    assert "1001 rows" in result.statements[-1]


def test_what_noise_does_not_explain_has_no_errors_unless_samples_are_given():
    for residual in ({"problem": "a constant"}, {"samples": 0, "problem": "a constant"}):
        _, result = found_for(residual)
        assert result.errors is None
        assert "a constant" in result.statements[-1]
        before, result = found_for(residual, samples=201)
        assert result.errors == before.errors
        assert "a constant" in result.statements[-1]
    _, result = found_for({"independent": 2})
    assert "got 2 values from 2 samples" in result.errors_problem
