"""Quantile functions, against those of scipy.stats."""

import math

import numpy as np
import pytest
from scipy import stats

from cosim.studies.variations import SampledVariation, chosen, quantiles, read_variation

P = np.concatenate([[2.0**-54, 1e-9], np.linspace(1e-3, 1 - 1e-3, 999), [1 - 1e-9, 1.0 - 2.0**-53]])


@pytest.mark.parametrize(
    ("table", "reference"),
    [
        ({"uniform": [-1.0, 3.0]}, stats.uniform(-1, 4)),
        ({"log-uniform": [10.0, 1e4]}, stats.loguniform(10.0, 1e4)),
        ({"normal": [2.0, 0.5]}, stats.norm(2.0, 0.5)),
        (
            {"normal": [2.0, 0.5], "lower": 1.5, "upper": 4.0},
            stats.truncnorm(-1.0, 4.0, loc=2.0, scale=0.5),
        ),
        ({"normal": [0.0, 1.0], "lower": 6.0}, stats.truncnorm(6.0, math.inf)),
        ({"lognormal": [2.0, 0.25]}, stats.lognorm(0.25, scale=2.0)),
        ({"triangular": [-1.0, 0.0, 3.0]}, stats.triang(0.25, loc=-1.0, scale=4.0)),
        ({"triangular": [0.0, 0.0, 2.0]}, stats.triang(0.0, scale=2.0)),
        ({"triangular": [0.0, 2.0, 2.0]}, stats.triang(1.0, scale=2.0)),
        ({"exponential": 3.0}, stats.expon(scale=3.0)),
        ({"beta": [2.0, 1.5]}, stats.beta(2.0, 1.5)),
        ({"beta": [2.0, 3.0], "lower": 1.0, "upper": 5.0}, stats.beta(2.0, 3.0, 1.0, 4.0)),
        ({"weibull": [2.0, 1.5]}, stats.weibull_min(1.5, scale=2.0)),
        ({"tolerance": 0.1}, stats.uniform(-2.2, 0.4)),
        (
            {"tolerance": 0.1, "distribution": "normal"},
            stats.truncnorm(-3.0, 3.0, loc=-2.0, scale=0.2 / 3),
        ),
    ],
)
def test_quantiles_are_those_of_the_distribution(table, reference):
    """The own value of the tolerances is -2."""
    found = quantiles(read_variation("a.x", table), P, -2.0)
    # Both are some roundings of a closed form, whose largest number is 10 at a place of rounding.
    np.testing.assert_allclose(found, reference.ppf(P), rtol=1e-12, atol=1e-14)
    assert (np.diff(found) >= 0).all()


@pytest.mark.parametrize(
    ("table", "lower", "upper"),
    [
        ({"uniform": [0.1, 0.3]}, 0.1, 0.3),
        ({"uniform": [-1e308, 1e308]}, -1e308, 1e308),
        ({"log-uniform": [0.1, 0.3]}, 0.1, 0.3),
        ({"triangular": [0.1, 0.2, 0.3]}, 0.1, 0.3),
        ({"normal": [0.0, 1.0], "lower": 0.1, "upper": 0.3}, 0.1, 0.3),
        ({"normal": [0.0, 1.0], "lower": 40.0, "upper": 41.0}, 40.0, 41.0),
        ({"beta": [0.5, 0.5], "lower": 0.1, "upper": 0.3}, 0.1, 0.3),
    ],
)
def test_no_rounding_leads_out_of_the_bounds(table, lower, upper):
    """Where a parameter of a scenario may have a limit."""
    found = quantiles(read_variation("a.x", table), P, 1.0)
    assert found.min() >= lower
    assert found.max() <= upper


def test_a_choice_follows_its_weights():
    """Its values take parts of the unit interval as long as their weights, in order."""
    variation = SampledVariation("a.x", "choice", (1.0, 0.0, 2.0, 1.0, 0.0), tuple("abcde"))
    p = np.array([2.0**-54, 0.2499, 0.25, 0.7499, 0.75, 1.0 - 2.0**-53])
    assert chosen(variation, p).tolist() == [0, 0, 2, 2, 3, 3]
    many = SampledVariation("a.x", "choice", (0.1,) * 10, tuple(range(10)))
    assert chosen(many, np.array([1.0 - 2.0**-53])).tolist() == [9]
