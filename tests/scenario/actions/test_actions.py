"""Timed actions: what happens, what stays, what is recorded, what is refused before the run."""

import math
import re

import numpy as np
import pytest

import cosim
from cosim.core.recording import SignalEvent
from cosim.errors import LogError, ScenarioError, UsageError
from cosim.report.inspection import describe_log, describe_scenario
from cosim.report.summary import summarize
from cosim.report.verification import verify
from cosim.scenario.exporting import export_component
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.running.replay import replays_of
from tests.fmi.eventful import friction
from tests.scenario.refusals import check_refused


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a scenario and its actions."""

    def written(actions, base=BASE):
        path = tmp_path / "acted.toml"
        path.write_text(base + actions)
        return path

    return written


def verified_replay(log):
    """Replay a log; it follows the recorded actions, bit for bit."""
    again = cosim.replay(log)
    verification = verify(log, again)
    assert verification.passed, verification.lines()
    assert again.events() == log.events()
    return again


def check_actions_refused(path, cases):
    """Check that actions are refused by one line: of (actions, key, words of the message)."""
    patterns = []
    for actions, key, words in cases:
        patterns.append((actions, rf"\A.*actions{re.escape(key)}: .*({words}).*\Z"))
    check_refused(
        patterns, lambda actions: cosim.run(path, set={"actions": actions}), ScenarioError
    )


BASE = """
scenario = { name = "acted", stop = 4.0, step = 0.1 }
[components]
s = { kind = "sine", rate = 1.0, offset = 1.0 }
two = { kind = "constant", value = [1.0, 2.0] }
g = { kind = "gain", K = [[2.0, 0.0], [0.0, 3.0]] }
x = { kind = "lag", time_constant = 0.5 }
log = { kind = "lag", time_constant = 0.5 }
flag = { kind = "constant", value = true }
d = { kind = "gain", K = 2.0 }
limit = { kind = "limit", lower = -1.0, upper = 1.5 }
f = { kind = "lag", time_constant = 0.5, initial = 0.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0, lower = -5.0, upper = 5.0 }
noise = { kind = "noise", deviation = 0.1, seed = 3 }
k = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]] }

[connections]
"g.u" = "two.y"
"x.u" = "s.y"
"log.u" = "s.y"
"d.u" = "s.y"
"limit.u" = "s.y"
"f.u" = "d.y"
"pid.setpoint" = "s.y"
"pid.measurement" = "f.y"
"k.u" = "s.y"
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
    run = cosim.run(write(ACTIONS))
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
    events = cosim.run(write(ACTIONS), out=tmp_path / "a.mcap").events()
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
    assert describe_scenario(str(write(ACTIONS)))["actions"][2] == row


def test_actions_are_set_from_outside(write):
    """By their number; the log carries the change."""
    run = cosim.run(write(ACTIONS), set={"actions.0.offset": 0.25, "actions.0.at": 0.5})
    assert (run["x.u"][6:21] == run["s.y"][6:21] + 0.25).all()
    assert cosim.run(write(ACTIONS), set={"actions": []}).events() == []
    more = [{"at": 1.0, "signal": "x.u", "freeze": True}]
    frozen = cosim.run(write(""), set={"actions": more})
    assert (frozen["x.u"][11:] == frozen["s.y"][10]).all()
    with pytest.raises(ScenarioError, match=r"actions has no element '7'; available: 0 to 4"):
        cosim.run(write(ACTIONS), set={"actions.7.at": 1.0})


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


def test_a_replay_repeats_the_recorded_actions(write, tmp_path):
    """Those up to its end; another fault is another run."""
    log = cosim.run(write(ACTIONS), out=tmp_path / "a.mcap")
    again = cosim.replay(log, set={"scenario.stop": 2.2})
    assert again["x.u"].tolist() == log["x.u"][:23].tolist()
    with pytest.raises(UsageError, match=r"actions.0.offset.*: a replay repeats the recorded"):
        cosim.replay(log, set={"actions.0.offset": 1.0})


