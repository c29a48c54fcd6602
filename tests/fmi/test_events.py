"""Events of loaded model exchange FMUs (FMI 2 and 3), with every solver, against closed forms."""

import math
import sys
from contextlib import contextmanager
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.blocks.source import constant
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run as run_graph
from cosim.core.recorders import Memory
from cosim.errors import FmuError
from cosim.fmi.checking.check import check
from cosim.fmi.component import load
from cosim.fmi.driving.events import KEPT, EventList, close, locate
from cosim.fmi.driving.solvers import STEPPING, TOLERANT
from cosim.fmi.options import FmuOptions
from cosim.log import open_log
from cosim.report.verification import verify
from cosim.testing import check_component, check_rollback
from tests.fmi.eventful import Run, build

# Each start is of order 1, so that they need a closer tolerance for the same error.
MULTISTEP = ("BDF", "LSODA", "CVode")
ACCURATE = tuple(solver for solver in STEPPING if solver != "euler")  # to 1e-9 and better


def tolerance(solver):
    return 1e-12 if solver in MULTISTEP else None


# --- state events ---


def bounces(n):
    """Return when a ball from 1 m hits the ground, and the speeds with which it leaves.

    Each speed is 0.7 of the one before.
    """
    times = [math.sqrt(2.0 / 9.81)]
    speeds = [0.7 * math.sqrt(2.0 * 9.81)]
    for _ in range(n - 1):
        times.append(times[-1] + 2.0 * speeds[-1] / 9.81)
        speeds.append(0.7 * speeds[-1])
    return np.array(times), np.array(speeds)


@pytest.mark.fast("RK45", "BDF", "LSODA")
@pytest.mark.parametrize("solver", ACCURATE)
def test_a_bouncing_ball_is_the_closed_form(solver, subtests):
    """Bounce times to 1e-9, the flight after the last of them too.

    No communication point is one of them.
    """
    for version in [2, 3]:
        with subtests.test(version=version):
            with Run("BALL", solver, version=version, rtol=tolerance(solver)) as run:
                rows = run(2.0, 0.01)
                events = np.array(run.events("state event"))
            times, speeds = bounces(len(events))
            assert len(events) == 4
            assert abs(events - times).max() < 1e-9
            flight = 2.0 - times[-1]
            height = speeds[-1] * flight - 9.81 / 2.0 * flight**2
            speed = speeds[-1] - 9.81 * flight
            # an error of 1e-9 in the time is one of 5e-9 in the height at the greatest speed, and
            # of 1e-8 in the speed
            assert rows[-1, 0] == pytest.approx(height, abs=1e-8)
            assert rows[-1, 1] == pytest.approx(speed, abs=2e-8)


@pytest.mark.slow
def test_a_ball_that_does_not_come_to_rest_is_an_error():
    """The bounces accumulate at t = sqrt(2/g) (1 + 0.7)/(1 - 0.7) = 2.5587.

    The run keeps what was before.
    """
    message = r"BALL: 1000 events at t = 2.558\d* s do not advance time: state event"
    with Run("BALL") as run, pytest.raises(Stopped, match=message) as stop:
        run(3.0, 0.01)
    assert (stop.value.failed, stop.value.steps) == (True, 255)


def force(t):
    return 2.0 * t if t <= 1.0 else 4.0 - 2.0 * t


@pytest.mark.fast("rk4", "RK45", "BDF", "CVode")
@pytest.mark.parametrize("solver", ACCURATE)
def test_coulomb_friction_sticks_and_slips(solver, subtests):
    """A mass of 1 kg under the force 2 t, from 1 s on 4 - 2 t, with friction of 1 N.

    It breaks away at 0.5 s; v = (t - 0.5)^2 until 1 s, then 1/4 + 3 (t - 1) - (t^2 - 1), which ends
    at (3 + sqrt(2))/2 s; it sticks until the force is -1 N at 2.5 s; then v = -(t - 2.5)^2.
    """
    for version in [2, 3]:
        with subtests.test(version=version):
            with Run("FRICTION", solver, p=1.0, version=version, rtol=tolerance(solver)) as run:
                rows = run(3.0, 0.05, u=force)
                events = run.events("state event")
            stick = 1.5 + math.sqrt(0.5)
            # v' = 3 - 2 t = -sqrt(2) where it ends: an error of 1e-9 in v is one below 1e-9 in the
            # time
            assert events == pytest.approx([0.5, stick, 2.5], abs=2e-9)
            assert rows[20, 1] == pytest.approx(0.25, abs=1e-8)
            assert rows[-1, 1] == pytest.approx(-0.25, abs=1e-8)
            since_1 = stick - 1.0
            until_1 = 0.125 / 3
            forward = until_1 + 1.25 * since_1 + 1.5 * since_1**2 - (stick**3 - 1.0) / 3.0
            assert rows[48, 0] == pytest.approx(forward, abs=1e-8)
            assert np.array_equal(rows[[9, 11, 44, 48, 51], 2], [0.0, 1.0, 1.0, 0.0, -1.0])


