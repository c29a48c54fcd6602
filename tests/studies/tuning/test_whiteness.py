"""What is said of a residual is right for white ones, and wrong neither for others nor for them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import cosim
from cosim.studies.tuning.result import statements, with_residual
from cosim.studies.tuning.whiteness import ResidualCheck, check_rows
from tests.studies.tuning.curves import DECAY, T, decay, fitted

ROWS = 500


def white(seed, rows=ROWS):
    return np.random.default_rng(seed).standard_normal(rows)


def checked(residual, is_sample=None):
    if is_sample is None:
        is_sample = np.ones(residual.size, np.bool_)
    return check_rows(np.arange(residual.size) * 0.01, residual, is_sample)


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


def test_rows_between_samples_do_not_count():
    """Straight lines between samples are no noise of their own."""
    rows = 5 * (ROWS - 1) + 1
    is_sample = np.arange(rows) % 5 == 0
    lines = np.interp(np.arange(rows), np.arange(rows)[is_sample], white(1))
    found = checked(lines, is_sample)
    assert (found.rows, found.samples, found.independent) == (rows, ROWS, ROWS)
    assert found.problem == ""
    neighbours = white(1)[1:] @ white(1)[:-1] / (white(1) @ white(1))
    assert found.neighbours == pytest.approx(neighbours, rel=1e-9)
    few = checked(lines[:21], is_sample[:21])
    assert few.problem.startswith("5 samples are too few")


def test_residuals_that_cannot_be_checked_have_no_check():
    assert checked(np.zeros(100)) is None
    assert checked(white(1, 9)) is None
    assert checked(np.array([np.inf] * 20)) is None


def found_for(residual, **options):
    """Return the fit of a decay with a residual of these properties."""
    measured = decay(T, 2.0, 3.0) + 0.02 * white(1, T.size)
    result = fitted(decay, DECAY, measured, starts=1, **options)
    of_all = ResidualCheck(T.size, T.size, 1.0, 0.1, "", T.size, np.inf)
    return result, with_residual(replace(result, residual=replace(of_all, **residual)))


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
    assert "800 of 1001 rows are interpolated or held" in text


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
