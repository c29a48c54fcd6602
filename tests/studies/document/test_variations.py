"""What a key is varied by."""

import math

import numpy as np
import pytest

from cosim.scenario.document.problems import TableProblems
from cosim.studies.document.variations import GridVariation, SampledVariation, read_variation

INF = math.inf


@pytest.mark.parametrize(
    ("value", "values"),
    [
        ([1.0, 2, "a", [1, 2]], (1.0, 2, "a", [1, 2])),
        ({"values": [True]}, (True,)),
        (np.array([1.0, 2.0]), (1.0, 2.0)),
        ({"linear": [0.0, 1.0], "points": 5}, (0.0, 0.25, 0.5, 0.75, 1.0)),
        ({"linear": [2, -2], "points": 3}, (2.0, 0.0, -2.0)),
    ],
)
def test_a_grid_has_its_values_in_order(value, values):
    """Of a list, or of two ends."""
    assert read_variation("a.x", value) == GridVariation("a.x", values)


def test_a_logarithmic_grid_has_one_factor_and_exact_ends():
    """Its 25 values from 10 to 10 000 have the factor 1000**(1/24)."""
    values = read_variation("a.x", {"log": [10.0, 1e4], "points": 25}).values
    assert (values[0], values[-1], len(values)) == (10.0, 1e4, 25)
    factors = np.divide(values[1:], values[:-1])
    # pow and the division round by a few units in the last place
    np.testing.assert_allclose(factors, 1000 ** (1 / 24), rtol=1e-14)


@pytest.mark.parametrize(
    ("value", "distribution", "numbers"),
    [
        ({"uniform": [0, 1.5]}, "uniform", (0.0, 1.5)),
        ({"log-uniform": [1.0, 10.0]}, "log-uniform", (1.0, 10.0)),
        ({"normal": [0.0, 2.0]}, "normal", (0.0, 2.0, -INF, INF)),
        ({"normal": [0.0, 2.0], "lower": 0.0}, "normal", (0.0, 2.0, 0.0, INF)),
        ({"normal": [0.0, 2.0], "lower": -1, "upper": 1}, "normal", (0.0, 2.0, -1.0, 1.0)),
        ({"lognormal": [1.0, 0.1]}, "lognormal", (1.0, 0.1)),
        ({"triangular": [0.0, 0.0, 1.0]}, "triangular", (0.0, 0.0, 1.0)),
        ({"exponential": 2.0}, "exponential", (2.0,)),
        ({"exponential": [2.0]}, "exponential", (2.0,)),
        ({"beta": [2.0, 3.0]}, "beta", (2.0, 3.0, 0.0, 1.0)),
        ({"beta": [2.0, 3.0], "lower": -1, "upper": 4}, "beta", (2.0, 3.0, -1.0, 4.0)),
        ({"weibull": [2.0, 1.5]}, "weibull", (2.0, 1.5)),
        ({"tolerance": 0.05}, "tolerance", (0.05,)),
        ({"tolerance": 0.05, "distribution": "uniform"}, "tolerance", (0.05,)),
        ({"tolerance": 0.05, "distribution": "normal"}, "tolerance-normal", (0.05,)),
    ],
)
def test_a_distribution_has_its_numbers(value, distribution, numbers):
    """All of them, also those that are left out."""
    assert read_variation("a.x", value) == SampledVariation("a.x", distribution, numbers)