def test_of_several_crossings_in_one_step_the_earliest_comes_first(subtests):
    """Three indicators in one step of 1 s: one at 0.51 s, two at 0.53 s together.

    Their order in the FMU does not matter.
    """
    for solver in STEPPING:
        with subtests.test(solver=solver):
            with Run("TWO", solver, rtol=tolerance(solver)) as run:
                rows = run(1.0, 1.0)
                events = run.events("state event")
            assert events == pytest.approx([0.51, 0.53], abs=1e-9)
            assert rows[-1, 2] == 3.0
            assert rows[-1, 1] == events[-1], (
                "the FMU sees the domains changed at the time of the event"
            )


def switched(stop=1.0, u=(3.0, 1.0), start=0.0, level=0.5):
    """Solve x' = u0 + u1 t - x until x = level, and then u0 + u1 t - 4 x, in closed form."""

    def flow(t, x, begin, rate):
        a = u[0] / rate - u[1] / rate**2
        b = u[1] / rate
        decay = math.exp(-rate * (t - begin))
        return (x - a - b * begin) * decay + a + b * t

    low = 0.0
    high = stop
    for _ in range(60):  # x grows until it is there
        middle = 0.5 * (low + high)
        if flow(middle, start, 0.0, 1.0) < level:
            low = middle
        else:
            high = middle
    return low, flow(stop, level, low, 4.0)


@pytest.mark.parametrize(("solver", "factor"), [("euler", 2.0), ("rk4", 16.0)])
def test_a_fixed_step_keeps_its_order_with_an_event_inside(solver, factor):
    """The step is cut at the event, and goes on with the rest.

    Halving it divides the errors of time and state by 2 or 16.
    """
    when, expected = switched()

    def errors(steps):
        with Run("SWITCH", solver, p=0.5) as run:
            x = run(1.0, 1.0 / steps, u=lambda t: 3.0 + t)[-1, 0]
            (event,) = run.events("state event")
            return abs(np.array([event - when, x - expected]))

    ratio = errors(40) / errors(80)
    assert (abs(ratio / factor - 1.0) < 0.15).all()


def test_a_switched_system_is_the_closed_form(subtests):
    """An exponential before and after the event; the input is a ramp over 100 steps."""
    for solver in ACCURATE:
        with subtests.test(solver=solver):
            when, expected = switched()
            with Run("SWITCH", solver, p=0.5, rtol=None if solver == "rk4" else 1e-12) as run:
                x = run(1.0, 0.01, u=lambda t: 3.0 + t)[-1, 0]
                # rk4: h^4 = 1e-8 times a constant below 0.1; the others: some hundreds of steps
                # with 1e-12
                assert run.events("state event") == pytest.approx([when], abs=3e-9)
                assert x == pytest.approx(expected, abs=3e-9)


def test_an_input_that_jumps_over_an_indicator_is_an_event_there():
    """The force, with a zero-order hold, jumps to 3 N at 0.5 s: v = 2 (t - 0.5) from there."""
    with Run("FRICTION", p=1.0) as run:
        rows = run(1.0, 0.1, u=lambda t: 3.0 * (t >= 0.5), held=(True, False))
        assert run.events("input event") == [0.5]
    assert rows[5, 2] == 1.0
    assert rows[-1, 1] == pytest.approx(1.0, abs=1e-14)


