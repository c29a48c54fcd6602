"""Loops whose gain is not known before the run: they are watched."""

import pytest

import cosim
from cosim.errors import RunawayError
from cosim.report.verification import verify
from tests.fmi.lag import build

SCENARIO = """
scenario = {{ name = "loop", stop = 2.0, step = 0.01, coupling = "jacobi" }}
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


def test_a_loop_of_unknown_gain_that_runs_away_stops_the_run(tmp_path):
    """Other masters return 1e40; here the error names the value, the connections and the factor.

    The FMU, y = x + u without any ability, cannot be linearized. If only warned of, it goes on.
    """
    path = tmp_path / "loop.toml"
    path.write_text(SCENARIO.format(lag=build(tmp_path, "2")))
    with pytest.raises(RunawayError, match=r"diverges.* by a steady factor of ") as error:
        cosim.run(path, out=tmp_path / "x.mcap")
    assert "by two.y -> one.u" in str(error.value)
    assert 'or coupling_check = "warn"' in str(error.value)
    log = cosim.open_log(tmp_path / "x.mcap")
    assert log.status == "failed"
    assert 1e10 < abs(log["one.y"]).max() < 1e13
    assert verify(log, cosim.replay(log)).passed
    warned = cosim.run(path, set={"scenario.coupling_check": "warn"})
    assert abs(warned["one.y"][-1]) > 1e20
