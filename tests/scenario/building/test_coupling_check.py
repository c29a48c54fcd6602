"""Loops whose coupling multiplies an error are refused before the run, and told of otherwise."""

import json
import re

import pytest

import cosim
from cosim.errors import NonFiniteError, ScenarioError
from cosim.report.inspection import describe_log
from cosim.report.summary import summarize
from cosim.scenario.building.coupling import gain_text
from cosim.scenario.exporting import export_component
from cosim.scenario.record import recorded_loop_gains, recorded_warnings

PAIR = """
scenario = { name = "pair", stop = 1.0, step = 0.01, coupling = "jacobi" }
[components]
one = { kind = "controller", A = [[-0.9]], B = [[0.5]], C = [[3.0]], D = [[1.0]], x0 = [1.0] }
two = { kind = "controller", A = [[-1.0]], B = [[10.0]], C = [[-31.0]], D = [[-0.9]], x0 = [1.0] }

[connections]
"one.u" = "two.y"
"two.u" = "one.y"
"""
FAST = """
scenario = { name = "fast", stop = 1.0, step = 0.01 }
[components]
u = { kind = "step", time = 0.5 }
fast = { kind = "lag", time_constant = 0.001 }
slow = { kind = "lag", time_constant = 0.02 }
[connections]
"fast.u" = "u.y"
"slow.u" = "fast.y"
"""
REFUSED = "the loop of one, two: coupling 'jacobi' amplifies an error by "
WARN = {"scenario.coupling_check": "warn"}


@pytest.fixture
def pair(tmp_path):
    """Return a loop that is stable itself, and not as it is coupled."""
    path = tmp_path / "pair.toml"
    path.write_text(PAIR)
    return path


def coupling_warnings(log):
    """Return what a log warns of its couplings."""
    return [text for name, text in recorded_warnings(log) if name == "coupling"]


def refusal(scenario, **changes):
    """Return why a run is refused."""
    with pytest.raises(ScenarioError) as caught:
        cosim.run(scenario, set={f"scenario.{key}": value for key, value in changes.items()})
    return str(caught.value)


def test_a_coupling_that_leaves_nothing_of_its_results_is_refused_before_the_run(pair, tmp_path):
    """By the line of the step, with loop, gain, growth and what would do; each of that runs."""
    with pytest.raises(ScenarioError):
        cosim.run(pair, out=tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()
    text = refusal(pair)
    assert text.startswith(f"{pair}:2: scenario.step: {REFUSED}")
    assert "per step of 0.01 s (exact solution: 0.9762), by " in text
    assert 'coupling = "gauss-seidel" or coupling = "newton"; coupling_check = "warn"' in text
    step = float(text.split("use step = ")[1].split(",")[0])
    for way_out in ({"step": step}, {"coupling": "gauss-seidel"}, {"coupling": "newton"}):
        changes = {f"scenario.{key}": value for key, value in way_out.items()}
        memory = cosim.run(pair, set=changes)
        assert [gain.verdict for gain in recorded_loop_gains(memory)] == ["fine"]
        assert abs(memory["one.x"][-1]) < 0.2
    # Newton's method takes as many as it needs; Gauss-Seidel is as unstable with three
    text = refusal(pair, iterations=3)
    assert 'use step = 0.001 or coupling = "newton" with iterations = 1;' in text
    assert "amplifies an error by 8.9" in refusal(pair, iterations=3, coupling="gauss-seidel")


@pytest.mark.usefixtures("in_this_process")
def test_info_check_and_a_dry_run_say_what_a_run_would(pair, call):
    """Without a run: refused in all, or warned of in all."""
    (row,) = json.loads(call("info", pair, "--json")[1])["loops"]
    assert row["verdict"] == "refused"
    code, text, _ = call("check", pair)
    assert (code, "coupling of one, two\tNOT FULFILLED" in text) == (1, True)
    code, text, err = call("run", pair, "--dry-run")
    assert (code, text, REFUSED in err) == (2, "", True)
    warn = ("--set", "scenario.coupling_check='warn'")
    code, text, err = call("run", pair, "--dry-run", *warn)
    assert (code, "can run; warnings: " in text, REFUSED in err) == (0, True, True)
    pair.write_text(FAST)
    _, _, err = call("run", pair, "--dry-run")
    assert "slow.y is off by up to" in err


def test_warned_of_it_runs_all_the_same_and_the_end_names_loop_and_gain(pair):
    """The connection, the time and the gain, where it becomes infinite."""
    memory = cosim.run(pair, set=WARN)
    (text,) = [text for source, text in recorded_warnings(memory) if source == "coupling"]
    assert text.startswith(REFUSED)
    (gain,) = recorded_loop_gains(memory)
    reason = (
        r"became -?inf at t = .*; everything before is kept; it is in the loop of one, two, by "
        r"\w+\.y -> \w+\.u, coupled by 'jacobi' with an error amplification of "
        f"{gain.rho:.3f} per step"
    )
    with pytest.raises(NonFiniteError, match=reason):
        cosim.run(pair, set={**WARN, "scenario.stop": 100.0})


OSCILLATION = {
    "scenario.stop": 10.0,
    "one": {"kind": "controller", "A": [[0.0]], "B": [[1.0]], "C": [[1.0]], "D": [[0.0]]},
    "two": {"kind": "controller", "A": [[0.0]], "B": [[-1.0]], "C": [[1.0]], "D": [[0.0]]},
}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        # an undamped oscillation by Jacobi: (1 + (h w)^2)^(N/2) = exp(0.05) in 10 s at 0.01 s
        (OSCILLATION, f"^{REFUSED}1.0000500 per step of 0.01 s .*, by 1.051 over the run$"),
        # with a second feedthrough of 1.1 it has a pole at +3084 /s, whatever couples it
        ({"two.D": [[1.1]]}, r"is unstable with any coupling.*\+3084 /s.* 1e1339 over the run"),
    ],
)
def test_what_is_not_refused_is_warned_of(pair, changes, words):
    """A slow growth, and a loop that is unstable by itself."""
    (text,) = coupling_warnings(cosim.run(pair, set=changes))
    assert re.search(words, text)