def test_a_continuous_input_that_jumps_between_two_steps_is_seen():
    """An input that is corrected at a communication point makes the solver start anew.

    The events of that change happen there.
    """
    with Run("FRICTION", "DOP853", p=1.0) as run:
        run(0.5, 0.1)
        t = np.array([0.5, 1.0])
        y = run.component.advance(t, 0.5, np.array([[3.0, 0.0], [3.0, 0.0]]))
        assert run.events("state event") == [0.5]
        assert y[0, 1] == pytest.approx(1.0, abs=1e-9)


# --- time events ---


@pytest.mark.fast("rk4", "RK45", "CVode", "LSODA", "euler")
@pytest.mark.parametrize("solver", STEPPING)
def test_a_sawtooth_on_and_between_communication_points(solver, subtests):
    """x' = 1, back to zero at k p: on the points of a step of 20 ms, and between them.

    On a point the outputs are those after the event.
    """
    for version, period in product([2, 3], [0.1, 0.037]):
        with subtests.test(version=version, period=period):
            with Run("SAW", solver, p=period, version=version) as run:
                rows = run(1.0, 0.02)
                events = run.events("time event")
            t = np.arange(51) * 0.02
            ticks = np.floor(t / period + 1e-9)
            assert np.array_equal(rows[:, 3], ticks)
            assert abs(rows[:, 0] - (t - ticks * period)).max() < 1e-12
            # the last point's own event happens with the next step
            expected = period * np.arange(1, 1 + int(ticks[-1]) - (period == 0.1))
            assert events == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(("model", "solver"), [("SAW", "rk4"), ("COUNTER", "rk4")])
def test_a_time_event_a_few_roundings_from_a_communication_point_is_there(model, solver, subtests):
    """Within four spacings of floats it is one time with the point, whose row shows the event.

    No FMU is asked before the time that it announced: one behind the point happens at its own time.
    """
    for spacings in [-5, -3, 0, 1, 3, 4, 5, 8]:
        with subtests.test(spacings=spacings):
            period = 0.1 - spacings * math.ulp(0.1)
            with Run(model, solver, p=period) as run:
                rows = run(0.2, 0.1)
                first, *_ = run.events("time event")
            assert first == (0.1 if 0 <= spacings <= 4 else period)
            assert rows[1, 3] == (0.0 if spacings < -4 else 1.0)


def test_an_fmu_without_states_runs(subtests):
    """A counter: events only, whose times it adds up.

    0.1 + 0.1 + ... leaves the points by a few roundings and counts on time.
    """
    for solver in STEPPING:
        with subtests.test(solver=solver):
            with Run("COUNTER", solver, p=0.1) as run:
                rows = run(1.0, 0.05)
            # up to 0.5 the sum is a point to 4 roundings; after that it may come one point later
            assert np.array_equal(rows[:11, 3], [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5])
            assert rows[-1, 3] in (9.0, 10.0)


# --- events that a step of the solver may pass over ---


@pytest.mark.fast("RK45", "DOP853")
@pytest.mark.parametrize("solver", TOLERANT)
def test_two_crossings_within_a_window_are_found_by_all_solvers(solver):
    """sin t is above cos(0.045) for 0.09 s at each of the 16 maxima of 100 s."""
    with Run("WINDOW", solver, p=math.cos(0.045)) as run:
        rows = run(100.0, 1.0)
        times = run.events("state event")
    assert rows[-1, 3] == len(times) == 32
    maxima = 0.5 * math.pi + 2.0 * math.pi * np.arange(16)
    # a hundredth of a window: the amplitude of multistep solvers drifts by 1e-6, the slope is 0.045
    assert np.allclose(times, np.sort([*(maxima - 0.045), *(maxima + 0.045)]), atol=1e-3, rtol=0.0)


def test_a_shorter_window_needs_a_largest_step():
    """One of 2 ms is seen by chance only, unless the solver's steps are shorter."""
    with Run("WINDOW", "RK45", p=math.cos(0.001)) as run:
        assert run(2.0, 1.0)[-1, 3] == 0.0
    for solver in ("RK45", "rk4", "BDF"):
        with Run("WINDOW", solver, p=math.cos(0.001), max_step=1e-3) as run:
            assert run(2.0, 1.0)[-1, 3] == 2.0
            assert run.value("completed") >= 2000


# --- events that do not end, and the end of the run ---