def test_a_choice_has_values_of_any_type_and_weights():
    """The weights are equal where there are none."""
    equal = read_variation("a.x", {"choice": ["a", 2]})
    assert equal == SampledVariation("a.x", "choice", (1.0, 1.0), ("a", 2))
    weighted = read_variation("swap.a", {"choice": ["a.fmu", "b.fmu"], "weights": [3, 0]})
    assert weighted == SampledVariation("swap.a", "choice", (3.0, 0.0), ("a.fmu", "b.fmu"))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3.0, "found 3.0; needed a list of values, or a table such as"),
        ([], "found no value; needed at least one"),
        ([object()], "expected a number, true or false"),
        ({}, "found none of them; needed one of: values, linear, log, uniform"),
        ({"uniform": [0, 1], "log": [1, 2]}, "found 'log' and 'uniform'; needed one of"),
        ({"unifrm": [0, 1]}, "unknown key 'unifrm'; did you mean 'uniform'"),
        ({"values": []}, "values: found no value"),
        ({"uniform": [1.0, 1.0]}, r"uniform: found \[1.0, 1.0\]; needed \[lower, upper\] with"),
        ({"uniform": [1.0]}, r"uniform: found \[1.0\]; needed"),
        ({"uniform": [0.0, 1.0, 2.0]}, r"uniform: found \[0.0, 1.0, 2.0\]; needed"),
        ({"uniform": [0.0, math.inf]}, "uniform.1: expected a finite number, got inf"),
        ({"uniform": ["a", 1.0]}, "uniform.0: expected a number, got 'a'"),
        ({"log-uniform": [0.0, 1.0]}, "log-uniform: found .*needed .*0 < lower < upper"),
        ({"normal": [0.0, 0.0]}, "normal: found .*needed .* deviation above 0"),
        ({"normal": [0.0, -1.0]}, "normal: found .*needed .* deviation above 0"),
        ({"normal": [0.0, 1.0], "lower": 1, "upper": 1}, "found bounds 1.0 and 1.0; needed lower"),
        ({"lognormal": [-1.0, 1.0]}, "lognormal: found .*needed .* both above 0"),
        ({"triangular": [0.0, 2.0, 1.0]}, "triangular: found .*lower <= mode <= upper"),
        ({"triangular": [1.0, 1.0, 1.0]}, "triangular: found .*lower <= mode <= upper"),
        ({"exponential": 0.0}, r"exponential: found \[0.0\]; needed a mean above 0"),
        ({"beta": [0.0, 1.0]}, "beta: found .*both above 0"),
        ({"beta": [1.0, 1.0], "lower": 2.0}, "found bounds 2.0 and 1.0; needed lower < upper"),
        ({"weibull": [1.0, 0.0]}, "weibull: found .*both above 0"),
        ({"choice": []}, "choice: found no value"),
        ({"choice": [1, 2], "weights": [1.0]}, "weights: found .*a weight for each of the 2"),
        ({"choice": [1, 2], "weights": [0, 0]}, "weights: found .*and one above it"),
        ({"choice": [1, 2], "weights": [-1, 2]}, "weights: found .*weights of at least 0"),
        ({"choice": [1, 2], "weights": [1e308, 1e308]}, "weights: found "),
        ({"tolerance": 0.0}, "tolerance: found 0.0; needed a part between 0 and 1"),
        ({"tolerance": 5}, "tolerance: found 5.0; needed a part between 0 and 1"),
        ({"tolerance": 0.1, "distribution": "norml"}, "distribution: .*did you mean 'normal'"),
        ({"linear": [0.0, 1.0]}, "'points' is missing .how many values 'linear' has"),
        ({"linear": [0.0, 1.0], "points": 1}, "points: expected a number >= 2, got 1"),
        ({"linear": [0.0, 1.0], "points": 10**9}, "points: found 1000000000; needed at most"),
        ({"linear": [1.0, 1.0], "points": 2}, "linear: found .*two different numbers"),
        ({"log": [0.0, 1.0], "points": 2}, "log: found .*two positive numbers"),
        ({"uniform": [0, 1], "points": 2}, "points: found 'points' beside 'uniform'; it belongs"),
        ({"uniform": [0, 1], "lower": 0}, "lower: .*belongs to 'normal' or 'beta'"),
        ({"tolerance": 0.1, "weights": [1]}, "weights: .*belongs to 'choice'"),
    ],
)
def test_wrong_numbers_are_refused(value, message):
    """One sentence each, with the key that is wrong."""
    with pytest.raises(TableProblems, match=message) as caught:
        read_variation("a.x", value)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"uniform": [0, 1]}, "found 'uniform' for a component; needed a list of paths"),
        (["a.fmu", 3], "1: found 3; needed a path, or a key with a dot"),
        ({"choice": [2.0]}, "choice.0: found 2.0; needed a path"),
    ],
)
def test_a_swap_has_paths(value, message):
    """Nothing else."""
    with pytest.raises(TableProblems, match=message):
        read_variation("swap.plant", value)
