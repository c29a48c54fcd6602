"""Timed actions of a scenario: what happens, what is refused before the run, what is recorded."""

import re

import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.report.inspection import describe_log, describe_scenario
from cosim.report.verification import verify
from tests.scenario.actions.replays import verified_replay

BASE = """
[scenario]
name = "acted"
stop = 4.0
step = 0.1

[components.s]
kind = "sine"
rate = 1.0
offset = 1.0

[components.two]
kind = "constant"
value = [1.0, 2.0]

[components.g]
kind = "gain"
K = [[2.0, 0.0], [0.0, 3.0]]

[components.x]
kind = "lag"
time_constant = 0.5

[components.log]
kind = "lag"
time_constant = 0.5

[connections]
"g.u" = "two.y"
"x.u" = "s.y"
"log.u" = "s.y"
"""
ACTIONS = """
[[actions]]
at = 1.0
signal = "x.u"
offset = 0.5

[[actions]]
at = 1.0
signal = "g.u"
noise = [0.1, 0.2]
seed = 3

[[actions]]
at = 2.0
signal = ["x.u", "log.u"]
delay = 0.3

[[actions]]
at = 2.5
signal = "g.u[1]"
override = 7.0

[[actions]]
at = 3.0
signal = "x.u"
release = true
"""


def test_actions_change_signals_at_their_instants(write):
    """The row of the instant has the value before; the next ones what the action says."""
    run = cosim.run(write())
    s = run["s.y"]
    x = run["x.u"]
    assert (x[:11] == s[:11]).all()
    assert (x[11:21] == s[11:21] + 0.5).all()
    assert x[21:23].tolist() == [s[20]] * 2
    assert (x[23:31] == s[20:28]).all()
    assert (x[31:] == s[31:]).all()
    late = run["log.u"]
    assert (late[23:] == s[20:-3]).all()
    g = run["g.u"]
    assert (g[:11] == [1.0, 2.0]).all()
    noise = g[11:] - [1.0, 2.0]
    assert (noise[:, 0] != 0.0).all()
    assert (g[26:, 1] == 7.0).all()


def test_every_action_is_an_event_with_its_cause(write):
    """With what is known of it; what followed at once comes behind."""
    events = cosim.run(write()).events()
    own = [(e.time_ns / 1e9, e.cause, e.signal, e.parameters) for e in events]
    own = [event for event in own if event[1] != "follow"]
    assert own == [
        (1.0, "offset", "x.u", (0.5,)),
        (1.0, "noise", "g.u", (0.1, 3.0, 0.2, 3.0)),
        (2.0, "delay", "x.u", (3.0,)),
        (2.0, "delay", "log.u", (3.0,)),
        (2.5, "override", "g.u[1]", ()),
        (3.0, "release", "x.u", ()),
    ]
    assert {event.signal for event in events if event.cause == "follow"} == {"g.y"}


@pytest.mark.parametrize("block", [1, 3, None])
def test_the_rows_depend_on_no_block_size(write, tmp_path, block):
    """One content hash; a replay follows the recorded actions, bit for bit."""
    log = cosim.run(write(), out=tmp_path / "a.mcap", block=block)
    assert log.recorded_hash == cosim.run(write(), out=tmp_path / "b.mcap").recorded_hash
    verified_replay(log)


def test_a_session_performs_the_actions_too(write):
    """At the instants, whatever the steps by hand."""
    run = cosim.run(write())
    with cosim.load(write()).start() as sim:
        rows = sim.step(37)
    for name in ("x.u", "g.u", "g.y", "x.y"):
        assert rows[name].squeeze().tolist() == run[name][1:38].tolist()


def test_a_replay_may_end_before_the_actions_do(write, tmp_path):
    """It follows those up to its end."""
    log = cosim.run(write(), out=tmp_path / "a.mcap")
    again = cosim.replay(log, set={"scenario.stop": 2.2})
    assert again["x.u"].tolist() == log["x.u"][:23].tolist()


def test_a_replay_keeps_the_actions(write, tmp_path):
    """They are recorded; another fault is another run."""
    log = cosim.run(write(), out=tmp_path / "a.mcap")
    with pytest.raises(
        UsageError, match=r"set.*actions.0.offset.*: a replay repeats the recorded actions"
    ):
        cosim.replay(log, set={"actions.0.offset": 1.0})


