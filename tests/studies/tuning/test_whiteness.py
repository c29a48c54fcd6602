"""What is said of a residual is right for white ones, and wrong neither for others nor for them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import interp1d
from scipy.signal import lfilter

import cosim
from cosim.studies.tuning.result import statements, with_residual
from cosim.studies.tuning.sampled_residual import Lines, SampledResidual
from cosim.studies.tuning.searching import TuningSearch, search_best
from cosim.studies.tuning.standard_errors import moved_points
from cosim.studies.tuning.whiteness import ResidualCheck, check_residual
from tests.studies.tuning.curves import DECAY, LINE, T, decay, fitted
from tests.studies.tuning.functions import OBJECTIVE, Recorded

ROWS = 500


def white(seed, rows=ROWS):
    return np.random.default_rng(seed).standard_normal(rows)


def checked(residual, problem=""):
    rms = float(np.sqrt(np.mean((residual / np.abs(residual).max()) ** 2)) * np.abs(residual).max())
    t = np.arange(residual.size) * 0.01
    rows = residual.size
    return check_residual(SampledResidual(rows, rms, t, residual, residual, True, problem))


def test_white_noise_of_any_size_is_what_noise_leaves():
    """The three tests of identification fail once in a thousand residuals."""
    for seed in range(8):
        for size in (1.0, 1e-200):
            found = checked(size * white(seed))
            assert (found.problem, found.independent) == ("", ROWS)


COLORED = {
    "an offset": lambda: white(1) + 0.4,
    "a trend": lambda: white(1) + np.linspace(-0.8, 0.8, ROWS),
    "a memory that is long for the record": lambda: lfilter([1.0], [1.0, -0.9], white(1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COLORED)
def test_what_a_wrong_model_would_leave_is_a_problem(name):
    found = checked(COLORED[name]())
    assert found.problem.startswith("noise does not explain the residual: ")


@pytest.mark.slow
def test_independent_samples_are_those_of_the_closed_form():
    """Of AR(1) the share is (1 - a)/(1 + a), which is known to 4 times 2 (1 - a^2)^-1/2 N^-1/2."""
    rows = 4000
    found = checked(lfilter([1.0], [1.0, -0.5], white(1, rows)))
    assert found.problem == ""
    assert found.independent == pytest.approx(rows / 3.0, rel=0.15)


def test_a_short_memory_in_few_samples_is_counted():
    """AR(1) of 0.4 in 251 samples, which the tests of all lags refuse or call white."""
    found = [checked(lfilter([1.0], [1.0, -0.4], white(seed, 251))) for seed in range(12)]
    shares = [one.independent / 251 for one in found if not one.problem]
    assert len(shares) > 4
    assert np.median(shares) == pytest.approx(0.6 / 1.4, rel=0.3)
    assert max(shares) < 0.8
    assert checked(white(1, 251)).independent == 251


def test_rows_between_samples_do_not_count():
    """Of straight lines between samples the rms is smaller, by 2/3 of the variance for many."""
    noise = white(1)
    t = np.arange(ROWS) * 0.05
    whole = SampledResidual(5 * (ROWS - 1) + 1, np.sqrt(2.0 / 3.0), t, noise, noise, False)
    found = check_residual(whole)
    assert (found.rows, found.samples, found.independent) == (2496, ROWS, ROWS)
    assert found.problem == ""
    assert found.neighbours == pytest.approx(noise[1:] @ noise[:-1] / (noise @ noise), rel=1e-9)
    assert found.ratio == pytest.approx(np.sqrt(1.5 * np.mean(noise**2)), rel=1e-9)
    few = check_residual(SampledResidual(21, 1.0, t[:5], noise[:5], noise[:5], False))
    assert few.problem.startswith("5 samples are too few")


def test_residuals_that_cannot_be_checked_have_no_check():
    nothing = np.zeros(100)
    assert check_residual(SampledResidual(100, 0.0, nothing, nothing, nothing, True)) is None
    assert checked(white(1, 9)) is None
    infinite = np.full(20, np.inf)
    assert check_residual(SampledResidual(20, np.inf, infinite, infinite, infinite, True)) is None


def test_samples_that_are_not_known_are_a_problem():
    assert checked(white(1), "of a table").problem == "of a table"
    _, result = found_for({"samples": 0, "independent": 0, "problem": "of a table"})
    assert result.standard_errors is None
    assert "of a table" in result.errors_problem
    assert "samples" in result.errors_problem
    before, result = found_for({"samples": 0, "problem": "of a table"}, given=201)
    assert result.errors == before.errors
    assert "not checked: of a table" in statements(result)[-1]


@pytest.mark.parametrize(("spacing", "offset"), [(37, 0), (40, 5), (20, 5), (35, 0), (7, 0)])
@pytest.mark.parametrize("hold", [False, True])
def test_errors_of_values_between_samples_are_those_of_what_the_rows_rest_on(spacing, offset, hold):
    """With y = X p + W e the covariance of least squares is s^2 (X'X)^-1 X'W W'X (X'X)^-1.

    The step is 10 ms; spacing and offset of the samples are in ms.
    """
    t = np.arange(501) * 0.01
    knots = np.arange(-offset, 5000 + spacing, spacing) / 1000.0
    knots[0] = 0.0
    lines = Lines.between(knots, t, hold=hold)
    rows_of = interp1d(knots, np.eye(knots.size), kind="previous" if hold else "linear", axis=0)
    W = rows_of(t)
    noise = 0.1 * np.random.default_rng(2).standard_normal(knots.size)
    assert lines.of(noise) == pytest.approx(W @ noise, abs=1e-9)
    assert lines.back(t) == pytest.approx(W.T @ t, abs=1e-9)
    X = np.stack([t, np.ones(t.size)], axis=1)
    C = np.linalg.inv(X.T @ X)
    measured = X @ [3.0, -2.0] + W @ noise

    def rms(point):
        return float(np.sqrt(np.mean((X @ list(point.values()) - measured) ** 2)))

    result = search_best(
        Recorded(rms), TuningSearch(LINE, OBJECTIVE, is_rms=True, with_errors=True, samples=t.size)
    )
    residual = X @ list(result.estimate.values()) - measured
    at_samples = np.stack([knots, np.ones(knots.size)], axis=1) @ list(result.estimate.values())
    at_samples -= np.stack([knots, np.ones(knots.size)], axis=1) @ [3.0, -2.0] + noise
    points, units = moved_points(result.errors, LINE, result.best.point)
    moves = [lines.back(X @ list(point.values()) - measured - residual) for point in points]
    sampled = SampledResidual(t.size, rms(result.estimate), knots, at_samples, residual, False)
    result = replace(result, residual=check_residual(sampled))
    result = with_residual(result, np.stack(moves, axis=1) / units)
    s = np.sqrt(at_samples @ at_samples / (knots.size - 2))
    expected = s * np.sqrt(np.diag(C @ X.T @ W @ W.T @ X @ C))
    assert list(result.standard_errors.values()) == pytest.approx(expected, rel=0.01)


def found_for(residual, given=None, **options):
    """Return the fit of a decay with a residual of these properties, and what that leaves of it."""
    measured = decay(T, 2.0, 3.0) + 0.02 * white(1, T.size)
    result = fitted(decay, DECAY, measured, starts=1, **options)
    of_all = ResidualCheck(T.size, T.size, 1.0, 0.1, "", T.size, np.inf)
    changed = replace(result, residual=replace(of_all, **residual))
    return result, with_residual(changed, samples=given)


def test_white_samples_leave_the_errors_as_they_are():
    before, result = found_for({})
    assert result.errors == before.errors
    text = statements(result)[-1]
    assert text.startswith(
        "the standard errors assume that the 201 samples of the residual are white"
    )
    assert "whiteness is not rejected" in text


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
    text = statements(result)[-1]
    assert "52 of the 201 samples" in text
    assert "the 1001 rows are interpolated or held" in text


def test_a_residual_with_structure_has_no_errors():
    """What it shows is said, and what to do."""
    _, result = found_for({"problem": "noise does not explain the residual: a constant"})
    assert result.errors is None
    assert statements(result)[-1].startswith("no standard errors: noise does not explain the resid")
    assert "samples" in statements(result)[-1]
    _, result = found_for({"independent": 2})
    assert result.errors_problem == "expected more samples than values, got 2 values from 2 samples"


@pytest.mark.slow
def test_interpolated_recordings_count_their_samples(tmp_path):
    """Errors are those of regression on the 201 samples, to 4/sqrt(2 N) of their deviation.

    The lines between the samples average the noise, by two thirds of its variance, which does not
    count. An offset of the recording leaves
    no interval, though the value is off by many errors.
    """
    t = np.arange(201) * 0.025
    (tmp_path / "fit.toml").write_text(
        """