OFFSET = {"at": 1.0, "signal": "x.u", "offset": 1.0}
G = {"at": 1.0, "signal": "g.u", "override": 1.0}


def on(signal="x.u", **effects):
    """Return an action at 1 s, on a signal or on none."""
    return {"at": 1.0, **({"signal": signal} if signal else {}), **effects}


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


# --- parameters ---

STEP = 0.1


SETTINGS = """
[[actions]]
at = 1.0
set = { "d.K" = 3.0, "f.time_constant" = 0.25 }

[[actions]]
at = 2.0
set = { d.K = -1.0, "limit.upper" = 0.5, "two.value" = [3.0, 4.0] }

[[actions]]
at = 2.5
set = { "pid.gain" = 1.0, "noise.deviation" = 0.2, "s.amplitude" = 2.0 }
"""


def test_parameters_are_set_at_their_instants(write):
    """Rows behind them follow the new values; the row of the instant has the old ones."""
    run = cosim.run(write(SETTINGS))
    s = run["s.y"]
    t = STEP * np.arange(41)
    amplitude = np.where(np.arange(41) <= 25, 1.0, 2.0)
    assert abs(s - (1.0 + amplitude * np.sin(t))).max() < 1e-12
    factor = np.array([2.0] * 11 + [3.0] * 10 + [-1.0] * 20)
    assert (run["d.y"] == factor * s).all()
    upper = np.array([1.5] * 21 + [0.5] * 20)
    assert (run["limit.y"] == np.clip(s, -1.0, upper)).all()
    assert run["two.y"].tolist() == [[1.0, 2.0]] * 21 + [[3.0, 4.0]] * 20
    plain = cosim.run(write(""))
    assert (run["noise.y"][:26] == plain["noise.y"][:26]).all()
    ratio = run["noise.y"][26:] / plain["noise.y"][26:]
    assert abs(ratio - 2.0).max() < 4 * 2**-52


def test_states_stay(write):
    """The lag goes on from where it was; so does the integral part of the controller."""
    run = cosim.run(write(SETTINGS))
    events = [event for event in run.events() if event.time_ns == 10**9]
    assert [event.signal for event in events if event.cause == "follow"] == ["d.y", "f.u"]
    x = run["f.y"]
    # the right limit of u at 1 s, and its value a step later, on a straight line between
    u0 = 3.0 * run["s.y"][10]
    u1 = run["f.u"][11]
    rate = 4.0
    slope = (u1 - u0) / STEP
    decay = np.exp(-rate * STEP)
    expected = u1 - slope / rate + (x[10] - u0 + slope / rate) * decay
    assert x[11] == pytest.approx(expected, abs=1e-14)
    integral = run["pid.integral"]
    events = {event.signal: event.values for event in run.events() if event.time_ns == 25 * 10**8}
    assert "pid.integral" not in events
    assert events["pid.gain"] == (1.0,)
    # y = K (setpoint - measurement) + I at the right limit
    e = events["pid.setpoint"][0] if "pid.setpoint" in events else run["s.y"][25]
    assert events["pid.y"][0] == pytest.approx(1.0 * (e - x[25]) + integral[25], abs=1e-14)


@pytest.mark.parametrize(
    "actions", [ACTIONS, CONDITIONAL, SETTINGS], ids=["timed", "conditional", "parameters"]
)
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


def test_a_replay_sets_what_was_recorded(write, tmp_path):
    """The designs are in the log; a parameter of the scenario can be another one."""
    log = cosim.run(write(SETTINGS), out=tmp_path / "a.mcap")
    assert set(log.metadata["cosim.settings"]) >= {"1000000000 f", "2500000000 pid"}
    other = cosim.replay(log, set={"f.time_constant": 1.0})
    assert (other["f.y"][1:11] != log["f.y"][1:11]).all()
    first = describe_log(str(tmp_path / "a.mcap"))["overrides"][0]
    assert first == {"t": 1.0, "signal": "d.K", "cause": "set", "values": "3"}