def test_actions_are_set_from_outside(write):
    """By their number; the log carries the change."""
    run = cosim.run(write(), set={"actions.0.offset": 0.25, "actions.0.at": 0.5})
    assert (run["x.u"][6:21] == run["s.y"][6:21] + 0.25).all()
    plain = cosim.run(write(), set={"actions": []})
    assert plain.events() == []
    assert (plain["x.u"] == plain["s.y"]).all()
    more = [{"at": 1.0, "signal": "x.u", "freeze": True}]
    frozen = cosim.run(write(""), set={"actions": more})
    assert (frozen["x.u"][11:] == frozen["s.y"][10]).all()


CASES = {
    "no time": (
        'signal = "x.u"\noffset = 1.0',
        r":32: actions\[0\]: expected .*'at' .*'when' .*, got neither$",
    ),
    "time and condition": (
        'at = 1.0\nwhen = "s.y > 1"\nsignal = "x.u"\noffset = 1.0',
        r":32: actions\[0\]: expected .*'at' .*'when' .*, got both$",
    ),
    "condition on an unknown signal": (
        'when = "s.z > 1"\nsignal = "x.u"\noffset = 1.0',
        r":33: actions\[0\]\.when: condition 's\.z > 1': .*'s\.z'",
    ),
    "no condition": (
        'when = "s.y + 1"\nsignal = "x.u"\noffset = 1.0',
        r"actions\[0\]\.when: ",
    ),
    "no signal": (
        "at = 1.0\noffset = 1.0",
        r"actions\[0\]: 'signal' is missing; expected an input",
    ),
    "nothing that happens": (
        'at = 1.0\nsignal = "x.u"',
        r"actions\[0\]: expected .* one of override, freeze, offset, .*, got none$",
    ),
    "two things": (
        'at = 1.0\nsignal = "x.u"\noffset = 1.0\nfreeze = true',
        r"actions\[0\]: expected .* one of override, .*, got freeze and offset$",
    ),
    "unknown key": (
        'at = 1.0\nsignal = "x.u"\nofset = 1.0',
        r":35: actions\[0\]\.ofset: unknown key 'ofset'; did you mean 'offset'\? Available: at, ",
    ),
    "unknown signal": (
        'at = 1.0\nsignal = "x.v"\noffset = 1.0',
        r":34: actions\[0\]\.signal: 'x\.v': 'x' has no input 'v'; available: u$",
    ),
    "unknown component": (
        'at = 1.0\nsignal = "xx.u"\noffset = 1.0',
        r"actions\[0\]\.signal: 'xx\.u': .*no component 'xx'; did you mean 'x'\?",
    ),
    "output": (
        'at = 1.0\nsignal = "s.y"\noffset = 1.0',
        r"actions\[0\]\.signal: 's\.y': expected an input of 's', got an output; available: none; "
        r"'s\.y' drives x\.u, log\.u$",
    ),
    "element": (
        'at = 1.0\nsignal = "g.u[2]"\noffset = 1.0',
        r"actions\[0\]\.signal: 'g\.u\[2\]': 'g\.u' has 2 elements, numbered from 0",
    ),
    "after the end": (
        'at = 4.0\nsignal = "x.u"\noffset = 1.0',
        r":33: actions\[0\]\.at: expected a time < 4\.0 s .*, got 4\.0 s",
    ),
    "before the start": (
        'at = -1.0\nsignal = "x.u"\noffset = 1.0',
        r"actions\[0\]\.at: expected a time >= 0\.0 s .*, got -1\.0 s",
    ),
    "between communication points": (
        'at = 1.05\nsignal = "x.u"\noffset = 1.0',
        r"actions\[0\]\.at: 1\.05 s is not a whole number of 0\.1 s steps; nearest: 1\.0 s",
    ),
    "size of an override": (
        'at = 1.0\nsignal = "g.u"\noverride = [1.0, 2.0, 3.0]',
        r"actions\[0\]\.override: override of 'g\.u': expected 2 values.*, got 3 values$",
    ),
    "true in place of a number": (
        'at = 1.0\nsignal = "x.u"\noverride = true',
        r":35: actions\[0\]\.override: override of 'x\.u': expected numbers, got true or false",
    ),
    "size of an offset": (
        'at = 1.0\nsignal = "g.u"\noffset = [1.0, 2.0, 3.0]',
        r"actions\[0\]\.offset: expected 2 values .*, got 3$",
    ),
    "delay off the grid": (
        'at = 1.0\nsignal = "x.u"\ndelay = 0.25',
        r"actions\[0\]\.delay: 0\.25 s is not a whole number of 0\.1 s steps; nearest: 0\.2 s$",
    ),
    "no delay": (
        'at = 1.0\nsignal = "x.u"\ndelay = 0.0',
        r"actions\[0\]\.delay: expected .* \(0\.1 s\), got 0\.0 s$",
    ),
    "negative delay": (
        'at = 1.0\nsignal = "x.u"\ndelay = -0.2',
        r"actions\[0\]\.delay: expected .* \(0\.1 s\), got -0\.2 s$",
    ),
    "delay that is too small": (
        'at = 1.0\nsignal = "x.u"\ndelay = 1e-12',
        r"actions\[0\]\.delay: expected .* \(0\.1 s\), got 1e-12 s$",
    ),
    "delay beyond all times": (
        'at = 1.0\nsignal = "x.u"\ndelay = 1e300',
        r"actions\[0\]\.delay: 1e\+300 s does not fit into 64-bit nanoseconds",
    ),
    "negative deviation": (
        'at = 1.0\nsignal = "x.u"\nnoise = -0.5',
        r"actions\[0\]\.noise: .*>= 0, got -0\.5$",
    ),
    "seed that no number of the log has": (
        'at = 1.0\nsignal = "x.u"\nnoise = 0.5\nseed = 9007199254740993',
        r"actions\[0\]\.seed: expected a number <= 9007199254740992, got 9007199254740993$",
    ),
    "probability": (
        'at = 1.0\nsignal = "x.u"\ndrop = 1.5',
        r"actions\[0\]\.drop: .*> 0 and <= 1, got 1\.5",
    ),
    "seed of nothing": (
        'at = 1.0\nsignal = "x.u"\noffset = 1.5\nseed = 3',
        r"actions\[0\]\.seed: .*random numbers \(noise, drop\)",
    ),
    "release of nothing": (
        'at = 1.0\nsignal = "x.u"\nrelease = true',
        r"actions\[0\]\.signal: 'x\.u' is not overridden as a whole at that time",
    ),
    "release that is false": (
        'at = 1.0\nsignal = "x.u"\nrelease = false',
        r"actions\[0\]\.release: expected true, got False$",
    ),
    "two at once": (
        'at = 1.0\nsignal = "g.u"\noverride = 1.0\n[[actions]]\nat = 1.0\nsignal = "g.u[1]"\n'
        "offset = 1.0",
        r":38: actions\[1\]\.signal: 'g\.u' is also changed by actions\[0\] ",
    ),
    "two at one condition": (
        'when = "t > 1"\nsignal = "g.u"\noverride = 1.0\n[[actions]]\nwhen = "t > 1"\n'
        'signal = "g.u[1]"\noffset = 1.0',
        r":38: actions\[1\]\.signal: 'g\.u' is also changed by actions\[0\] ",
    ),
    "one signal twice": (
        'at = 1.0\nsignal = ["g.u", "g.u[1]"]\noverride = 1.0',
        r"actions\[0\]\.signal: 'g\.u' is listed twice$",
    ),
    "wrong type": (
        'at = 1.0\nsignal = "x.u"\noffset = "much"',
        r"actions\[0\]\.offset: expected a number or a list of numbers, got 'much'",
    ),
}


