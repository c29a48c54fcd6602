"""A replay takes the designs of its log: it computes none of them, and trusts no shape."""

import numpy as np
import pytest

import cosim
from cosim.core import linear
from cosim.errors import LogError
from cosim.log.contents.metadata import decode_design, encode_design
from tests.log.crafting import put_together, take_apart

SCENARIO = """
[scenario]
name = "designs"
stop = 0.05
step = 1e-3
[components.u]
kind = "sine"
amplitude = 1.0
rate = 1.0
[components.lag]
kind = "lag"
time_constant = 0.1
[connections]
"lag.u" = "u.y"
"""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Record a run of a linear part, and one of an observer and an identifier."""
    folder = tmp_path_factory.mktemp("logs")
    scenario = folder / "designs.toml"
    scenario.write_text(SCENARIO, encoding="utf-8")
    short = {"scenario.stop": 0.05}
    return {
        "lag": cosim.run(scenario, out=folder / "lag.mcap"),
        "academic": cosim.run("academic", out=folder / "academic.mcap", set=short),
    }


@pytest.mark.parametrize("log", ["lag", "academic"])
def test_nothing_that_is_recorded_is_computed(logs, log, monkeypatch):
    """It would cost what a replay saves, and fail where that fails."""

    def no_discretization(*arguments):
        raise AssertionError("was called")

    monkeypatch.setattr(linear, "first_order_hold", no_discretization)
    assert cosim.diff(logs[log], cosim.replay(logs[log])).equal


@pytest.mark.parametrize(
    ("log", "name", "key"),
    [
        ("lag", "lag", "Ad"),
        ("lag", "lag", "C"),
        ("academic", "observer", "B1"),
        ("academic", "identifier", "times"),
    ],
)
def test_a_recorded_design_of_other_arrays_is_refused(logs, log, name, key, tmp_path, subtests):
    """The kernels that step trust their shapes."""
    for change in ["renamed", "reshaped", "added to"]:
        with subtests.test(change=change):
            content = take_apart(logs[log].path)
            items = dict(content.metadata)[f"cosim.component.{name}"]
            design = dict(decode_design(items["cosim.design"]))
            match change:
                case "renamed":
                    design["other"] = design.pop(key)
                case "reshaped":
                    design[key] = np.append(design[key], 1.0)
                case "added to":
                    design["more"] = design[key]
            items["cosim.design"] = encode_design(design)
            path = put_together(content, tmp_path / "a.mcap")
            with pytest.raises(
                LogError, match=f"'{name}': the recorded design: expected arrays of shapes "
            ):
                cosim.replay(path)
