"""What is said of a residual is right for white ones, and wrong neither for others nor for them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.signal import lfilter
from scipy.stats import binom

from cosim.studies.tuning.result import NOT_WHITE, statements
from cosim.studies.tuning.whiteness import check_rows
from tests.studies.tuning.curves import DECAY, T, decay, errors_at_solution, fitted

ROWS = 500
SEEDS = 300


def white(seed, rows=ROWS):
    return np.random.default_rng(seed).standard_normal(rows)


def verdicts(colored, seeds=SEEDS):
    """Return in how many of the seeds a residual is said to be none of white noise."""
    return sum(check_rows(colored(seed)).probability < NOT_WHITE for seed in range(seeds))


def test_white_noise_is_said_to_be_none_as_rarely_as_the_test_says():
    """Within what has a probability of 1 in 1000; of short ones, where it is approximate, too."""
    assert verdicts(white) <= binom.ppf(0.999, SEEDS, NOT_WHITE)
    assert verdicts(lambda seed: white(seed, 30)) <= binom.ppf(0.999, SEEDS, 2 * NOT_WHITE)
    assert verdicts(lambda seed: 1e-200 * white(seed)) == verdicts(white)


COLORED = {
    "a memory of one sample": lambda seed: lfilter([1.0], [1.0, -0.4], white(seed)),
    "neighbours hardly correlate": lambda seed: lfilter([1.0], [1.0, 0.0, -0.4], white(seed)),
    "an oscillation": lambda seed: white(seed) + np.sin(0.5 * np.pi * np.arange(ROWS)),
    "an offset": lambda seed: white(seed) + 0.4,
    "a trend": lambda seed: white(seed) + np.linspace(-0.8, 0.8, ROWS),
}


@pytest.mark.parametrize("name", COLORED)
def test_a_correlated_residual_is_recognized(name):
    """In 9 of 10 cases or more."""
    assert verdicts(COLORED[name]) >= 0.9 * SEEDS


@pytest.mark.parametrize("memory", [0.5, 0.8, 0.9])
def test_independent_samples_are_those_of_the_closed_form(memory):
    """Of AR(1) the share is (1 - a)/(1 + a); windows cost some 20 % in 20 000 rows."""
    rows = 20_000
    residual = lfilter([1.0], [1.0, -memory], white(1, rows))
    expected = rows * (1.0 - memory) / (1.0 + memory)
    assert check_rows(residual).independent == pytest.approx(expected, rel=0.2)
    assert check_rows(white(1, rows)).independent == pytest.approx(rows, rel=0.1)


def test_residuals_that_cannot_be_checked_have_no_check():
    assert check_rows(np.zeros(100)) is None
    assert check_rows(white(1, 9)) is None
    assert check_rows(np.array([np.inf] * 20)) is None


def said_of(model, residual, **options):
    """Return the fit of a decay, and what is said of its errors."""
    measured = model(T) + residual
    result = fitted(decay, DECAY, measured, starts=1, **options)
    rest = decay(T, *result.best.point.values()) - measured
    result = replace(result, residual=check_rows(rest))
    return result, next(text for text in statements(result) if "standard errors assume" in text)


def truth(t):
    return decay(t, 2.0, 3.0)


def test_a_right_model_with_white_noise_has_nothing_against_it():
    _, text = said_of(truth, 0.02 * white(1, T.size))
    assert text.startswith("the standard errors assume that the 201 samples of the residual are w")
    assert "and whiteness is not rejected over 20 lags" in text


def test_colored_noise_is_said_to_make_errors_too_small():
    """They are: of 40 seeds the intervals have the truth in 24 or fewer, not in 38.

    With the samples that are said to be independent instead they have it in 32 or more.
    """
    hits = {"all": 0, "independent": 0}
    for seed in range(40):
        measured = truth(T) + lfilter([1.0], [1.0, -0.9], 0.01 * white(seed, T.size))
        (a, k), _ = curve_fit(decay, T, measured, p0=[2.0, 3.0])
        check = check_rows(decay(T, a, k) - measured)
        assert check.probability < NOT_WHITE
        low, high = errors_at_solution(measured).intervals["k"]
        hits["all"] += low < 3.0 < high
        widened = np.sqrt(T.size / check.independent)
        hits["independent"] += abs(3.0 - k) < widened * (high - low) / 2
    assert hits["all"] <= 24
    assert hits["independent"] >= 32
    _, text = said_of(truth, lfilter([1.0], [1.0, -0.9], 0.01 * white(1, T.size)))
    assert re.search(
        r"errors are too small: only about \d+ samples are independent; set samp", text
    )


def test_a_wrong_model_is_said_to_be_possible():
    """A decay to 0.1, fitted by one to 0: its values are off by many errors."""
    result, text = said_of(lambda t: truth(t) + 0.1, 0.005 * white(1, T.size))
    assert abs(result.best.point["k"] - 3.0) > 5.0 * result.errors.errors["k"]
    assert "it is not white over 20 lags" in text
    assert "or a model error that also biases the values" in text


def test_samples_that_are_given_are_compared_with_those_that_are_independent():
    residual = lfilter([1.0], [1.0, -0.9], 0.01 * white(1, T.size))
    result, _ = said_of(truth, residual)
    _, text = said_of(truth, residual, samples=result.residual.independent)
    assert text.startswith(
        f"the standard errors assume that {result.residual.independent} of the 201 samples of the "
        "residual are independent"
    )
    assert "too small" not in text