def test_designs_that_are_set_at_a_condition_are_verified(write, tmp_path):
    """Those of the log against what they are computed to anew; another one is found."""
    action = '[[actions]]\nwhen = "s.y > 1.5"\nset = { "f.time_constant" = 0.25 }\n'
    log = cosim.run(write(action), out=tmp_path / "a.mcap")
    replays = replays_of(log, ReplayRequest())
    designs = replays.designs()
    (name,) = [name for name in designs if name.endswith(" f")]
    assert verify(log, cosim.replay(log), designs).passed
    designs[name] = {key: 1.5 * values for key, values in designs[name].items()}
    problems = verify(log, cosim.replay(log), designs).problems
    assert problems
    assert all(f"designs.{name}" in problem for problem in problems)


OBSERVED = """
[[actions]]
at = 0.5
set = { "observer.filter_rate" = 100.0, "observer.L" = [6.0, 1.0] }
"""


def test_an_observer_is_designed_anew_and_its_design_recorded(write, tmp_path):
    """Its estimate goes on from its state; the replay takes the design from the log."""
    text = cosim.load("academic").document.text
    for name in ("regressor", "identifier"):
        text = re.sub(rf"\[components\.{name}\].*?(?=\n\[)", "", text, flags=re.DOTALL)
        text = re.sub(rf'"{name}\..*\n', "", text)
    text = text.replace("stop = 40.0", "stop = 1.0")
    log = cosim.run(write(OBSERVED, text), out=tmp_path / "a.mcap")
    plain = cosim.run(write("", text))
    assert (log["observer.x_a"][:501] == plain["observer.x_a"][:501]).all()
    assert (log["observer.x_a"][501:] != plain["observer.x_a"][501:]).any()
    jumps = {event.signal for event in log.events() if event.cause == "follow"}
    assert jumps == {"observer.delta"}
    verified_replay(log)


OF_AN_FMU = """
scenario = { name = "fmu", stop = 2.0, step = 0.1 }
[components]
u = { kind = "constant", value = 2.0 }
d = { kind = "constant", value = 0.0 }
fmu = { kind = "fmu", path = "PATH", start = { p = 0.5 } }
[connections]
"fmu.u" = "u.y"
"fmu.d" = "d.y"
"""


def test_a_tunable_parameter_of_an_fmu_is_set_in_place(tmp_path, write):
    """v' = u - p; a replay takes what came of it from the log; whichever comes true first."""
    base = OF_AN_FMU.replace("PATH", str(friction(tmp_path, 3)))
    actions = '[[actions]]\nat = 1.0\nset = { "fmu.p" = 1.5 }\n'
    log = cosim.run(write(actions, base), out=tmp_path / "a.mcap")
    t = STEP * np.arange(21)
    expected = np.where(t <= 1.0, 1.5 * t, 1.5 + 0.5 * (t - 1.0))
    assert abs(log["fmu.v"] - expected).max() < 1e-12
    assert [(e.cause, e.signal, e.values) for e in log.events()] == [("set", "fmu.p", (1.5,))]
    verified_replay(log)
    with pytest.raises(ScenarioError, match=r"set\.fmu\.q: 'fmu' has no tunable .*'q'"):
        cosim.run(write(actions.replace("fmu.p", "fmu.q"), base))
    when = [
        {"when": "t >= 1.0", "set": {"fmu.p": 1.5}},
        {"when": "t >= 1.5", "set": {"fmu.p": 0.5}},
    ]
    run = cosim.run(write("", base), set={"fmu.start": {"p": 0.0}, "actions": when})
    assert np.diff(run["fmu.v"])[[4, 12, 18]] == pytest.approx([0.2, 0.05, 0.15])


