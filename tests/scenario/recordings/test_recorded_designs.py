"""A replay takes the designs of its log: it computes none of them, and trusts no shape."""

import numpy as np
import pytest

import cosim
from cosim.core import linear
from cosim.errors import LogError
from cosim.log.contents.metadata import decode_design, encode_design
from tests.log.crafting import put_together, take_apart


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run of an observer and an identifier, with a linear part beside them."""
    changes = {
        "scenario.stop": 0.05,
        "components.lag": {"kind": "lag", "time_constant": 0.1},
        "connections.lag.u": "u.y",
    }
    return cosim.run("academic", out=tmp_path_factory.mktemp("log") / "a.mcap", set=changes)


def test_nothing_that_is_recorded_is_computed(log, monkeypatch):
    """It would cost what a replay saves, and fail where that fails."""

    def no_discretization(*arguments):
        raise AssertionError("was called")

    monkeypatch.setattr(linear, "first_order_hold", no_discretization)
    assert cosim.diff(log, cosim.replay(log)).equal


def rename(design, key):
    design["other"] = design.pop(key)


def reshape(design, key):
    design[key] = np.append(design[key], 1.0)


def add(design, key):
    design["more"] = design[key]


@pytest.mark.parametrize("change", [rename, reshape, add])
@pytest.mark.parametrize(
    ("name", "key"), [("lag", "Ad"), ("observer", "B1"), ("identifier", "times")]
)
def test_a_recorded_design_of_other_arrays_is_refused(log, name, key, change, tmp_path):
    """The kernels that step trust their shapes."""
    content = take_apart(log.path)
    items = dict(content.metadata)[f"cosim.component.{name}"]
    design = dict(decode_design(items["cosim.design"]))
    change(design, key)
    items["cosim.design"] = encode_design(design)
    path = put_together(content, tmp_path / "a.mcap")
    with pytest.raises(LogError, match=f"'{name}': the recorded design: expected arrays of shapes"):
        cosim.replay(path)