def test_replays_and_reports_take_the_gain_from_the_log(pair, tmp_path):
    """As it was before the run; a replay does not compute it again, and not where it changed."""
    log = cosim.run(pair, out=tmp_path / "pair.mcap", set={"scenario.coupling": "newton"})
    (gain,) = recorded_loop_gains(log)
    assert (gain.components, gain.coupling) == (("one", "two"), "newton")
    assert summarize(log).gains == (gain,)
    assert recorded_loop_gains(cosim.replay(log)) == (gain,)
    assert recorded_loop_gains(cosim.replay(log, set={"scenario.stop": 0.5})) == ()
    (row,) = describe_log(str(log.path))["loops"]
    assert (row["gain"], row["verdict"]) == (gain.rho, "fine")
    assert row["largest pole"] == pytest.approx(-2.4069, abs=1e-4)


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    """Return the plant of the shipped loop as an FMU."""
    path = tmp_path_factory.mktemp("plant") / "plant.fmu"
    export_component("closed-loop", "plant", path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_the_gain_of_a_loop_through_an_fmu_is_that_of_its_model(plant, interface_type):
    """By differences or directional derivatives; the run that follows has the bits of one without.

    The FMU for co-simulation is exact for means, not for straight lines: its gain differs by what
    that changes, of second order in h.
    """
    short = {"scenario.stop": 0.01}
    (expected,) = recorded_loop_gains(cosim.run("closed-loop", set=short))
    swapped = cosim.run("closed-loop", set=short, swap={"plant": f"{plant}#{interface_type}"})
    (found,) = recorded_loop_gains(swapped)
    assert expected.rho == pytest.approx(0.99836, abs=1e-5)
    assert found.rho == pytest.approx(expected.rho, rel=1e-6)
    assert found.rate == pytest.approx(expected.rate, rel=1e-6)


# --- behind actions ---


SET = """
scenario = { name = "set", stop = 10.0, step = 0.1 }
actions = [{ %s, set = { "pid.gain" = %s } }]

[components]
setpoint = { kind = "constant", value = 1.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0 }
plant = { kind = "lag", time_constant = 2.0, initial = 0.0 }
alone = { kind = "gain", K = 1.0 }

[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "plant.y"
"plant.u" = "pid.y"
"alone.u" = "plant.y"
"""


@pytest.fixture
def setting(tmp_path):
    """Return a function that writes a loop whose controller gets another gain in the run."""

    def written(when, gain):
        path = tmp_path / "set.toml"
        path.write_text(SET % (when, gain))
        return path

    return written


def test_a_parameter_that_makes_the_coupling_unstable_is_refused_before_the_run(setting):
    """With the action's line and time; what is offered runs, and without it nothing is left.

    The loop itself settles with either gain: dy/dt = (60 (1 - y) + I - y) / 2 s.
    """
    path = setting("at = 4.0", 60.0)
    text = refusal(path)
    begin = f"{path}:3: actions[0]: after the action at 4.0 s, the loop of pid, plant: coupling"
    assert text.startswith(begin)
    assert ", by 1e18 over the rest of the run, more than 10; use step" in text
    assert 'use step = 0.05 or coupling = "newton"; coupling_check = "warn" runs it' in text
    for way_out in ({"scenario.step": 0.05}, {"scenario.coupling": "newton"}):
        assert abs(cosim.run(path, set=way_out)["plant.y"][-1] - 1.0) < 0.05
    memory = cosim.run(path, set=WARN)
    assert abs(memory["plant.y"][-1]) > 1e10
    (warning,) = coupling_warnings(memory)
    assert warning.startswith("after the action at 4.0 s, the loop of pid, plant: coupling")


def test_a_parameter_at_a_condition_is_warned_of(setting):
    """It may never be set, as here; then the run is as good as without it."""
    memory = cosim.run(setting('when = "plant.y > 5"', 60.0))
    assert abs(memory["plant.y"][-1] - 1.0) < 0.05
    (warning,) = coupling_warnings(memory)
    action = "after the action when 'plant.y > 5', linearized at the start"
    assert warning.startswith(f"{action}, the loop of pid, plant: ")


def gains_behind(path, *actions):
    """Return the gains of a run with actions: as it begins, and behind them."""
    return recorded_loop_gains(cosim.run(path, set={"actions": list(actions)}))


def test_a_gain_behind_actions_is_that_of_a_run_with_their_values(setting, tmp_path):
    """In the order of time: the one at 6 s, which the file has first, knows of that at 2 s.

    Two at once are one; of components outside loops there is none. Logs and replays have all.
    """
    path = setting("at = 6.0", 30.0)
    actions = [
        {"at": 6.0, "set": {"pid.gain": 30.0}},
        {"at": 2.0, "set": {"plant.time_constant": 20.0}},
        {"at": 2.0, "set": {"pid.gain": 20.0}},
        {"at": 1.0, "set": {"alone.K": 3.0, "setpoint.value": 2.0}},
    ]
    log = cosim.run(path, set={"actions": actions}, out=tmp_path / "a.mcap")
    gains = recorded_loop_gains(log)
    assert [gain.action[-5:] for gain in gains] == ["", "2.0 s", "6.0 s"]
    assert [gain.steps for gain in gains] == [100, 80, 40]
    for gain, K in zip(gains[1:], (20.0, 30.0), strict=True):
        same = {"pid.gain": K, "plant.time_constant": 20.0, "actions": []}
        (expected,) = recorded_loop_gains(cosim.run(path, set=same))
        assert (gain.rho, gain.rate) == (expected.rho, expected.rate)
    assert recorded_loop_gains(cosim.replay(log)) == gains


def test_a_fault_that_multiplies_an_input_is_checked_as_another_gain_is(setting):
    """K (setpoint - 3 y) and I' = K/Ti (setpoint - 3 y) make of an error what 3 K does.

    What is added makes nothing of it, a release takes the gain back, and one at an input from
    outside the loop is none of its gain. The action that changes the loop is the one named.
    """
    path = setting("at = 4.0", 2.0)
    faults = [
        {"at": 2.0, "signal": "pid.measurement", "offset": 1.0},
        {"at": 4.0, "signal": "pid.setpoint", "gain": 5.0},
        {"at": 4.0, "signal": "pid.measurement", "gain": 3.0},
        {"at": 6.0, "signal": "pid.measurement", "release": True},
    ]
    first, behind, released = gains_behind(path, *faults)
    (own,) = recorded_loop_gains(cosim.run(path, set={"pid.gain": 6.0, "actions": []}))
    assert [gain.action[-5:] for gain in (behind, released)] == ["4.0 s", "6.0 s"]
    assert behind.rho == pytest.approx(own.rho, rel=1e-12)
    assert released.rho == pytest.approx(first.rho, rel=1e-12)
    faults[2]["gain"] = 30.0
    with pytest.raises(ScenarioError, match=r"actions\[2\]: after the action at 4\.0 s, the loop"):
        gains_behind(path, *faults)


def test_a_gain_behind_a_delay_or_a_drop_is_not_known_and_says_so(setting):
    """As what is late, or lost, is not linearized; also behind what is set meanwhile."""
    first, *behind = gains_behind(
        setting("at = 4.0", 2.0),
        {"at": 2.0, "signal": "plant.u", "delay": 0.3},
        {"at": 4.0, "set": {"pid.gain": 60.0}},
        {"at": 5.0, "set": {"pid.gain": 2.0}},
        {"at": 5.0, "signal": "plant.u", "release": True},
        {"at": 6.0, "signal": "pid.measurement", "drop": 0.1},
    )
    late = "unknown: no linearization of the delay of 'plant.u'"
    lost = "unknown: no linearization of the drop of 'pid.measurement'"
    assert [gain.action[-5] for gain in behind] == ["2", "4", "5", "6"]
    assert list(map(gain_text, behind)) == [late, late, gain_text(first), lost]
