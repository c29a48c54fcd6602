"""What follows KEY= in --vary."""

import pytest

from cosim.errors import UsageError
from cosim.studies.variations import read_variation, read_vary_option


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3,1e6", [1e3, 1e6]),
        ("1, 2,3", [1, 2, 3]),
        ("[0,2],[0,4]", [[0, 2], [0, 4]]),
        ("[0,2]", [[0, 2]]),
        ("sine,step", ["sine", "step"]),
        ("'a:1',b:c", ["a:1", "b:c"]),
        ("C:x.mat", ["C:x.mat"]),
        ("[a.fmu,b.fmu#cs]", ["a.fmu", "b.fmu#cs"]),
        ("['a.fmu', \"b.fmu\"]", [["a.fmu", "b.fmu"]]),
        ("log:10:1e4:25", {"log": [10.0, 1e4], "points": 25}),
        ("linear:0:1:11", {"linear": [0.0, 1.0], "points": 11}),
        ("uniform:-1:1", {"uniform": [-1.0, 1.0]}),
        ("log-uniform:1:10", {"log-uniform": [1.0, 10.0]}),
        ("normal:0:0.1", {"normal": [0.0, 0.1]}),
        ("normal:0:1:-2:2", {"normal": [0.0, 1.0], "lower": -2.0, "upper": 2.0}),
        ("lognormal:1:0.1", {"lognormal": [1.0, 0.1]}),
        ("triangular:0:1:2", {"triangular": [0.0, 1.0, 2.0]}),
        ("exponential:2", {"exponential": [2.0]}),
        ("beta:2:3", {"beta": [2.0, 3.0]}),
        ("beta:2:3:0:10", {"beta": [2.0, 3.0], "lower": 0.0, "upper": 10.0}),
        ("weibull:1:2", {"weibull": [1.0, 2.0]}),
        ("choice:1,2,a", {"choice": [1, 2, "a"]}),
        ("tolerance:0.05", {"tolerance": 0.05}),
        ("tolerance:0.05:normal", {"tolerance": 0.05, "distribution": "normal"}),
    ],
)
def test_an_option_is_what_a_file_has(text, value):
    """The list or the table, which is right there."""
    found = read_vary_option(text)
    assert found == value
    if not isinstance(value, list):
        read_variation("a.x", found)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unifrm:0:1", "'unifrm' in 'unifrm:0:1'; did you mean 'uniform'"),
        ("uniform:0:a", "'a' in 'uniform:0:a'"),
        ("log:1:10", "got 'log:1:10'"),
        ("log:1:10:2.5", "expected log:FIRST:LAST:POINTS"),
        ("linear:1:10:inf", "expected linear:FIRST:LAST:POINTS"),
        ("tolerance:x", "'x' in 'tolerance:x'"),
        ("1,,2", "empty one in '1,,2'"),
        ("", "empty one in ''"),
        ("choice:", "empty one in ''"),
    ],
)
def test_options_that_name_no_variation_are_refused(text, message):
    """The message has the text."""
    with pytest.raises(UsageError, match=message):
        read_vary_option(text)