def test_an_event_iteration_that_never_ends_is_an_error():
    """FMI sets no limit: ours is 100 iterations; the message names the FMU and the time."""
    message = r"ENDLESS: the event iteration at t = 0.325\d* s does not converge in 100 iterations"
    with Run("ENDLESS", p=0.325) as run:
        with pytest.raises(Stopped, match=message) as stop:
            run(1.0, 0.1)
        assert (stop.value.failed, stop.value.steps) == (True, 3)


@pytest.mark.slow
@pytest.mark.parametrize("solver", STEPPING)
def test_a_relay_that_chatters_is_an_error(solver):
    """Without hysteresis the next event is one rounding later.

    The message names the FMU, the time, the limit and what changes its sign.
    """
    message = r"SLIDE: 1000 events at t = 0.32\d* s .*: state event, where event indicator 1 of 1"
    with Run("SLIDE", solver, p=0.325) as run:
        with pytest.raises(Stopped, match=message) as stop:
            run(1.0, 0.1)
        assert (stop.value.failed, stop.value.steps) == (True, 3)
        assert len(run.fmu.drain()) == KEPT + 1


def test_the_indicator_that_chatters_has_its_name_in_fmi_3():
    with Run("SLIDE", p=0.325, version=3) as run, pytest.raises(Stopped, match="where z0 changes"):
        run(1.0, 0.1)


@pytest.mark.fast("rk4", "CVode")
@pytest.mark.parametrize("solver", STEPPING)
def test_any_number_of_events_fits_into_one_communication_step(solver):
    """1 010 of them in 101 s, as long as each advances time: x falls to 0 at each tenth."""
    with Run("SAW", solver, p=0.1, rtol=tolerance(solver)) as run:
        rows = run(101.05, 101.05)
    assert rows[-1, 3] == 1010.0
    assert rows[-1, 0] == pytest.approx(0.05, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "step"), [("CVode", 1.0), ("LSODA", 2.0), ("Radau", 6.0)])
def test_an_event_after_every_step_of_the_solver_is_no_chattering(solver, step):
    """More than 1 000 of them in a communication step; what they add to x is below 1e-9."""
    with Run("STEPS", solver, p=1e-15) as run:
        rows = run(step, step)
    assert rows[-1, 3] > 1000.0
    assert rows[-1, 0] == pytest.approx(step, abs=1e-9)


@pytest.mark.parametrize("version", [2, 3])
def test_the_end_of_the_run_is_requested_in_an_event(version):
    """Time does not advance after it: this FMU would refuse."""
    with Run("ENDS", p=0.325, version=version) as run:
        with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
            run(1.0, 0.1)
        assert (stop.value.failed, stop.value.steps) == (False, 3)
        assert run(0.3, 0.1)[-1, 0] == pytest.approx(0.3), "a new run has no end yet"


def test_events_are_in_the_log(tmp_path):
    """Events are on /cosim/log, at level debug, at their time, however long the block.

    A fall of 1 m takes sqrt(2 / 9.81) s.
    """
    scenario = tmp_path / "ball.toml"
    scenario.write_text(f"""
[scenario]
name = "ball"
stop = 1.0
step = 0.01
[components.zero]
kind = "expression"
y = "0.0*t"
[components.plant]
kind = "fmu"
path = "{build("BALL")}"
[connections]
"plant.u" = "zero.y"
"plant.d" = "zero.y"
""")
    cosim.run(str(scenario), out=tmp_path / "ball.mcap", block=1000)
    messages = open_log(tmp_path / "ball.mcap").messages()
    (bounce,) = [m for m in messages if (m.level, m.source) == ("debug", "plant")]
    assert bounce.text.startswith("event: state event at t = 0.45152364098573")
    assert bounce.time_ns == 451_523_641


# --- the contract ---


def pieces(steps, step):
    """Return a continuous input, and a discrete one that changes every few steps."""
    t = np.arange(steps + 1) * step
    discrete = np.floor(t / (3.5 * step)) % 3
    return np.column_stack([2.0 * np.sin(7.0 * t), discrete])


CASES = {
    "BALL": 0.0,
    "FRICTION": 1.0,
    "SAW": 0.0137,
    "COUNTER": 0.0137,
    "TWO": 0.0,
    "MEMORY": 0.0,
    "SWITCH": 0.02,
}


