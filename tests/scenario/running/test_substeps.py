"""Substeps in scenarios: what is refused and reported, logs, replays."""

import re

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.log import Log
from cosim.log.messages import decode_substep, encode_substep
from cosim.report.inspection import describe_log
from cosim.report.summary import summarize
from cosim.report.verification import verify
from cosim.scenario.building.coupling import gain_text
from cosim.scenario.record import recorded_loop_gains
from tests.log.crafting import put_together, take_apart
from tests.scenario.refusals import check_refused

PAIR = """
[scenario]
name = "pair"
stop = 0.1
step = 1e-2
coupling = "newton"
substeps = { rtol = 1e-5, atol = 1e-5, min = 1e-6 }

[components]
one = { kind = "controller", A = [[-0.9]], B = [[0.5]], C = [[3.0]], D = [[1.0]], x0 = [1.0] }
two = { kind = "controller", A = [[-1.0]], B = [[10.0]], C = [[-31.0]], D = [[-0.9]], x0 = [1.0] }

[connections]
"one.u" = "two.y"
"two.u" = "one.y"
"""


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Write the scenario."""
    path = tmp_path_factory.mktemp("pair") / "pair.toml"
    path.write_text(PAIR)
    return path


@pytest.fixture(scope="module")
def log(pair):
    """Return the log of its run."""
    return cosim.run(pair, out=pair.with_name("x.mcap"))


def test_a_run_with_substeps_is_replayed_bit_for_bit(log, tmp_path):
    """With the same substeps, all computed again."""
    again = cosim.replay(log, out=tmp_path / "y.mcap")
    verification = verify(log, again)
    assert verification.passed, verification.problems
    assert not verification.copied
    assert "/cosim/step" not in " ".join(verification.lines)
    assert Log(tmp_path / "y.mcap").substeps() == log.substeps() != []


@pytest.mark.slow
def test_a_replay_takes_the_substeps_of_recorded_components(tmp_path):
    """The plant of the closed loop is taken from the log; the others are computed again."""
    substeps = {"rtol": 1e-6, "atol": 1e-6, "min": 1e-5}
    coupled = {"scenario.coupling": "newton", "scenario.substeps": substeps}
    changes = {**coupled, "scenario.stop": 0.05, "scenario.step": 1e-2}
    log = cosim.run("closed-loop", set=changes, out=tmp_path / "x.mcap")
    again = cosim.replay(log, out=tmp_path / "y.mcap")
    verification = verify(log, again)
    assert verification.passed, verification.problems
    (text,) = [line for line in verification.lines if "/cosim/step" in line]
    assert "outputs of plant" in text
    assert Log(tmp_path / "y.mcap").substeps() == log.substeps() != []


def with_changed_substep(log, path, number):
    """Add 1/8 to the value ``number`` of the third substep that was taken; return that log."""
    content = take_apart(log.path)
    (channel,) = [key for key, item in content.channels.items() if item[0] == "/cosim/step"]
    taken = 0
    messages = []
    for of, time_ns, sequence, data in content.messages:
        changed = data
        if of == channel:
            substep = decode_substep(data)
            taken += substep.accepted
            if taken == 3 and substep.accepted:
                values = np.array(substep.values)
                values[number] += 0.125
                changed = encode_substep(substep._replace(values=tuple(values.tolist())))
        messages.append((of, time_ns, sequence, changed))
    content.messages = messages
    put_together(content, path)
    return Log(path)


def test_a_changed_value_of_a_substep_is_found(log, tmp_path):
    """Also one that nothing follows from: the rows of the replay are those of the log."""
    for number in range(len(log.substeps()[-1].values)):
        changed = with_changed_substep(log, tmp_path / f"{number}.mcap", number)
        problems = verify(changed, cosim.replay(changed)).problems
        assert len(problems) == 1
        assert "substeps.loop of 'one' at t = 0.0" in problems[0]
        assert f".values.{number}: " in problems[0]


def test_reports_count_substeps(log):
    """As many as were recorded."""
    (counts,) = summarize(log).substeps
    accepted = [substep for substep in log.substeps() if substep.accepted]
    assert (counts.components, counts.accepted) == (("one", "two"), len(accepted))
    assert (counts.rejected, counts.missed) == (len(log.substeps()) - len(accepted), 0)
    assert counts.shortest == min(substep.length for substep in accepted)
    (row,) = describe_log(str(log.path))["substeps"]
    assert (row["loop"], row["taken"]) == ("one, two", counts.accepted)


def test_a_run_says_that_substeps_miss_the_tolerance(pair):
    """They would have to be shorter than they may be."""
    memory = cosim.run(pair, set={"scenario.substeps.min": 1e-3})
    (counts,) = summarize(memory).substeps
    assert counts.missed > 0
    (warning,) = [message for message in memory.messages() if message.level == "warning"]
    assert warning.source == "one"
    assert f"{counts.missed} of {counts.accepted} substeps miss the tolerance" in warning.text


def test_a_coupling_is_refused_only_if_the_shortest_substep_is(pair):
    """Jacobi is stable below 0.61 ms here; see the loop gain."""
    changes = {"scenario.coupling": "jacobi", "scenario.substeps.rtol": 1e-2}
    stable = cosim.run(pair, set={**changes, "scenario.substeps.min": 1e-4})
    assert abs(stable["one.x"]).max() < 2.0
    (gain,) = recorded_loop_gains(stable)
    assert (gain.parts, gain.steps) == (64, 640)
    assert re.fullmatch(r"0\.\d+ per smallest substep allowed, 0.00015625 s .*", gain_text(gain))
    with pytest.raises(
        ScenarioError, match=r"'jacobi' amplifies .* 1\.202 per substep of 0\.0025 s"
    ):
        cosim.run(pair, set={**changes, "scenario.substeps.min": 2e-3})


def test_substeps_that_no_loop_takes_change_nothing_and_say_so():
    memory = cosim.run("academic", set={"scenario.stop": 0.05, "scenario.substeps.rtol": 1e-3})
    (warning,) = [message for message in memory.messages() if message.source == "scenario.substeps"]
    assert warning.text == "there is no loop that takes any, so that they change nothing"
    assert memory.substeps() == []


@pytest.mark.parametrize("how", [{"certify": True}, {"find_step": {"two.x": 1e-4}}])
def test_a_certificate_of_chosen_steps_is_refused(pair, how):
    """Halves of the communication step would show nothing of the error."""
    with pytest.raises(UsageError, match=r"loops choose their steps by scenario.substeps"):
        cosim.run(pair, **how)


WRONG = [
    ({"min": 0.02}, r"\A.*min: expected at most 0.005 s, .*got 0.02 s\Z"),
    ({"min": 1e-10}, r"\A.*1e-10 s is not a whole number of nanoseconds.*\Z"),
    ({"min": 0.0}, r"\A.*scenario\.substeps\.min'\]: expected a number > 0, got 0\.0\Z"),
    ({"rtol": -1.0}, r"\A.*scenario.substeps.rtol'\]: expected a number >= 0, got -1.0\Z"),
    ({"atol": "small"}, r"\A.*scenario.substeps.atol'\]: .*small.*\Z"),
    ({"max": 1.0}, r"\A.*scenario.substeps.max.*\Z"),
]


def test_wrong_substeps_are_refused(pair):
    """Each by its key, once."""

    def run(keys):
        cosim.run(pair, set={f"scenario.substeps.{key}": value for key, value in keys.items()})

    check_refused(WRONG, run, ScenarioError)
