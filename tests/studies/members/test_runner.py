"""Members run one after the other, each as it does alone."""

import subprocess
import sys
from dataclasses import replace

import pytest

import cosim
from cosim.core.contracts import Block
from cosim.errors import CosimError, Interrupted, ScenarioError, UsageError
from cosim.fmi.platforms import SUFFIX, folders
from cosim.report.summary import summarize
from cosim.report.sweep import results_of
from cosim.scenario.exporting import export_component
from cosim.studies.cluster.opening import TRIAL, open_trying_runner
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.members.logging_runner import open_logging_runner
from cosim.studies.members.lone_runner import open_lone_runner
from cosim.studies.members.measuring import MemberRecorder
from cosim.studies.members.runner import open_runner
from tests.fmi.compiled import write_archive
from tests.fmi.small import xml
from tests.scenario.test_runs import lagging
from tests.studies.members.common import common_designs
from tests.studies.members.sinks import Digest

LAG = """
scenario = { name = "lag", stop = 0.5, step = 1e-2 }
[components]
u = { kind = "sine", amplitude = 2.0, rate = 3.0 }
plant = { kind = "lag", time_constant = 0.2, initial = 1.0 }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture
def lag(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return str(path)


def alone(scenario, changes, **edits):
    """Return the digest of a run without a study."""
    return cosim.run(scenario, set=changes, recorder=Digest(), **edits).values()["digest"]


def digest_of(memory):
    """Return the digest of a run that was kept in memory."""
    digest = Digest()
    digest.begin(memory.plan)
    rows, times, _ = memory._table
    digest.write(Block(0, times, times / 1e9, 1e-3), rows)
    return digest.values()["digest"]


def outcomes(subject, *members):
    with open_runner(subject, sink_of=Digest) as runner:
        return [runner.run(member) for member in members]


def test_members_have_the_bits_of_runs_of_their_own(lag):
    """The edits of all members come first, then those of each."""
    subject = StudySubject(lag, set={"u.amplitude": 3.0, "plant.initial": 0.0})
    first, second = outcomes(
        subject, StudyMember(0, {"plant.initial": 2.0}), StudyMember(7, {"u.rate": 5.0})
    )
    assert (first.number, first.status, first.reason, first.steps) == (0, "complete", "", 50)
    assert first.metrics["digest"] == alone(lag, {"u.amplitude": 3.0, "plant.initial": 2.0})
    changes = {"u.amplitude": 3.0, "plant.initial": 0.0, "u.rate": 5.0}
    assert second.number == 7
    assert second.metrics["digest"] == alone(lag, changes)


def test_the_metrics_of_a_member_are_those_of_its_run(lag):
    """By their names; None: one has no value."""
    metrics = {"last": "last(plant.y)", "crossing": "first(t, plant.y > 1e3)"}
    with open_runner(StudySubject(lag, metrics=metrics)) as runner:
        for rate in (2.0, 3.0):
            memory = cosim.run(lag, set={"u.rate": rate})
            outcome = runner.run(StudyMember(0, {"u.rate": rate}))
            assert outcome.metrics == {"last": memory["plant.y"][-1], "crossing": None}


def test_metrics_that_cannot_be_computed_are_refused(lag):
    """What is no metric before any member; a signal that is not there is the member's failure."""
    with pytest.raises(UsageError, match="x: "):
        open_runner(StudySubject(lag, metrics={"x": "plant.y"}))
    with open_runner(StudySubject(lag, metrics={"x": "last(plant.z)"})) as runner:
        outcome = runner.run(StudyMember(0))
    assert outcome.status == "failed"
    assert "plant.z" in outcome.reason