scenario = { name = "fit", stop = 5.0, step = 0.005 }
[components]
plant = { kind = "lag", time_constant = 0.5, initial = 0.0 }
one = { kind = "constant", value = 1.0 }
measured = { kind = "field-data", path = "measured.csv" }
[connections]
"plant.u" = "one.y"
"""
    )

    def tuned(offset):
        y = 1.0 - np.exp(-t / 0.7) + 0.01 * white(1, t.size) + offset
        rows = zip(t.tolist(), y.tolist(), strict=True)
        lines = ["time,y", *(f"{time!r},{value!r}" for time, value in rows)]
        (tmp_path / "measured.csv").write_text("\n".join(lines))
        return cosim.tune(
            tmp_path / "fit.toml",
            minimize="rms(plant.y - measured.y)",
            vary={"plant.time_constant": {"log": [0.1, 10.0]}},
            members=60,
            starts=1,
            workers=1,
            standard_errors=True,
        )

    result = tuned(0.0)
    slope = -t / 0.7**2 * np.exp(-t / 0.7)
    assert (result.residual.rows, result.residual.samples) == (1001, 201)
    error = 0.01 / np.sqrt(slope @ slope)
    assert result.standard_errors["plant.time_constant"] == pytest.approx(error, rel=0.2)
    assert result.residual.ratio == pytest.approx(np.sqrt(1.5), rel=0.1)
    wrong = tuned(0.1)
    assert wrong.standard_errors is None
    assert "a constant" in wrong.errors_problem