@contextmanager
def making(model, solver, version=2):
    runs = []

    def make():
        runs.append(Run(model, solver, p=CASES[model], version=version))
        return runs[-1].component

    try:
        yield make
    finally:
        for run in runs:
            run.fmu.close()


PAIRS = list(product(CASES, STEPPING))


def marks_of(pair):
    """Every model with rk4, every solver with the most eventful one; the rest is a campaign."""
    model, solver = pair
    if solver == "rk4":
        return () if model in ("BALL", "COUNTER", "SWITCH") else pytest.mark.slow
    return pytest.mark.slow if model == "FRICTION" and solver != "BDF" else pytest.mark.campaign


@pytest.mark.fast("COUNTER-rk4")
@pytest.mark.parametrize(
    ("model", "solver"),
    [pytest.param(*pair, marks=marks_of(pair)) for pair in PAIRS],
)
def test_fmus_with_events_keep_the_contract(model, solver):
    """Blocks of 1, 7 and all steps give the same bits, outputs changes nothing.

    restore(save()) is the identity, with a memory too. Steps of 30 ms: the ball bounces once, the
    mass slips and sticks, ticks lie between the points, some of them in one step.
    """
    with making(model, solver, version=3 if model in ("TWO", "FRICTION") else 2) as make:
        check_component(make, inputs=pieces(16, 0.03), h=0.03)
        check_rollback(make, inputs=pieces(16, 0.03), h=0.03)


@pytest.mark.slow
def test_events_do_not_depend_on_blocks(subtests):
    """K = 1 equals K = 100, bit for bit, and the events are the same."""

    def result(solver, blocks):
        with Run("FRICTION", solver, p=1.0) as run:
            rows = run(2.6, 0.02, u=force, blocks=blocks)
            return rows.tobytes(), run.events("state event")

    for solver in STEPPING:
        with subtests.test(solver=solver):
            assert result(solver, 1) == result(solver, 100)


def test_outputs_with_other_inputs_leave_a_memory_alone():
    """The FMU counts the changes of d.

    Outputs for another d show the count, and take it back.
    """
    with Run("MEMORY") as run:
        run(0.1, 0.1)
        for d, count in ((1.0, 1.0), (0.0, 0.0), (2.0, 1.0)):
            assert run.component.outputs(0.1, np.array([0.0, d]))[2] == count
        u = np.array([[0.0, 2.0], [0.0, 2.0]])
        y = run.component.advance(np.array([0.1, 0.2]), 0.1, u)
        assert y[0, 2] == 1.0


# --- solvers ---


def test_nominal_values_scale_the_absolute_tolerance():
    """x decays to 1e-6 of its nominal value.

    With a nominal value of 1e-6 the same solver takes more steps.
    """
    count = {}
    for nominal in (1.0, 1e-6):
        with Run("SWITCH", "RK45", p=0.5, nominal=nominal, rtol=1e-6) as run:
            run(5.0, 5.0, u=lambda t: 1e-6)
            count[nominal] = run.value("evaluations")
    assert count[1e-6] > 1.5 * count[1.0]


def test_a_nominal_value_of_zero_is_taken_as_one():
    """With the same rows as 1 itself, and said once."""
    rows = []
    warnings = []
    for nominal in (0.0, 1.0):
        with Run("SWITCH", "BDF", p=0.5, nominal=nominal) as run:
            rows.append(run(1.0, 0.1))
            messages = run.component.drain()
        warnings.append([message.text for message in messages if message.level == "warning"])
    assert np.array_equal(*rows)
    text = "SWITCH: nominal value of state 0: found 0.0; needed a number other than zero"
    assert warnings == [[f"{text}, taken as 1"], []]


@pytest.mark.slow
@pytest.mark.parametrize(("nominal", "found"), [("0.0", "0"), ("-2.0", "-2"), ("0.0/0.0", "nan")])
def test_a_nominal_value_that_is_none_is_named_and_not_used(nominal, found):
    """What an FMU returns of a state while it runs; x' = -x is linearized all the same."""
    path = build("SWITCH", 2, f"({nominal})")
    texts = [finding.text for finding in check(path) if "nominal" in finding.text]
    assert texts == [f"nominal value of 'x': expected a finite number > 0, got {found}"]
    assert cosim.linearize(path).A.tolist() == [[-1.0]]


