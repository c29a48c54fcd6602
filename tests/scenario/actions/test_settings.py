"""Parameters that actions set: what changes, what stays, what is recorded and refused."""

import math
import re

import numpy as np
import pytest

import cosim
from cosim.core.recording import SignalEvent
from cosim.errors import LogError, ScenarioError
from cosim.report.inspection import describe_log
from cosim.report.verification import verify
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.running.replay import replays_of
from tests.fmi.eventful import friction
from tests.scenario.actions.replays import check_actions_refused, verified_replay
from tests.scenario.refusals import check_refused

STEP = 0.1


BASE = """
scenario = { name = "set", stop = 4.0, step = 0.1 }
[components]
s = { kind = "sine", rate = 1.0, offset = 1.0 }
c = { kind = "constant", value = [1.0, 2.0] }
flag = { kind = "constant", value = true }
g = { kind = "gain", K = 2.0 }
limit = { kind = "limit", lower = -1.0, upper = 1.5 }
x = { kind = "lag", time_constant = 0.5, initial = 0.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0, lower = -5.0, upper = 5.0 }
noise = { kind = "noise", deviation = 0.1, seed = 3 }
k = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]] }

[connections]
"g.u" = "s.y"
"limit.u" = "s.y"
"x.u" = "g.y"
"pid.setpoint" = "s.y"
"pid.measurement" = "x.y"
"k.u" = "s.y"
"""
ACTIONS = """
[[actions]]
at = 1.0
set = { "g.K" = 3.0, "x.time_constant" = 0.25 }

[[actions]]
at = 2.0
set = { g.K = -1.0, "limit.upper" = 0.5, "c.value" = [3.0, 4.0] }

[[actions]]
at = 2.5
set = { "pid.gain" = 1.0, "noise.deviation" = 0.2, "s.amplitude" = 2.0 }
"""


def test_parameters_are_set_at_their_instants(write):
    """Rows behind them follow the new values; the row of the instant has the old ones."""
    run = cosim.run(write())
    s = run["s.y"]
    t = STEP * np.arange(41)
    amplitude = np.where(np.arange(41) <= 25, 1.0, 2.0)
    assert abs(s - (1.0 + amplitude * np.sin(t))).max() < 1e-12
    factor = np.array([2.0] * 11 + [3.0] * 10 + [-1.0] * 20)
    assert (run["g.y"] == factor * s).all()
    upper = np.array([1.5] * 21 + [0.5] * 20)
    assert (run["limit.y"] == np.clip(s, -1.0, upper)).all()
    assert run["c.y"].tolist() == [[1.0, 2.0]] * 21 + [[3.0, 4.0]] * 20
    plain = cosim.run(write(""))
    assert (run["noise.y"][:26] == plain["noise.y"][:26]).all()
    ratio = run["noise.y"][26:] / plain["noise.y"][26:]
    assert abs(ratio - 2.0).max() < 4 * 2**-52


def test_states_stay(write):
    """The lag goes on from where it was; so does the integral part of the controller."""
    run = cosim.run(write())
    events = [event for event in run.events() if event.time_ns == 10**9]
    assert [event.signal for event in events if event.cause == "follow"] == ["g.y", "x.u"]
    x = run["x.y"]
    # the right limit of u at 1 s, and its value a step later, on a straight line between
    u0 = 3.0 * run["s.y"][10]
    u1 = run["x.u"][11]
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


def test_a_replay_sets_what_was_recorded(write, tmp_path):
    """One content hash, whatever the blocks; bit for bit, with the designs of the log."""
    log = cosim.run(write(), out=tmp_path / "a.mcap")
    for block in (1, 3):
        other = cosim.run(write(), out=tmp_path / f"{block}.mcap", block=block)
        assert other.recorded_hash == log.recorded_hash
    verified_replay(log)
    assert set(log.metadata["cosim.settings"]) >= {"1000000000 x", "2500000000 pid"}
    other = cosim.replay(log, set={"x.time_constant": 1.0})
    assert (other["x.y"][1:11] != log["x.y"][1:11]).all()
    first = describe_log(str(tmp_path / "a.mcap"))["overrides"][0]
    assert first == {"t": 1.0, "signal": "g.K", "cause": "set", "values": "3"}