def sets(name, value=1.0, **when):
    """Return an action that sets a parameter."""
    return {**(when or {"at": 1.0}), "set": {name: value}}


LATER = {"when": "f.y > 1"}
WRONG_SETTINGS = [  # actions, the key of what is wrong, words of the message
    ([sets("h.K")], "[0].set.h.K", "no component 'h'; available: s, two"),
    ([sets("f.initial")], "[0].set.f.initial", "no tunable .*; available: time_constant$"),
    ([sets("pid.gian")], "[0].set.pid.gian", r"did you mean 'gain'\? Available: gain, "),
    ([sets("d.K", "much")], "[0].set.d.K", "expected a number .*, got 'much'"),
    ([sets("d.K", math.inf)], "[0].set.d.K", "expected a finite number, got inf"),
    ([sets("f.time_constant", -1.0)], "[0].set.f.time_constant", r"> 0, got -1\.0 s"),
    ([sets("two.value", [1.0, 2.0, 3.0])], "[0].set.two.value", "direct feedthrough of 'two'"),
    ([sets("two.value", True)], "[0].set.two.value", "a number.*, got True"),
    (
        [sets("two.value", [True, False])],
        "[0].set.two.value",
        "a number, got True(?s:.)*a number, got False",
    ),
    (
        [sets("two.value", [[1.0], [2.0]])],
        "[0].set.two.value",
        r"a number, got \[1\.0\](?s:.)*a number, got \[2\.0\]",
    ),
    ([sets("f.time_constant", {"a": 1})], "[0].set.f.time_constant", r"got \{'a': 1\}"),
    ([sets("flag.value", 0.0)], "[0].set.flag.value", r"true or false, got 0\.0"),
    ([sets("d")], "[0].set.d", "tunable parameter of 'd', got none; available: K"),
    ([sets("k.A", [[1.0]])], "[0].set.k.A", "no tunable parameter 'A'; none is available"),
    ([sets("pid.tracking_time")], "[0].set.pid.tracking_time", "in the table of 'pid'"),
    ([on(set={"d.K": 1.0})], "[0].signal", "not allowed with 'set'"),
    ([on(None, set={})], "[0].set", "a parameter and its value, got an empty table"),
    ([on(None, swap={})], "[0].swap", r"a component and its \.fmu, got an empty table"),
    ([sets("d.K"), sets("d.K")], "[1].set.d.K", r"changed by actions\[0\] at the same instant"),
    ([sets("d.K"), sets("d.K", **LATER)], "[1].set.d.K", r"actions\[0\], .*condition"),
    ([sets("d.K", **LATER), sets("d.K")], "[1].set.d.K", r"actions\[0\], .*condition"),
    ([sets("d.K", **LATER), sets("d.K", **LATER)], "[1].set.d.K", "at the same instant"),
    ([sets("d.K", **LATER), sets("d.K", when="t > 2")], "[1].set.d.K", r"actions\[0\], .*cond"),
]


def test_a_wrong_setting_is_one_error_before_the_run(write):
    """With its place, what was found and what was needed."""
    check_actions_refused(write(""), WRONG_SETTINGS)


def test_a_parameter_of_a_design_model_cannot_be_set():
    """The regressor counts on the lag of the observer's filter."""
    actions = [{"at": 1.0, "set": {"observer.filter_rate": 500.0}}]
    with pytest.raises(ScenarioError, match=r"'observer' cannot change during the run: regressor"):
        cosim.run("academic", set={"actions": actions})


def test_a_log_with_a_setting_that_does_not_fit_is_refused(write, tmp_path):
    """It was written by another version, or is damaged."""
    log = cosim.run(write(SETTINGS), out=tmp_path / "a.mcap")

    def replay(signal):
        log.events = lambda: [SignalEvent(10**9, "set", signal, (1.0,))]
        cosim.replay(log)

    misfit = r"event of '{}' at t = 1\.0 s does not match"
    cases = [("f.initial", f"{misfit.format('f')}: .*no tunable parameter")]
    check_refused([*cases, ("y.K", misfit.format("y"))], replay, LogError)