def test_a_tolerance_that_is_none_is_refused(subtests):
    for rtol in [0.0, 1e-16, 1.0, math.nan]:
        with subtests.test(rtol=rtol):
            message = (
                f"SWITCH: relative tolerance: expected at least 1e-13 and less than 1, got {rtol}"
            )
            with pytest.raises(FmuError, match=message):
                Run("SWITCH", "BDF", rtol=rtol)


def test_a_tolerance_for_a_solver_that_keeps_none_is_refused():
    message = (
        "SWITCH: relative tolerance 1e-06: solver 'rk4' takes the steps it is given; leave it out "
        "or use one of: RK23, RK45, DOP853"
    )
    with pytest.raises(FmuError, match=message):
        Run("SWITCH", "rk4", rtol=1e-6)


def test_completed_integrator_step_is_called_after_every_step_of_the_solver():
    """rk4: once a communication step, and once more for each of the events inside.

    An adaptive solver takes steps of its own.
    """
    with Run("TWO") as run:
        run(1.0, 0.1)
        assert run.value("completed") == 10 + 2
    with Run("SWITCH", "DOP853", p=10.0) as run:
        run(1.0, 1.0)
        assert 1.0 < run.value("completed") < run.value("evaluations") / 12


@pytest.mark.fast("RK45-1.2", "DOP853-1.1", "CVode-2.0")
@pytest.mark.parametrize(
    ("solver", "ratio"),
    [("RK45", 1.2), ("DOP853", 1.1), ("Radau", 1.1), ("BDF", 2.0), ("CVode", 2.0)],
)
def test_solvers_run_on_over_communication_points(solver, ratio):
    """Compare the evaluations over 0.2 s in steps of 1 ms with and without jumps of the input.

    The input jumps by 1e-12 at every communication point.
    """

    def evaluations(wobble):
        with Run("SWITCH", solver, p=10.0) as run:
            component = run.component
            component.prepare(1e-3, np.array([False, False]), {})
            component.initialize(0.0, np.array([1.0, 0.0]))
            for k in range(200):
                u = np.array([[1.0 + wobble * (k % 2), 0.0]] * 2)
                component.advance(np.array([k, k + 1]) * 1e-3, 1e-3, u)
            return run.value("evaluations")

    assert evaluations(1e-12) > ratio * evaluations(0.0)


def test_no_cvode_on_this_machine_is_an_error(monkeypatch):
    """Where fmpy has no libraries, the message names the machine and what to use instead."""
    monkeypatch.setitem(sys.modules, "fmpy.sundials", None)
    monkeypatch.delattr("fmpy.sundials", raising=False)
    message = (
        r"solver 'CVode': fmpy has no SUNDIALS libraries for \w+-\w+ \(.*\); "
        "use 'BDF' or 'Radau'"
    )
    with pytest.raises(FmuError, match=message):
        Run("SWITCH", "CVode", p=0.5)


def test_cvode_says_why_it_fails(capfd):
    """A derivative that is not finite; nothing is printed."""
    with (
        Run("SWITCH", "CVode", p=0.5) as run,
        pytest.raises(Stopped, match=r"solver CVode: At t = 0 .*corrector convergence"),
    ):
        run(1.0, 0.1, u=lambda t: math.nan)
    assert capfd.readouterr() == ("", "")


# --- the parts ---


def test_a_crossing_is_located_to_rounding_and_on_its_far_side(subtests):
    """Whatever the slope: flat, steep, a jump; in no more evaluations than bisection and one."""
    for number, (z, root) in enumerate(
        [
            (lambda t: t - 0.3, 0.3),
            (lambda t: 1e-30 * (t - 0.3), 0.3),
            (lambda t: (t - 0.3) ** 9, 0.3),
            (lambda t: math.copysign(1.0, t - 0.3), 0.3),
            (lambda t: math.exp(50.0 * t) - math.exp(15.0), 0.3),
            (lambda t: t * 1e-300, 0.0),
            (lambda t: 1.0 if t < 1.0 else -1.0, 1.0),
            # secants that lead astray: the slope changes by orders of magnitude at the root
            (lambda t: (t - 0.3) * (1e-9 if t > 0.3 else 1.0), 0.3),
            (lambda t: (t - 0.3) ** 3 * (1e-9 if t > 0.3 else 1.0), 0.3),
            (lambda t: (t - 0.3) * (1e6 if t > 0.3 else 1.0), 0.3),
        ]
    ):
        with subtests.test(number=number):
            times = []

            def indicators(t, z=z, times=times):
                times.append(t)
                return np.array([z(t)])

            t = locate(indicators, 0.0, np.array([z(0.0)]), 1.0, np.array([z(1.0)]))
            assert (z(t) > 0.0) == (z(1.0) > 0.0)
            # below, the function itself is rounded: (t - 0.3)^9 vanishes for a difference below
            # 1e-36
            assert abs(t - root) <= 2.0 * close(1.0)
            assert len(times) <= math.ceil(math.log2(1.0 / close(1.0))) + 1
            assert all(0.0 < time < 1.0 for time in times)


