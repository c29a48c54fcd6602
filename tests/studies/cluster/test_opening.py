"""What is tried before the first task of a cluster: a member that is built and not run."""

import math

import pytest

from cosim.studies.cluster.opening import TRIAL, open_trying_runner
from cosim.studies.contracts import COMPLETE, FAILED, StudyMember, StudySubject
from tests.studies.tuning.lags import LAG


@pytest.fixture
def runner(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    subject = StudySubject(str(path), metrics={"last": "last(plant.y)"})
    with open_trying_runner(subject) as runner:
        yield runner


def test_a_trial_is_built_and_members_are_run(runner):
    """The trial takes no step; a member ends at y = 1 - exp(-stop / time_constant)."""
    trial = runner.run(StudyMember(TRIAL))
    assert (trial.number, trial.status, trial.steps, trial.metrics) == (TRIAL, COMPLETE, 0, {})
    member = runner.run(StudyMember(0))
    assert (member.number, member.status, member.steps) == (0, COMPLETE, 200)
    assert member.metrics["last"] == pytest.approx(1.0 - math.exp(-2.0 / 0.7), rel=1e-12)


def test_a_trial_that_cannot_be_built_says_why(runner):
    """As the member would."""
    changes = {"plant.time_constant": -1.0}
    trial, member = (runner.run(StudyMember(number, changes)) for number in (TRIAL, 0))
    assert (trial.status, trial.reason) == (FAILED, member.reason)
    assert "time_constant" in trial.reason