def test_a_wrong_action_is_one_error_before_the_run(write, subtests):
    """With its line, what was found and what was needed."""
    for case, (action, text) in CASES.items():
        with subtests.test(case=case):
            with pytest.raises(ScenarioError) as caught:
                cosim.run(write(f"[[actions]]\n{action}\n"))
            message = str(caught.value)
            assert len(message.splitlines()) == 1, message
            assert re.search(text, message), message


def test_all_problems_of_the_file_come_together(write):
    """Of several actions, and of what is wrong beside them."""
    actions = """
[[actions]]
at = 9.0
signal = "x.u"
offset = 1.0

[[actions]]
at = 1.0
signal = "x.w"
freeze = true

[[actions]]
at = 1.0
signal = "x.u"
"""
    with pytest.raises(ScenarioError) as caught:
        cosim.run(write(actions, BASE.replace("rate = 1.0", "rat = 1.0")))
    places = [line.split(": ")[1] for line in str(caught.value).splitlines()]
    assert places == [
        "components.s.rat",
        "actions[2]",
        "actions[0].at",
        "actions[1].signal",
    ]


def test_actions_that_are_no_list_are_refused(write):
    """One pair of brackets is a table."""
    with pytest.raises(ScenarioError, match=r"actions: expected a list, got .*"):
        cosim.run(write('[actions]\nat = 1.0\nsignal = "x.u"\nfreeze = true\n'))