def test_the_list_of_events_is_bounded():
    """The first of a step are listed, the rest is counted.

    What was fetched is gone, and what was undone comes back.
    """
    events = EventList()
    for k in range(KEPT + 3):
        events.add("time event", float(k))
    saved = events.save()
    events.begin_step()
    events.add("state event", 0.25)
    assert events.drain()[-1] == (0.25, "debug", "event", "state event at t = 0.25 s")
    events.restore(saved)
    texts = [text for *_, text in events.drain()]
    assert texts[-1] == "3 more events of this step are not listed"
    assert len(texts) == KEPT + 1
    assert texts[KEPT - 1] == f"time event at t = {float(KEPT - 1)} s"
    assert events.drain() == []


@pytest.mark.parametrize("fetched_after", [1, 7, 50])
def test_how_many_events_are_listed_does_not_depend_on_the_blocks(fetched_after):
    """Steps of 0, 30, ... 270 events: each lists its first, however often the list is fetched."""
    events = EventList()
    listed = []
    for step in range(50):
        events.begin_step()
        for k in range(30 * (step % 10)):
            events.add("state event", step + k / 1000)
        if step % fetched_after == fetched_after - 1:
            listed += events.drain()
    listed += events.drain()
    counts = [30 * (step % 10) for step in range(50)]
    assert len(listed) == sum(min(count, KEPT) + (count > KEPT) for count in counts)
    assert [message.time for message in listed] == sorted(message.time for message in listed)


# --- what others see of an event at a communication point ---


def integral():
    zero = np.zeros((1, 1))
    return Linear(controller(A=zero, B=np.eye(1), C=np.eye(1), D=zero))


def integrated(saw, *, native, block):
    """Run i' = x behind a sawtooth x, for 1 s in steps of 20 ms; return the recording."""
    components = {"u": constant([0.0]), "a": saw, "i": integral()}
    connections = {"a.u": "u.y", "a.d": "u.y", "i.u": "a.x"}
    graph = Graph(components, connections, native=native)
    memory = Memory()
    run_graph(graph, Clock(1.0, 0.02, block=block), memory)
    return memory


@pytest.mark.fast("rk4")
@pytest.mark.parametrize("solver", ["rk4", "RK45", "BDF"])
def test_a_follower_of_a_jumping_output_gets_its_left_limit(solver, subtests):
    """The integral of ten teeth of 0.1 s is 10 (0.1^2 / 2), in blocks of any length.

    With the right limit at the end of the step before it, each tooth would lose 0.1 h/2, a fifth of
    all.
    """
    for version, saves in product([2, 3], [True, False]):
        with subtests.test(version=version, saves=saves):
            recordings = []
            for native, block in ((True, None), (False, None), (True, 1), (False, 7)):
                path = build("SAW", version, saves=saves)
                with load(path, FmuOptions(solver=solver, start={"p": 0.1})) as fmu:
                    assert fmu.component.interface.left_limits == ("x", "v")
                    recordings.append(integrated(fmu.component, native=native, block=block))
            tolerance = (
                1e-13 if solver == "rk4" else 1e-8
            )  # x' = 1 is exact but for roundings; rtol 1e-9
            first = recordings[0]
            assert abs(first["i.y"][-1] - 0.05) < tolerance
            jumps = [event for event in first.events() if event.signal == "a.x"]
            assert [event.time_ns for event in jumps] == [k * 100_000_000 for k in range(1, 11)]
            assert {event.cause for event in jumps} == {"jump"}
            assert all(abs(event.values[0] - 0.1) < tolerance for event in jumps)
            for other in recordings[1:]:
                assert other.rows("i").tobytes() == first.rows("i").tobytes()
                assert other.events() == first.events()


