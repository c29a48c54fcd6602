"""Loops of scenarios that iterate: their logs are replayed bit for bit."""

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.verification import verify
from tests.scenario import certified
from tests.scenario.certified import write

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


@pytest.mark.slow
def test_the_coupling_error_is_a_hundredth_of_that_of_gauss_seidel(log):
    """At 1 ms; beside a run of Newton's method with a tenth of the step."""
    finest = cosim.run("closed-loop", set={**NEWTON, "scenario.step": 1e-4})["plant.x_a"][::10]
    ordinary = cosim.run("closed-loop", set={"scenario.stop": 0.5})["plant.x_a"]
    assert abs(log["plant.x_a"] - finest).max() < 0.01 * abs(ordinary - finest).max()


def test_a_loop_that_cannot_be_solved_is_reported_at_its_key(tmp_path):
    """Not at the connections, which are as good as any."""
    write(tmp_path, certified.RELAY)
    path = tmp_path / "small.toml"
    path.write_text(path.read_text().replace("step = 0.01", 'step = 0.01\ncoupling = "newton"'))
    with pytest.raises(ScenarioError) as caught:
        cosim.run(path)
    begin = f"{path}:5: scenario.coupling: expected 'gauss-seidel' or 'jacobi' with 1 iteration, "
    assert str(caught.value).startswith(begin)
    assert "relay in this loop cannot go back to the start of a step (rollback is not" in str(
        caught.value
    )
    with pytest.raises(
        ScenarioError, match=r"scenario\.iterations'\]: .*coupling = 'newton'.*got 3"
    ):
        cosim.run("closed-loop", set={**NEWTON, "scenario.iterations": 3})
