"""Timed actions of a scenario: what happens, what is refused before the run, what is recorded."""

import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.report.inspection import describe_log, describe_scenario
from cosim.report.summary import summarize
from tests.scenario.actions.replays import check_actions_refused, verified_replay

BASE = """
scenario = { name = "acted", stop = 4.0, step = 0.1 }
[components]
s = { kind = "sine", rate = 1.0, offset = 1.0 }
two = { kind = "constant", value = [1.0, 2.0] }
g = { kind = "gain", K = [[2.0, 0.0], [0.0, 3.0]] }
x = { kind = "lag", time_constant = 0.5 }
log = { kind = "lag", time_constant = 0.5 }

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


def test_every_action_is_an_event_with_its_cause(write, tmp_path):
    """With what is known of it; what followed at once comes behind. Reports show what they need."""
    events = cosim.run(write(), out=tmp_path / "a.mcap").events()
    own = [(e.time_ns / 1e9, e.cause, e.signal, e.parameters) for e in events]
    assert [event for event in own if event[1] != "follow"] == [
        (1.0, "offset", "x.u", (0.5,)),
        (1.0, "noise", "g.u", (0.1, 3.0, 0.2, 3.0)),
        (2.0, "delay", "x.u", (3.0,)),
        (2.0, "delay", "log.u", (3.0,)),
        (2.5, "override", "g.u[1]", ()),
        (3.0, "release", "x.u", ()),
    ]
    assert {event.signal for event in events if event.cause == "follow"} == {"g.y"}
    rows = describe_log(str(tmp_path / "a.mcap"))["overrides"]
    assert rows[4] == {"t": 2.5, "signal": "g.u[1]", "cause": "override", "values": "7"}
    row = {"t": 2.0, "signal": "x.u, log.u", "action": "delay", "value": 0.3}
    assert describe_scenario(str(write()))["actions"][2] == row


def test_actions_are_set_from_outside(write):
    """By their number; the log carries the change."""
    run = cosim.run(write(), set={"actions.0.offset": 0.25, "actions.0.at": 0.5})
    assert (run["x.u"][6:21] == run["s.y"][6:21] + 0.25).all()
    assert cosim.run(write(), set={"actions": []}).events() == []
    more = [{"at": 1.0, "signal": "x.u", "freeze": True}]
    frozen = cosim.run(write(""), set={"actions": more})
    assert (frozen["x.u"][11:] == frozen["s.y"][10]).all()
    with pytest.raises(ScenarioError, match=r"actions has no element '7'; available: 0 to 4"):
        cosim.run(write(), set={"actions.7.at": 1.0})


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


def test_actions_happen_where_conditions_come_true(write):
    """Each once; what never came true is said."""
    log = cosim.run(write(CONDITIONAL))
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
    assert summarize(log).never_came_true == ("s.y < -5",)


@pytest.mark.parametrize("actions", [ACTIONS, CONDITIONAL], ids=["timed", "conditional"])
def test_runs_replays_and_sessions_act_alike(write, tmp_path, actions):
    """One content hash for blocks of any size; a replay of the replay has the bits, too."""
    path = write(actions)
    log = cosim.run(path, out=tmp_path / "a.mcap")
    for block in (1, 3):
        other = cosim.run(path, out=tmp_path / "b.mcap", block=block, force=True)
        assert other.recorded_hash == log.recorded_hash
    verified_replay(cosim.replay(log, out=tmp_path / "c.mcap"))
    with cosim.load(path).start(out=tmp_path / "d.mcap") as sim:
        sim.step(17)
        sim.step(23)
    session = cosim.open_log(tmp_path / "d.mcap")
    assert session.recorded_hash == log.recorded_hash
    assert session.events() == log.events()


def test_a_replay_repeats_the_recorded_actions(write, tmp_path):
    """Those up to its end; another fault is another run."""
    log = cosim.run(write(), out=tmp_path / "a.mcap")
    again = cosim.replay(log, set={"scenario.stop": 2.2})
    assert again["x.u"].tolist() == log["x.u"][:23].tolist()
    with pytest.raises(UsageError, match=r"actions.0.offset.*: a replay repeats the recorded"):
        cosim.replay(log, set={"actions.0.offset": 1.0})


OFFSET = {"at": 1.0, "signal": "x.u", "offset": 1.0}
G = {"at": 1.0, "signal": "g.u", "override": 1.0}


def on(signal="x.u", **effects):
    """Return an action at 1 s."""
    return {"at": 1.0, "signal": signal, **effects}


REFUSED = [  # actions, the key of what is wrong, words of the message
    ([{"signal": "x.u", "offset": 1.0}], "[0]", "'at' .*'when' .*, got neither"),
    ([{**OFFSET, "when": "s.y > 1"}], "[0]", "'at' .*'when' .*, got both"),
    ([{"when": "s.z > 1", "signal": "x.u", "offset": 1.0}], "[0].when", r"'s\.z > 1': .*'s\.z'"),
    ([{"when": "s.y + 1", "signal": "x.u", "offset": 1.0}], "[0].when", "comparison"),
    ([{"at": 1.0, "offset": 1.0}], "[0]", "'signal' is missing"),
    ([on()], "[0]", "one of override, freeze, offset, .*, got none"),
    ([on(offset=1.0, freeze=True)], "[0]", "one of .*, got freeze and offset"),
    ([on(ofset=1.0)], "[0].ofset", "did you mean 'offset'"),
    ([on("x.v", offset=1.0)], "[0].signal", "'x' has no input 'v'; available: u"),
    ([on("xx.u", offset=1.0)], "[0].signal", "no component 'xx'; did you mean 'x'"),
    ([on("s.y", offset=1.0)], "[0].signal", r"got an output; .*'s\.y' drives x\.u, log\.u"),
    ([on("g.u[2]", offset=1.0)], "[0].signal", r"'g\.u' has 2 elements"),
    ([{**OFFSET, "at": 4.0}], "[0].at", r"a time < 4\.0 s .*, got 4\.0 s"),
    ([{**OFFSET, "at": -1.0}], "[0].at", r"a time >= 0\.0 s .*, got -1\.0 s"),
    ([{**OFFSET, "at": 1.05}], "[0].at", r"1\.05 s is not .* 0\.1 s steps; nearest: 1\.0 s"),
    ([on("g.u", override=[1.0, 2.0, 3.0])], "[0].override", "expected 2 values.*, got 3"),
    ([on(override=True)], "[0].override", "expected numbers, got true or false"),
    ([on("g.u", offset=[1.0, 2.0, 3.0])], "[0].offset", "expected 2 values .*, got 3"),
    ([on(offset="much")], "[0].offset", "a number or a list, got 'much'"),
    ([on(delay=0.25)], "[0].delay", r"not .* 0\.1 s steps; nearest: 0\.2 s"),
    ([on(delay=1e-12)], "[0].delay", r"\(0\.1 s\), got 1e-12 s"),
    ([on(delay=1e300)], "[0].delay", "does not fit into 64-bit nanoseconds"),
    ([on(noise=-0.5)], "[0].noise", r">= 0, got -0\.5"),
    ([on(noise=0.5, seed=2**53 + 1)], "[0].seed", f"<= {2**53}, got {2**53 + 1}"),
    ([on(offset=1.5, seed=3)], "[0].seed", r"random numbers \(noise, drop\)"),
    ([on(drop=1.5)], "[0].drop", r"> 0 and <= 1, got 1\.5"),
    ([on(release=True)], "[0].signal", r"'x\.u' is not overridden as a whole"),
    ([on(release=False)], "[0].release", "expected true, got False"),
    ([G, on("g.u[1]", offset=1.0)], "[1].signal", r"'g\.u' is also changed by actions\[0\]"),
    ([on(["g.u", "g.u[1]"], override=1.0)], "[0].signal", r"'g\.u' is listed twice"),
]


def test_a_wrong_action_is_one_error_before_the_run(write):
    """With its place, what was found and what was needed."""
    check_actions_refused(write(""), REFUSED)