def test_an_unknown_action_cannot_be_set(write):
    """There are those of the file."""
    with pytest.raises(ScenarioError, match=r"actions has no element '7'; available: 0 to 4"):
        cosim.run(write(), set={"actions.7.at": 1.0})
    with pytest.raises(
        ScenarioError,
        match=r"set\['actions\[0\]\.at'\]: actions has no element '0'; none is available",
    ):
        cosim.run(write(""), set={"actions.0.at": 1.0})


def test_a_stop_before_an_action_is_refused(write):
    """Also where it was set from outside."""
    with pytest.raises(ScenarioError, match=r"actions\[4\]\.at: expected .* got 3\.0 s"):
        cosim.run(write(), set={"scenario.stop": 3.0})


def test_info_shows_the_actions_of_a_scenario_and_the_events_of_a_log(write, tmp_path):
    """What was asked for, and what came of it."""
    path = write()
    content = describe_scenario(str(path))
    assert content["actions"][2:4] == [
        {"t": 2.0, "signal": "x.u, log.u", "action": "delay", "value": 0.3},
        {"t": 2.5, "signal": "g.u[1]", "action": "override", "value": 7.0},
    ]
    assert "actions" not in describe_scenario(str(write("")))
    cosim.run(write(), out=tmp_path / "a.mcap")
    content = describe_log(str(tmp_path / "a.mcap"))
    assert content["overrides"][1]["cause"] == "noise 0.1 3 0.2 3"
    assert content["overrides"][4] == {
        "t": 2.5,
        "signal": "g.u[1]",
        "cause": "override",
        "values": "7",
    }


CONDITIONAL = """
[[actions]]
when = "s.y > 1.8"
signal = "x.u"
override = 0.0

[[actions]]
when = "x.y < 0.5 for 0.3 s"
signal = "x.u"
release = true

[[actions]]
when = "s.y < -5"
signal = "g.u"
freeze = true

[[actions]]
when = "s.y > 1.9"
set = { "log.time_constant" = 0.1 }
"""


@pytest.mark.parametrize("block", [1, 5, None])
def test_actions_happen_where_conditions_come_true(write, tmp_path, block):
    """Each once; recorded and replayed; what never came true is said."""
    log = cosim.run(write(CONDITIONAL), out=tmp_path / "a.mcap", block=block)
    s = log["s.y"]
    x = log["x.u"]
    first = int((s > 1.8).argmax())
    held = log["x.y"] < 0.5
    last = next(k for k in range(first, 41) if held[k - 3 : k + 1].all())
    assert (x[: first + 1] == s[: first + 1]).all()
    assert (x[first + 1 : last + 1] == 0.0).all()
    assert (x[last + 1 :] == s[last + 1 :]).all()
    own = [event[1:3] for event in log.events() if event.cause != "follow"]
    assert own == [("override", "x.u"), ("set", "log.time_constant"), ("release", "x.u")]
    assert log.results["never_came_true"] == ["s.y < -5"]
    assert log.recorded_hash == cosim.run(write(CONDITIONAL), out=tmp_path / "b.mcap").recorded_hash
    verification = verify(log, cosim.replay(log))
    assert verification.passed, verification.lines()
    again = cosim.replay(log, out=tmp_path / "c.mcap")
    assert verify(again, cosim.replay(again)).passed


def test_a_session_meets_the_conditions_too(write, tmp_path):
    """With a log of its own that says which never came true."""
    run = cosim.run(write(CONDITIONAL))
    with cosim.load(write(CONDITIONAL)).start(out=tmp_path / "a.mcap") as sim:
        rows = sim.step(40)
    assert rows["x.u"][:, 0].tolist() == run["x.u"][1:].tolist()
    log = cosim.open_log(tmp_path / "a.mcap")
    assert log.results["never_came_true"] == ["s.y < -5"]
    assert log.events() == run.events()


def test_a_component_is_set_at_a_condition_or_at_times(write):
    """What it would be else depends on which comes first."""
    actions = CONDITIONAL + '[[actions]]\nat = 1.0\nset = { "log.time_constant" = 0.2 }\n'
    with pytest.raises(
        ScenarioError, match=r"actions\[4\]\..*'log' is also changed by actions\[3\]"
    ):
        cosim.run(write(actions))


def test_the_summary_says_which_conditions_never_came_true(write, capsys):
    """So that an action that never happened is not overlooked."""
    from cosim.report.summary import summarize

    summary = summarize(cosim.run(write(CONDITIONAL)))
    assert summary.never_came_true == ("s.y < -5",)