def test_a_loop_is_solved_for_what_does_not_jump_in_an_fmu():
    """What closes the loop, u, moves nothing in the FMU: ten teeth of height 0.1 have 0.05."""
    components = {"u": constant([0.0]), "i": integral()}
    connections = {"a.u": "i.y", "a.d": "u.y", "i.u": "a.x"}
    with load(build("SAW", 2), FmuOptions(solver="rk4", start={"p": 0.1})) as fmu:
        graph = Graph({**components, "a": fmu.component}, connections, coupling="newton")
        memory = Memory()
        run_graph(graph, Clock(1.0, 0.02), memory)
    assert [text for component, text in graph.warnings if "ramp" in text] == []
    assert memory["i.y"][-1] == pytest.approx(0.05, abs=1e-12)


def sampled_loop(*, saves, coupling, native):
    """Run x' = q from 1, with q = -x as an FMU samples it every 0.1 s; return x there, warnings."""
    zero = np.zeros((1, 1))
    plant = controller(A=zero, B=np.eye(1), C=np.eye(1), D=zero, x0=np.ones(1))
    components = {"c": constant([0.0]), "x": Linear(plant)}
    connections = {"m.u": "x.y", "m.d": "c.y", "x.u": "m.q"}
    path = build("SAMPLE", saves=saves)
    with load(path, FmuOptions(solver="rk4", start={"p": 0.1})) as fmu:
        components["m"] = fmu.component
        graph = Graph(components, connections, coupling=coupling, native=native)
        memory = Memory()
        run_graph(graph, Clock(1.0, 0.05), memory)
    return memory["x.y"][::2], graph.warnings


@pytest.mark.parametrize("coupling", ["gauss-seidel", "newton", "jacobi"])
def test_a_loop_sees_an_event_at_a_communication_point_together(coupling, subtests):
    """The closed form is 1 up to 0.1 s, and 0.9 times the last value at every tick behind it.

    With Jacobi an FMU that cannot go back has sampled what x was a step before: that is said.
    """
    for native, saves in product([True, False], [True, False]):
        with subtests.test(native=native, saves=saves):
            x, warnings = sampled_loop(saves=saves, coupling=coupling, native=native)
            exact = 0.9 ** np.maximum(np.arange(11) - 1.0, 0.0)
            if saves or coupling != "jacobi":
                assert np.abs(x - exact).max() < 1e-14
                assert warnings == []
            else:
                assert np.abs(x - exact).max() > 0.01
                ((component, text),) = warnings
                assert component == "m"
                assert "canGetAndSetFMUstate" in text
                assert "first order" in text


def test_events_that_are_followed_are_replayed_from_the_log(tmp_path):
    """The FMU is taken from the log then, with its left limits; in blocks of any length."""
    scenario = tmp_path / "saw.toml"
    scenario.write_text(f"""
[scenario]
name = "saw"
stop = 0.5
step = 0.02
[components]
zero = {{ kind = "constant", value = 0.0 }}
saw = {{ kind = "fmu", path = "{build("SAW")}", start = {{ p = 0.1 }} }}
i = {{ kind = "controller", A = [[0.0]], B = [[1.0]], C = [[1.0]] }}
[connections]
"saw.u" = "zero.y"
"saw.d" = "zero.y"
"i.u" = "saw.x"
""")
    log = cosim.run(str(scenario), out=tmp_path / "saw.mcap")
    assert log["i.y"][-1] == pytest.approx(5 * 0.1**2 / 2, rel=1e-9)
    jumps = [event.time_ns for event in log.events() if event.signal == "saw.x"]
    assert jumps == [100_000_000 * k for k in range(1, 6)]
    replayed = cosim.replay(log)
    assert verify(log, replayed).passed
    assert replayed.events() == log.events()
    for block in (1, 7):
        other = cosim.run(str(scenario), block=block, out=tmp_path / f"{block}.mcap")
        assert other.content_hash() == log.content_hash()
        assert other.events() == log.events()
