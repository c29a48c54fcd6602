"""The values of --vary."""

import pytest

from cosim.cli.sweeping import read_variations
from cosim.errors import UsageError, shell_language


def test_values_are_toml_where_they_can_be():
    """As those of --set."""
    found = read_variations(["a.x = 1e3, 2", "a.kind=sine,step", "a.L=[[1.0]],[[2.0]]"])
    assert found == {"a.x": [1e3, 2], "a.kind": ["sine", "step"], "a.L": [[[1.0]], [[2.0]]]}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["a.x"], r"--vary 'a\.x': .*no '='"),
        (["a.x=1,,2"], r"--vary a\.x: .*'1,,2'"),
        (["a.x="], r"--vary a\.x: .*''"),
        (["a.x=1", "a.x=2"], r"--vary a\.x: .*given 2 times"),
        (["a.x=" + 200 * "[" + 200 * "]"], r"--vary a\.x: .*nested"),
    ],
)
def test_wrong_values_are_refused(texts, message):
    """The message names the key."""
    with shell_language(), pytest.raises(UsageError, match=message):
        read_variations(texts)
