"""What a key is varied by."""

import math

import numpy as np
import pytest

from cosim.scenario.document.problems import TableProblems
from cosim.studies.variations import GridVariation, SampledVariation, read_variation

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
        (3.0, "got 3.0"),
        ([], "got none"),
        ([object()], "<object .*>"),
        ({}, "got none of them"),
        ({"uniform": [0, 1], "log": [1, 2]}, "got 'log' and 'uniform'"),
        ({"unifrm": [0, 1]}, "unknown key 'unifrm'; did you mean 'uniform'"),
        ({"values": []}, "values: .*got none"),
        ({"uniform": [1.0, 1.0]}, r"uniform: .*got \[1.0, 1.0\]"),
        ({"uniform": [1.0]}, r"uniform: .*got \[1.0\]"),
        ({"uniform": [0.0, 1.0, 2.0]}, r"uniform: .*got \[0.0, 1.0, 2.0\]"),
        ({"uniform": [0.0, math.inf]}, "uniform.1: .*inf"),
        ({"uniform": ["a", 1.0]}, "uniform.0: .*'a'"),
        ({"log-uniform": [0.0, 1.0]}, "log-uniform: .*0 < lower < upper"),
        ({"normal": [0.0, 0.0]}, "normal: .* deviation above 0"),
        ({"normal": [0.0, -1.0]}, "normal: .* deviation above 0"),
        ({"normal": [0.0, 1.0], "lower": 1, "upper": 1}, "got 1.0 and 1.0"),
        ({"lognormal": [-1.0, 1.0]}, "lognormal: .* both above 0"),
        ({"triangular": [0.0, 2.0, 1.0]}, "triangular: .*lower <= mode <= upper"),
        ({"triangular": [1.0, 1.0, 1.0]}, "triangular: .*lower <= mode <= upper"),
        ({"exponential": 0.0}, r"exponential: .*got \[0.0\]"),
        ({"beta": [0.0, 1.0]}, "beta: .*both above 0"),
        ({"beta": [1.0, 1.0], "lower": 2.0}, "got 2.0 and 1.0"),
        ({"weibull": [1.0, 0.0]}, "weibull: .*both above 0"),
        ({"choice": []}, "choice: .*got none"),
        ({"choice": [1, 2], "weights": [1.0]}, "weights: .*a weight for each of the 2"),
        ({"choice": [1, 2], "weights": [0, 0]}, "weights: .*and one above it"),
        ({"choice": [1, 2], "weights": [-1, 2]}, "weights: .*weights of at least 0"),
        ({"choice": [1, 2], "weights": [1e308, 1e308]}, "weights: .*got "),
        ({"tolerance": 0.0}, "tolerance: .*got 0.0"),
        ({"tolerance": 5}, "tolerance: .*got 5.0"),
        ({"tolerance": 0.1, "distribution": "norml"}, "distribution: .*did you mean 'normal'"),
        ({"linear": [0.0, 1.0]}, "'points' is missing; .*'linear'"),
        ({"linear": [0.0, 1.0], "points": 1}, "points: .*1"),
        ({"linear": [0.0, 1.0], "points": 10**9}, "points: .*1000000000"),
        ({"linear": [1.0, 1.0], "points": 2}, "linear: .*two different numbers"),
        ({"log": [0.0, 1.0], "points": 2}, "log: .*two positive numbers"),
        ({"uniform": [0, 1], "points": 2}, "points: 'points' belongs .*'uniform'"),
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
        ({"uniform": [0, 1]}, "for a component, got 'uniform'"),
        (["a.fmu", 3], "1: .*got 3"),
        ({"choice": [2.0]}, "choice.0: .*got 2.0"),
    ],
)
def test_a_swap_has_paths(value, message):
    """Nothing else."""
    with pytest.raises(TableProblems, match=message):
        read_variation("swap.plant", value)