def test_designs_that_are_set_at_a_condition_are_verified(write, tmp_path):
    """Those of the log against what they are computed to anew; another one is found."""
    action = '[[actions]]\nwhen = "s.y > 1.5"\nset = { "x.time_constant" = 0.25 }\n'
    log = cosim.run(write(action), out=tmp_path / "a.mcap")
    replays = replays_of(log, ReplayRequest())
    designs = replays.designs()
    (name,) = [name for name in designs if name.endswith(" x")]
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
    verification = verify(log, cosim.replay(log))
    assert verification.passed, verification.lines()


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
    """v' = u - p; a replay takes what came of it from the log."""
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


def on(**setting):
    """Return an action at 1 s."""
    return {"at": 1.0, **setting}


def sets(name, value=1.0, **when):
    """Return an action that sets a parameter."""
    return {**(when or {"at": 1.0}), "set": {name: value}}


LATER = {"when": "x.y > 1"}
REFUSED = [  # actions, the key of what is wrong, words of the message
    ([sets("h.K")], "[0].set.h.K", "no component 'h'; available: s, c"),
    ([sets("x.initial")], "[0].set.x.initial", "no tunable .*; available: time_constant$"),
    ([sets("pid.gian")], "[0].set.pid.gian", r"did you mean 'gain'\? Available: gain, "),
    ([sets("g.K", "much")], "[0].set.g.K", "expected a number .*, got 'much'"),
    ([sets("g.K", math.inf)], "[0].set.g.K", "expected a finite number, got inf"),
    ([sets("x.time_constant", -1.0)], "[0].set.x.time_constant", r"> 0, got -1\.0 s"),
    ([sets("c.value", [1.0, 2.0, 3.0])], "[0].set.c.value", "direct feedthrough of 'c'"),
    ([sets("c.value", True)], "[0].set.c.value", "a number or .*, got True"),
    ([sets("c.value", [1.0, False])], "[0].set.c.value", "a number, got False"),
    ([sets("c.value", [1.0, [2.0]])], "[0].set.c.value", r"a number, got \[2\.0\]"),
    ([sets("x.time_constant", {"a": 1})], "[0].set.x.time_constant", r"got \{'a': 1\}"),
    ([sets("flag.value", 0.0)], "[0].set.flag.value", r"true or false, got 0\.0"),
    ([sets("g")], "[0].set.g", "tunable parameter of 'g', got none; available: K"),
    ([sets("k.A", [[1.0]])], "[0].set.k.A", "no tunable parameter 'A'; none is available"),
    ([sets("pid.tracking_time")], "[0].set.pid.tracking_time", "in the table of 'pid'"),
    ([on(signal="x.u", set={"g.K": 1.0})], "[0].signal", "not allowed with 'set'"),
    ([on(set={})], "[0].set", "a parameter and its value, got an empty table"),
    ([on(swap={})], "[0].swap", r"a component and its \.fmu, got an empty table"),
    ([sets("g.K"), sets("g.K")], "[1].set.g.K", r"changed by actions\[0\] at the same instant"),
    ([sets("g.K"), sets("g.K", **LATER)], "[1].set.g.K", r"actions\[0\], .*condition"),
    ([sets("g.K", **LATER), sets("g.K")], "[1].set.g.K", r"actions\[0\], .*condition"),
    ([sets("g.K", **LATER), sets("g.K", **LATER)], "[1].set.g.K", "at the same instant"),
    (
        [sets("g.K", **LATER), sets("g.K", when="t > 2")],
        "[1].set.g.K",
        r"actions\[0\], .*condition",
    ),
]


def test_a_wrong_setting_is_one_error_before_the_run(write):
    """With its place, what was found and what was needed."""
    check_actions_refused(write(""), REFUSED)


def test_a_parameter_of_a_design_model_cannot_be_set():
    """The regressor counts on the lag of the observer's filter."""
    actions = [{"at": 1.0, "set": {"observer.filter_rate": 500.0}}]
    with pytest.raises(ScenarioError, match=r"'observer' cannot change during the run: regressor"):
        cosim.run("academic", set={"actions": actions})


def test_a_log_with_a_setting_that_does_not_fit_is_refused(write, tmp_path):
    """It was written by another version, or is damaged."""
    log = cosim.run(write(), out=tmp_path / "a.mcap")

    def replay(signal):
        log.events = lambda: [SignalEvent(10**9, "set", signal, (1.0,))]
        cosim.replay(log)

    misfit = r"event of '{}' at t = 1\.0 s does not match"
    cases = [("x.initial", f"{misfit.format('x')}: .*no tunable parameter")]
    check_refused([*cases, ("y.K", misfit.format("y"))], replay, LogError)
