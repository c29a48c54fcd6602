"""What a key is varied by: tables of a file, texts of --vary, and quantiles."""

import math

import numpy as np
import pytest
from scipy import stats

from cosim.errors import UsageError
from cosim.scenario.document.problems import TableProblems
from cosim.studies.variations import (
    GridVariation,
    SampledVariation,
    chosen,
    quantiles,
    read_variation,
    read_vary_option,
)

P = np.concatenate([[2.0**-54, 1e-9], np.linspace(1e-3, 1 - 1e-3, 999), [1 - 1e-9, 1.0 - 2.0**-53]])


def test_a_grid_has_its_values_in_order():
    """Of a list, or from one end to the other, which are exact; a logarithmic one has a factor."""
    for value, values in (
        ([1.0, 2, "a", [1, 2]], (1.0, 2, "a", [1, 2])),
        ({"values": np.array([True])}, (True,)),
        ({"linear": [2, -2], "points": 5}, (2.0, 1.0, 0.0, -1.0, -2.0)),
    ):
        assert read_variation("a.x", value) == GridVariation("a.x", values)
    values = read_variation("a.x", {"log": [10.0, 1e4], "points": 25}).values
    assert (values[0], values[-1]) == (10.0, 1e4)
    # pow and the division round by a few units in the last place
    np.testing.assert_allclose(np.divide(values[1:], values[:-1]), 1000 ** (1 / 24), rtol=1e-14)


def test_a_choice_follows_its_weights():
    """Its values take parts of the unit interval as long as their weights, in order."""
    equal = SampledVariation("a.x", "choice", (1.0, 1.0), ("a", 2))
    assert read_variation("a.x", {"choice": ["a", 2]}) == equal
    variation = read_variation("a.x", {"choice": list("abcde"), "weights": [1, 0, 2, 1, 0]})
    p = np.array([2.0**-54, 0.2499, 0.25, 0.7499, 0.75, 1.0 - 2.0**-53])
    assert chosen(variation, p).tolist() == [0, 0, 2, 2, 3, 3]
    many = read_variation("a.x", {"choice": [*range(10)], "weights": [0.1] * 10})
    assert chosen(many, p[-1:]).tolist() == [9]  # where the sum of the weights rounds to below 1


CUT_NORMAL = {"normal": [2, 0.5], "lower": 1.5, "upper": 4}
NORMAL_TOLERANCE = {"tolerance": 0.1, "distribution": "normal"}


@pytest.mark.parametrize(
    ("text", "table", "reference"),
    [
        ("uniform:-1:3", {"uniform": [-1, 3]}, stats.uniform(-1, 4)),
        ("log-uniform:10:1e4", {"log-uniform": [10, 1e4]}, stats.loguniform(10, 1e4)),
        ("normal:2:0.5", {"normal": [2, 0.5]}, stats.norm(2, 0.5)),
        ("normal:2:0.5:1.5:4", CUT_NORMAL, stats.truncnorm(-1, 4, loc=2, scale=0.5)),
        ("lognormal:2:0.25", {"lognormal": [2, 0.25]}, stats.lognorm(0.25, scale=2)),
        ("triangular:-1:0:3", {"triangular": [-1, 0, 3]}, stats.triang(0.25, -1, 4)),
        (None, {"exponential": 3.0}, stats.expon(scale=3)),
        ("beta:2:3:1:5", {"beta": [2, 3], "lower": 1, "upper": 5}, stats.beta(2, 3, 1, 4)),
        ("weibull:2:1.5", {"weibull": [2, 1.5]}, stats.weibull_min(1.5, scale=2)),
        ("tolerance:0.1", {"tolerance": 0.1}, stats.uniform(-2.2, 0.4)),
        ("tolerance:0.1:normal", NORMAL_TOLERANCE, stats.truncnorm(-3, 3, loc=-2, scale=0.2 / 3)),
    ],
)
def test_a_distribution_has_its_quantiles(text, table, reference):
    """As an option and in a file, as scipy.stats has them; the tolerances are of -2."""
    assert text is None or read_vary_option(text) == table
    found = quantiles(read_variation("a.x", table), P, -2.0)
    # Both are some roundings of a closed form, whose largest number is 10 at a place of rounding.
    np.testing.assert_allclose(found, reference.ppf(P), rtol=1e-12, atol=1e-14)
    assert (np.diff(found) >= 0).all()


def test_no_rounding_leads_out_of_the_bounds():
    """Where a parameter of a scenario may have a limit."""
    for lower, upper, table in (
        (-1e308, 1e308, {"uniform": [-1e308, 1e308]}),
        (0.03, 0.12, {"log-uniform": [0.03, 0.12]}),
        (40.0, 41.0, {"normal": [0.0, 1.0], "lower": 40.0, "upper": 41.0}),
        (0.1, 0.3, {"beta": [0.5, 0.5], "lower": 0.1, "upper": 0.3}),
    ):
        found = quantiles(read_variation("a.x", table), P, 1.0)
        assert lower <= found.min() <= found.max() <= upper


WRONG = {"uniform": [1.0, 1.0], "log-uniform": [0.0, 1.0], "normal": [0.0, 0.0], "log": [0, 1]}
WRONG |= {"lognormal": [-1.0, 1.0], "triangular": [1.0, 1.0, 1.0], "exponential": [0.0]}
WRONG |= {"beta": [0.0, 1.0], "weibull": [1.0, 0.0], "tolerance": 5, "linear": [1, 1]}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "got none"),
        ({"uniform": [0, 1], "log": [1, 2]}, "got 'log' and 'uniform'"),
        ({"uniform": ["a", math.inf]}, "uniform.0: .*'a'.*uniform.1: .*inf"),
        ({"normal": [0.0, 1.0], "lower": 1, "upper": 1}, "got 1.0 and 1.0"),
        ({"choice": [1, 2], "weights": [1.0]}, r"weights: .* 2 values.*got \[1.0\]"),
        ({"choice": [1, 2], "weights": [0, 0]}, r"weights: .*got \[0.0, 0.0\]"),
        ({"tolerance": 0.1, "distribution": "norml"}, "distribution: .*did you mean 'normal'"),
        ({"linear": [0.0, 1.0]}, "'points'.*'linear'"),
        (["a.fmu", 3], "1: .*got 3"),
        ({"uniform": [0, 1], "lower": 0}, "lower: .*'normal' or 'beta'.*'uniform'"),
        *(({form: numbers}, f"^{form}: expected ") for form, numbers in WRONG.items()),
    ],
)
def test_wrong_tables_are_refused(value, message):
    """At the key that is wrong."""
    with pytest.raises(TableProblems, match=message):
        read_variation("swap.a" if "fmu" in str(value) else "a.x", value)


def test_an_option_is_what_a_file_has():
    """Or it is refused."""
    for text, value in {
        "1e3,1e6": [1e3, 1e6],
        "'a:1',b:c": ["a:1", "b:c"],
        "[a.fmu,b.fmu#cs]": ["a.fmu", "b.fmu#cs"],
        "['a.fmu', \"b.fmu\"]": [["a.fmu", "b.fmu"]],
        "log:10:1e4:25": {"log": [10.0, 1e4], "points": 25},
        "choice:1,2,a": {"choice": [1, 2, "a"]},
    }.items():
        assert read_vary_option(text) == value
    for text in ("unifrm:0:1", "uniform:0:a", "log:1:10", "log:1:10:2.5", "1,,2"):
        with pytest.raises(UsageError, match=f"'{text}'"):
            read_vary_option(text)
