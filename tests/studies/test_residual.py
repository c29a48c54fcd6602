"""The residual is what was measured at its samples; what is said of its noise is right."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import interp1d
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

ROWS = 500
GRID = np.round(np.arange(1001) * 0.01, 6)  # the rows of a run
BETWEEN = np.round(np.arange(273) * 0.037, 6)  # samples between them
SCENARIO = """
scenario = { name = "fit", stop = 10.0, step = 0.01 }
[components]
u = { kind = "sine", rate = 1.5 }
f = { kind = "lag", time_constant = 0.8, initial = 0.4 }
g = { kind = "gain", K = [[1.3]] }
table = { kind = "table", t = [0.0, 5.005, 10.0], y = [0.0, 1.0, 0.0] }
measured = { kind = "field-data", path = "measured.csv", interpolation = "linear" }
scaled = { kind = "gain", K = [[2.0]] }
sensor = { kind = "sensor", noise = 0.02, seed = 1, period = 0.01 }
[connections]
"f.u" = "u.y"
"g.u" = "f.y"
"scaled.u" = "measured.y"
"sensor.u" = "g.y"
"""


def white(seed, rows=T.size):
    return np.random.default_rng(seed).standard_normal(rows)


def response(t):
    """Return g.y, in closed form."""
    size = 1.25 / (1.25**2 + 1.5**2)
    forced = size * (1.25 * np.sin(1.5 * t) - 1.5 * np.cos(1.5 * t))
    return 1.3 * (forced + (0.4 + size * 1.5) * np.exp(-1.25 * t))


def subject_of(folder, t, noise=0.0, metric="rms(g.y - measured.y)", old="", new=""):
    """Write the scenario with a recording of g.y, a text replaced; return it with a metric."""
    rows = zip(t.tolist(), (response(t) + noise).tolist(), strict=True)
    (folder / "measured.csv").write_text("t,y\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows))
    (folder / "fit.toml").write_text(SCENARIO.replace(old, new))
    return StudySubject(str(folder / "fit.toml"), metrics={"objective": metric})


def residual(*given, **more):
    """Return the residual of the scenario as it stands."""
    return residual_of(subject_of(*given, **more), StudyMember(0))


def test_the_residual_of_samples_between_the_rows_is_what_was_measured(tmp_path):
    """Straight lines between the rows of the model are off by h^2 y''/8 = 5e-5."""
    noise = 0.02 * white(1, BETWEEN.size)
    subject = subject_of(tmp_path, BETWEEN, noise)
    found = residual_of(subject, StudyMember(0))
    own = BETWEEN <= 10.0
    assert found.problem == ""
    assert found.t == pytest.approx(BETWEEN[own], abs=1e-12)
    assert found.samples == pytest.approx(-noise[own], abs=1e-4)
    moved = [StudyMember(0), StudyMember(1, {"g.K[0][0]": 1.4})]
    checked, differences = residual_at(subject, moved)
    assert (checked.rows, checked.samples) == (1001, own.sum())
    # W' of lines that average 1 counts the rows beside each sample
    expected = response(found.t)[1:-1] * 0.1 / 1.3 * 3.7
    assert differences[1:-1, 0] == pytest.approx(expected, abs=0.06)
    assert residual_at(subject, [StudyMember(0, {"g.K[0][0]": "x"})]) == (None, None)


def test_only_samples_on_which_rows_rest_count(tmp_path):
    """Samples at all rows are the rows, of which W is 1; held ones count where they arrive."""
    noise = 0.02 * white(1, GRID.size)
    found = residual(tmp_path, GRID, noise)
    assert found.weighed is None
    assert found.rms == np.sqrt(np.mean(found.samples**2))
    assert found.samples == pytest.approx(-noise, abs=1e-4)
    found = residual(tmp_path, GRID[::2], metric="rms(g.y - measured.y, t > 5)")
    assert (found.rows, found.t[0], found.t[-1]) == (500, 5.0, 10.0)
    found = residual(tmp_path, BETWEEN, old='"linear"', new='"zero-order"')
    assert found.problem == ""
    assert found.t == pytest.approx(np.ceil(np.round(BETWEEN[:271] * 100.0, 6)) / 100.0)


@pytest.mark.parametrize(
    "options", ["period = 0.01, dropout = 0.3", "period = 0.05, delay = 0.013, time_stamps = true"]
)
def test_samples_of_sensors_count_where_they_arrive(tmp_path, options):
    """Beside a model at all rows; its residual there is that of the row."""
    found = residual(tmp_path, GRID, metric="rms(g.y - sensor.y)", old="period = 0.01", new=options)
    log = cosim.run(tmp_path / "fit.toml")
    samples = log["sensor.y_samples"]
    rows = np.flatnonzero(np.isfinite(samples))
    step = len(log["g.y"]) // (len(samples) - 1)
    assert found.problem == ""
    assert found.t == pytest.approx(rows * step * 0.01)
    assert found.samples == pytest.approx(log["g.y"][rows * step] - samples[rows], abs=1e-12)


@pytest.mark.parametrize(
    ("t", "metric", "problem"),
    [
        (GRID, "rms(g.y - table.y)", "'table' is a table, whose samples are not in the run"),
        (BETWEEN, "rms(2 * g.y - scaled.y)", "the residual follows measured.y, which has samples"),
        (GRID, "rms(2 * g.y - scaled.y)", ""),
    ],
)
def test_rows_of_samples_that_are_not_in_the_run_are_a_problem(tmp_path, t, metric, problem):
    """Of a table, and where another component is between a recording and the residual."""
    found = residual(tmp_path, t, metric=metric).problem
    assert found.startswith(problem)
    assert bool(found) == bool(problem)


# --- its noise ---


def checked(values):
    largest = np.abs(values).max()
    rms = float(np.sqrt(np.mean((values / largest) ** 2)) * largest)
    return check_residual(SampledResidual(values.size, rms, np.arange(values.size) * 0.01, values))


def test_white_noise_of_any_size_is_what_noise_leaves():
    """The three tests of identification fail once in a thousand residuals."""
    for seed in range(8):
        found = checked((1.0, 1e-200)[seed % 2] * white(seed, ROWS))
        assert (found.problem, found.independent) == ("", ROWS)


def test_what_a_wrong_model_would_leave_is_a_problem():
    """An offset, a trend, a memory that is long for the record."""
    noise, trend = white(1, ROWS), np.linspace(-0.8, 0.8, ROWS)
    for values in (noise + 0.4, noise + trend, lfilter([1.0], [1.0, -0.9], noise)):
        assert checked(values).problem.startswith("noise does not explain the residual: ")


def test_independent_samples_are_those_of_the_closed_form():
    """Of AR(1) the share is (1 - a)/(1 + a), which is known to 4 times 2 (1 - a^2)^-1/2 N^-1/2.

    The tests of all lags call some of the short records white, of which the share would be 1.
    """
    found = checked(lfilter([1.0], [1.0, -0.5], white(1, 4000)))
    assert found.problem == ""
    assert found.independent == pytest.approx(4000 / 3.0, rel=0.15)
    short = [checked(lfilter([1.0], [1.0, -0.4], white(seed, 251))) for seed in range(12)]
    shares = [found.independent / 251 for found in short]
    assert shares == pytest.approx([0.6 / 1.4] * 12, abs=0.2)


def test_rows_between_samples_do_not_count():
    """Of straight lines between samples the rms is smaller, by 2/3 of the variance for many."""
    noise = white(1, ROWS)
    t = np.arange(ROWS) * 0.05
    rows = 5 * (ROWS - 1) + 1
    found = check_residual(SampledResidual(rows, np.sqrt(2.0 / 3.0), t, noise, noise))
    assert (found.rows, found.samples, found.independent) == (2496, ROWS, ROWS)
    assert found.neighbours == pytest.approx(noise[1:] @ noise[:-1] / (noise @ noise), rel=1e-9)
    assert found.ratio == pytest.approx(np.sqrt(1.5 * np.mean(noise**2)), rel=1e-9)
    few = check_residual(SampledResidual(21, 1.0, t[:5], noise[:5], noise[:5]))
    assert few.problem.startswith("5 samples are too few")
    assert checked(noise[:9]) is None
    assert check_residual(SampledResidual(20, 0.0, t[:20], 0.0 * noise[:20])) is None


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize(("spacing", "offset"), [(37, 0), (40, 5), (7, 0)])
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
    X = np.stack([T, np.ones(T.size)], axis=1)
    C = np.linalg.inv(X.T @ X)
    result = fitted(line, LINE, line(T, 3.0, -2.0) + W @ noise)
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


@pytest.fixture(scope="module")
def fit():
    """Return the fit of a decay with 201 rows."""
    return fitted(decay, DECAY, decay(T, 2.0, 3.0) + 0.02 * white(1))


def left_of(fit, given=None, **residual):
    """Return what a residual of these properties leaves of a fit; independent samples given."""
    of_all = ResidualCheck(T.size, T.size, 1.0, 0.1, "", T.size, np.inf)
    return with_residual(fit, replace(of_all, **residual), None, given)


def test_fewer_independent_samples_widen_the_errors(fit):
    """By the root of their numbers less two values, and by their deviation.

    A color that is known to 8 degrees of freedom widens the interval.
    """
    white = left_of(fit)
    assert white.errors == fit.errors
    assert "201 samples of the residual are white" in white.statements[-1]
    result = left_of(fit, rows=1001, ratio=1.2, independent=52, freedom=8.0)
    ratio = 1.2 * np.sqrt(199.0 / 50.0)
    errors = [ratio * error for error in fit.errors.errors.values()]
    assert list(result.errors.errors.values()) == pytest.approx(errors, rel=1e-9)
    low, high = result.errors.intervals["k"]
    # Student's quantile of 8 degrees
    assert high - low == pytest.approx(2.0 * 2.306 * errors[1], rel=1e-4)
    assert "52 of the 201 samples" in result.statements[-1]
    assert "1001 rows" in result.statements[-1]
    assert "got 2 values from 2 samples" in left_of(fit, independent=2).errors_problem


@pytest.mark.parametrize("samples", [T.size, 0])
def test_what_noise_does_not_explain_has_no_errors_unless_samples_are_given(fit, samples):
    result = left_of(fit, samples=samples, problem="a constant")
    assert result.errors is None
    assert "a constant" in result.statements[-1]
    result = left_of(fit, given=T.size, samples=samples, problem="a constant")
    assert result.errors == fit.errors
    assert "a constant" in result.statements[-1]