# --- a plant swapped in a run: an FMU goes on from its states ---

STOP = {"scenario.stop": 2.0, "scenario.step": 0.01, "observer.filter_rate": 100.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Export the plant of the shipped example for FMI 3."""
    folder = tmp_path_factory.mktemp("swap")
    export_component("academic", "plant", folder / "plant3.fmu", fmi="3")
    return folder


def swapped(path, **changes):
    """Return changes with which the plant is swapped at 1 s."""
    return {**STOP, **changes, "actions": [{"at": 1.0, "swap": {"plant": str(path)}}]}


@pytest.mark.parametrize("version", [pytest.param(2, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("block", [pytest.param(1, marks=pytest.mark.slow), 7])
def test_an_fmu_goes_on_from_the_states_of_the_plant(folder, version, block, tmp_path):
    """The same model: the run goes on as without a swap, but for the tolerance of the solver."""
    fmu = folder / f"plant{version}.fmu"
    if not fmu.exists():
        export_component("academic", "plant", fmu, fmi=str(version))
    path = f"{fmu}#me"
    log = cosim.run("academic", set=swapped(path), out=tmp_path / "a.mcap", block=block)
    plain = cosim.run("academic", set=STOP)
    for name in ("plant.x_a", "plant.y", "plant.x_b"):
        assert (log[name][:101] == plain[name][:101]).all()
        # relative tolerance 1e-9 of values up to 4, over 1 s
        assert abs(log[name] - plain[name]).max() < 1e-7, name
    assert (log["plant.x_a"][101:] != plain["plant.x_a"][101:]).any(), "another solver computes"
    (event,) = [event for event in log.events() if event.cause != "follow"]
    assert event[:3] == (10**9, "swap", f"plant.{path}")
    row = {"t": 1.0, "signal": "plant", "cause": "swap", "values": str(path)}
    assert describe_log(str(tmp_path / "a.mcap"))["overrides"] == [row]
    other = cosim.run("academic", set=swapped(path), out=tmp_path / "b.mcap")
    assert log.recorded_hash == other.recorded_hash
    verified_replay(log)


def test_a_session_goes_back_over_a_swap(folder):
    """To the plant that was there then."""
    with cosim.load("academic").edit(set=swapped(folder / "plant3.fmu#me")).start() as sim:
        sim.step(90)
        saved = sim.state
        first = sim.step(30)["plant.x_a"].tobytes()
        sim.state = saved
        assert sim.step(30)["plant.x_a"].tobytes() == first


def test_a_swap_without_hand_over_of_states_is_refused(folder, tmp_path):
    """Before the run, with what is missing."""
    fmu = str(folder / "plant3.fmu")
    cases = [
        ({"plant": f"{fmu}#cs"}, r"swap\.plant: the state of 'plant' cannot be trans.* to .*#cs"),
        ({"plant": str(friction(tmp_path, 2))}, r"the states x_a\[0\], x_a\[1\], got x, v"),
        ({"u": fmu}, r"the state of 'u' cannot be transferred: it has no named"),
        ({"plnt": fmu}, r"swap\.plnt: .*no component 'plnt'; did you mean 'plant'"),
        ({"plant": str(folder / "none.fmu")}, r"swap\.plant: .*none\.fmu"),
    ]
    actions = [([{"at": 1.0, "swap": swap}], words) for swap, words in cases]
    twice = [{"at": at, "swap": {"plant": fmu}} for at in (1.0, 1.5)]
    actions.append((twice, r"actions\[1\]\.swap\.plant: 'plant' is also changed by actions\[0\]"))

    def run(made):
        cosim.run("academic", set={**STOP, "actions": made})

    check_refused([(made, rf"\A.*{words}.*\Z") for made, words in actions], run, ScenarioError)
