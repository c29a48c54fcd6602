"""Loops whose gain is not known before the run: they are watched."""

import pytest

import cosim
from cosim.errors import RunawayError
from cosim.log import Log
from cosim.report.verification import verify
from tests.fmi.lag import build

SCENARIO = """
[scenario]
name = "loop"
stop = 2.0
step = 0.01
coupling = "jacobi"
{check}
[components]
one = {{ kind = "fmu", path = "{lag}" }}
two = {{ kind = "fmu", path = "{lag}" }}
zero = {{ kind = "constant", value = 0.0 }}
begin = {{ kind = "constant", value = 1.0 }}
[connections]
"one.u" = {{ from = ["two.y", "begin.y"], gain = [[2.0, 1.0]] }}
"two.u" = {{ from = "one.y", gain = -2.0 }}
"one.d" = "zero.y"
"two.d" = "zero.y"
"""


@pytest.fixture(scope="module")
def lag(tmp_path_factory):
    """Build y = x + u without any ability: it cannot be linearized."""
    return build(tmp_path_factory.mktemp("lag"), "2")


def scenario(tmp_path, lag, check=""):
    path = tmp_path / "loop.toml"
    path.write_text(SCENARIO.format(lag=lag, check=check))
    return path


def test_a_loop_of_unknown_gain_that_runs_away_stops_the_run(tmp_path, lag):
    """Other masters return 1e40; here the error names the value, the connections and the factor."""
    with pytest.raises(RunawayError) as error:
        cosim.run(scenario(tmp_path, lag), out=tmp_path / "x.mcap")
    text = str(error.value)
    assert "diverges" in text
    assert "after growth by a steady factor of " in text
    assert "by two.y -> one.u" in text
    assert 'or coupling_check = "warn"' in text
    log = Log(tmp_path / "x.mcap")
    assert log.status == "failed"
    assert 1e10 < abs(log["one.y"]).max() < 1e13
    assert verify(log, cosim.replay(log)).passed


def test_a_run_that_is_only_warned_goes_on(tmp_path, lag):
    memory = cosim.run(scenario(tmp_path, lag, 'coupling_check = "warn"'))
    assert abs(memory["one.y"][-1]) > 1e20