@pytest.mark.slow
def test_a_member_has_the_bits_of_a_fresh_process(lag):
    """By the command that runs it alone."""
    [outcome] = outcomes(StudySubject(lag), StudyMember(0, {"plant.time_constant": 0.1}))
    command = [sys.executable, "-m", "tests.studies.members.sinks", lag, "plant.time_constant=0.1"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert outcome.metrics["digest"] == done.stdout.strip()


def test_a_member_that_cannot_be_built_fails_with_its_reason(lag):
    """The reason is what a run says of it; the next member is as it is alone."""
    subject = StudySubject(lag)
    wrong = {"plant.time_constant": -1.0}
    failed, fine = outcomes(subject, StudyMember(0, wrong), StudyMember(1, {"u.rate": 2.0}))
    with pytest.raises(CosimError) as error:
        cosim.run(lag, set=wrong)
    assert (failed.status, failed.steps) == ("failed", 0)
    assert failed.reason == str(error.value)
    assert "plant.time_constant" in failed.reason
    assert fine.metrics["digest"] == alone(lag, {"u.rate": 2.0})


def test_members_run_where_what_they_have_in_common_does_not(lag):
    """The value that is wrong is one that each of them has another for."""
    subject = StudySubject(lag, set={"plant.time_constant": -1.0})
    members = [StudyMember(n, {"plant.time_constant": 0.1 * (1 + n)}) for n in range(2)]
    for outcome, member in zip(outcomes(subject, *members), members, strict=True):
        assert outcome.metrics["digest"] == alone(lag, member.set)
    assert common_designs(subject) == ""


def test_a_run_that_fails_is_a_failure_with_its_reason(lag):
    """The steps before it are counted; metrics of a part of a run are none."""
    subject = StudySubject(lag, metrics={"largest": "max(plant.y)"})
    overflow = {"u.amplitude": 1e308, "u.bias": 1.7e308}
    failed, fine = outcomes(subject, StudyMember(0, overflow), StudyMember(1))
    with pytest.raises(CosimError) as error:
        cosim.run(lag, set=overflow)
    assert failed.status == "failed"
    assert failed.reason == str(error.value)
    assert 0 <= failed.steps < 50
    assert failed.metrics == {"largest": None}
    assert fine.metrics["digest"] == alone(lag, {})


def test_a_regular_end_before_the_stop_is_complete_with_its_reason(lag):
    """As ``until`` asks for it."""
    until = {"scenario.until": "plant.y < 0.9"}
    [outcome] = outcomes(StudySubject(lag), StudyMember(0, until))
    memory = cosim.run(lag, set=until)
    assert (outcome.status, outcome.reason) == ("complete", memory.reason)
    assert "came true" in outcome.reason
    assert outcome.steps == memory.steps < 50


@pytest.mark.slow
def test_the_result_of_a_run_is_kept_beside_its_metrics():
    """With the names and values that a sweep has."""
    changes = {"scenario.stop": 1.0, "plant.x_a0": [0.5, -1.0]}
    subject = StudySubject("academic", set={"scenario.stop": 1.0}, with_results=True)
    [outcome] = outcomes(subject, StudyMember(0, {"plant.x_a0": [0.5, -1.0]}))
    results = results_of(summarize(cosim.run("academic", set=changes)))
    assert {**results, "digest": alone("academic", changes)} == outcome.metrics
    assert "observer.delta rms error" in outcome.metrics


@pytest.mark.slow
def test_members_replay_recordings(tmp_path):
    """Each its own log, with the values of the member; the log is opened once."""
    logs = []
    for number in range(2):
        path = str(tmp_path / f"{number}.mcap")
        cosim.run("academic", set={"scenario.stop": 0.25, "u.rate": 1.0 + number}, out=path)
        logs.append(path)
    subject = StudySubject("academic", set={"observer.filter_rate": 500.0})
    members = [
        StudyMember(number, {"observer.L": [3.0 + number, 0.0]}, recording=logs[number % 2])
        for number in range(3)
    ]
    found = outcomes(subject, *members)
    for member, outcome in zip(members, found, strict=True):
        again = cosim.replay(member.recording, set={**subject.set, **member.set})
        assert (outcome.status, outcome.steps) == ("complete", 250)
        assert outcome.metrics["digest"] == digest_of(again)


def test_a_recording_that_is_not_there_is_a_failure(tmp_path):
    """With its path."""
    missing = str(tmp_path / "x.mcap")
    [outcome] = outcomes(StudySubject("academic"), StudyMember(0, recording=missing))
    assert outcome.status == "failed"
    assert missing in outcome.reason


def test_a_scenario_that_is_not_there_is_refused():
    """Before any member."""
    with pytest.raises(ScenarioError, match="unknown scenario 'acadmic'"):
        open_runner(StudySubject("acadmic"))


def test_an_interruption_is_no_outcome(lag):
    """It ends the study, not the member alone."""

    class Interrupting(Digest):
        def write(self, block, signals):
            raise Interrupted("interrupted by the user")

    with (
        open_runner(StudySubject(lag), sink_of=Interrupting) as runner,
        pytest.raises(Interrupted),
    ):
        runner.run(StudyMember(0))


def test_reasons_do_not_tell_where_an_fmu_was_unpacked(tmp_path):
    """A temporary folder has another name each time; rows of a dataset must not."""
    platform = folders("2.0")[0]
    content = {"modelDescription.xml": xml(D=0.0), f"binaries/{platform}/model{SUFFIX}": b"?"}
    fmu = write_archive(tmp_path / "broken.fmu", content)
    scenario = tmp_path / "broken.toml"
    scenario.write_text(
        'scenario = { name = "broken", stop = 1.0, step = 0.1 }\n[components]\n'
        f'plant = {{ kind = "fmu", path = "{fmu}" }}\nu = {{ kind = "constant", value = 1.0 }}\n'
        '[connections]\n"plant.u" = "u.y"\n'
    )
    reasons = set()
    for opener in (open_runner, open_runner, open_logging_runner, open_lone_runner):
        with opener(StudySubject(str(scenario), logs=str(tmp_path))) as runner:
            reasons.add(runner.run(StudyMember(0)).reason)
    with open_trying_runner(StudySubject(str(scenario))) as runner:
        reasons.add(runner.run(StudyMember(TRIAL)).reason)
    [reason] = reasons
    assert f"cannot be used: binaries/{platform}/model{SUFFIX}: " in reason


@pytest.mark.parametrize("rate", [10.0, 900.0])
def test_the_warnings_of_a_member_are_those_of_its_run(rate, tmp_path):
    """In a graph that is kept, with its log, alone: whatever the base of the study warns of."""
    edits = {
        "scenario.input_interpolation": "zero-order",
        "scenario.stop": 0.05,
        "observer.filter": "first-order",
    }
    subject = StudySubject("academic", set=edits, metrics={"e": "rms(plant.y)"})
    member = StudyMember(1, set={"observer.filter_rate": rate})
    run = cosim.run("academic", set={**edits, **member.set})
    texts = [f"{warning.source}: {warning.text}" for warning in run.warnings]
    assert len(texts) == (2 if rate > 100.0 else 0)
    logged = replace(subject, logs=str(tmp_path))
    for opener, given in (
        (open_runner, subject),
        (open_lone_runner, subject),
        (open_logging_runner, logged),
    ):
        with opener(given) as runner:
            outcome = runner.run(member)
            assert (outcome.status, outcome.warnings) == ("complete", texts)


@pytest.mark.slow
def test_a_warning_at_every_step_hides_no_other():
    """Each text counts once among those that are kept."""
    measured = MemberRecorder(Digest())
    for step in range(5000):
        measured.message(step, "warning", "plant", "stiff")
    measured.message(5000, "warning", "plant", "left its range")
    assert measured.warnings == ["plant: left its range", "plant: stiff"]


def test_the_warnings_of_an_fmu_are_those_of_each_member(tmp_path):
    """It steps by 0.01 s whatever it is asked for: what it does not do, each run finds out."""
    scenario = lagging(tmp_path, "{ inner = 0.01 }")
    run = cosim.run(scenario)
    texts = sorted(f"{warning.source}: {warning.text}" for warning in run.warnings)
    assert any("inner step" in text for text in texts)
    subject = StudySubject(str(scenario), metrics={"last": "last(lag.y)"})
    with open_runner(subject) as runner:
        for number in (0, 1):
            assert runner.run(StudyMember(number)).warnings == texts


@pytest.mark.slow
def test_the_warnings_of_a_swap_have_the_numbers_of_each_member(tmp_path):
    """Poles of what is replaced follow from what is varied."""
    path = tmp_path / "heavy.fmu"
    export_component("pair", "motor", path, set={"models.motor.E[0][0]": 0.04})
    swap = {"motor": str(path)}
    subject = StudySubject(
        "pair", swap=swap, set={"scenario.stop": 0.05}, metrics={"y": "last(motor.y)"}
    )
    with open_runner(subject) as runner, open_lone_runner(subject) as alone:
        for number, inertia in enumerate((0.02, 0.08)):
            member = StudyMember(number, set={"models.motor.E[0][0]": inertia})
            (text,) = runner.run(member).warnings
            assert text.endswith(f"poles -0.5 (was {-0.02 / inertia:g})")
            assert alone.run(member).warnings == [text]
