"""What is tried before the first task of a cluster: a member that is built and not run."""

import math

import pytest

from cosim.studies.cluster.opening import TRIAL, open_trying_runner
from cosim.studies.contracts import COMPLETE, FAILED, StudyMember, StudySubject

LAG = """
scenario = { name = "lag", stop = 0.5, step = 1e-2 }
[components]
u = { kind = "constant", value = 2.0 }
plant = { kind = "lag", time_constant = 0.2, initial = 0.0 }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture
def runner(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    subject = StudySubject(str(path), metrics={"last": "last(plant.y)"})
    with open_trying_runner(subject) as runner:
        yield runner


def test_a_trial_is_built_and_members_are_run(runner):
    """The trial takes no step; a member ends at y = 2 (1 - exp(-stop / time_constant))."""
    trial = runner.run(StudyMember(TRIAL))
    assert (trial.number, trial.status, trial.steps, trial.metrics) == (TRIAL, COMPLETE, 0, {})
    member = runner.run(StudyMember(0))
    assert (member.number, member.status, member.steps) == (0, COMPLETE, 50)
    assert member.metrics["last"] == pytest.approx(2.0 * (1.0 - math.exp(-2.5)), rel=1e-12)


def test_a_trial_that_cannot_be_built_says_why(runner):
    """As the member would."""
    changes = {"plant.time_constant": -1.0}
    trial, member = (runner.run(StudyMember(number, changes)) for number in (TRIAL, 0))
    assert (trial.status, trial.reason) == (FAILED, member.reason)
    assert "time_constant" in trial.reason
