"""Loops of scenarios that iterate: their logs are replayed bit for bit."""

import pytest

import cosim
from cosim.report.verification import verify

NEWTON = {"scenario.coupling": "newton", "scenario.stop": 0.5}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Run the closed loop with Newton's method."""
    path = tmp_path_factory.mktemp("newton") / "newton.mcap"
    return cosim.run("closed-loop", set=NEWTON, out=path)


def test_a_replay_is_verified(log):
    """What was solved for is taken from the log, as the plant does not answer."""
    verification = verify(log, cosim.replay(log))
    assert verification.passed, verification.problems
    assert "plant.x_a" in verification.copied


@pytest.mark.parametrize("block", [1, 7])
def test_blocks_do_not_matter(log, block):
    """Of any length."""
    again = cosim.run("closed-loop", set=NEWTON, block=block)
    for signal in log:
        assert again[signal].tobytes() == log[signal].tobytes(), signal


def test_the_coupling_error_is_a_hundredth_of_that_of_gauss_seidel(log):
    """At 1 ms; beside a run of Newton's method with a tenth of the step."""
    finest = cosim.run("closed-loop", set={**NEWTON, "scenario.step": 1e-4})["plant.x_a"][::10]
    ordinary = cosim.run("closed-loop", set={"scenario.stop": 0.5})["plant.x_a"]
    assert abs(log["plant.x_a"] - finest).max() < 0.01 * abs(ordinary - finest).max()
