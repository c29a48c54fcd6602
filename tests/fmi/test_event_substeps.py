"""Substeps of loops that end at the events of FMUs, at the time that the FMU gave.

Two lags, or a lag and an FMU for model exchange, in a loop. ``x1`` of the first lag grows by 1 at
the multiples of ``PERIOD``, which the FMU announces or meets::

    x1' = -x1 - x2,  x2' = x1 - x2
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import cosim
from cosim.blocks.source import constant
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.errors import ScenarioError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.report.verification import verify
from tests.fmi import eventful
from tests.fmi.lag import able
from tests.fmi.lag import build as build_lag

PERIOD = 0.07
MATRIX = np.array([[-1.0, -1.0], [1.0, -1.0]])


def exact(t):
    """Return x1 and x2 at t, after an event there."""
    events = np.arange(1, 100) * PERIOD
    past = events[events <= t + 1e-9]
    return sum((expm(MATRIX * (t - event)) @ [1.0, 0.0] for event in past), np.zeros(2))


@pytest.fixture(scope="module")
def lag(tmp_path_factory):
    """Build the lag once."""
    return build_lag(tmp_path_factory.mktemp("lag"), "3")


@pytest.fixture
def jumping(lag, tmp_path):
    """Return a lag with events, as a path; ``can`` as in ``tests.fmi.lag``."""

    def make(*can):
        return able(lag, tmp_path / "jumping.fmu", "3", "any step", "state", *can)

    return make


def second(lag, tmp_path, kind):
    """Return the second component of the loop: an FMU, or a linear one of cosim."""
    if kind == "fmu":
        path = able(lag, tmp_path / "second.fmu", "3", "any step", "state", "lines")
        return load(path, FmuOptions()).component
    one = np.eye(1)
    return Linear(controller(A=-one, B=one, C=one, D=0 * one, x0=np.zeros(1)))


def run_loop(
    first,
    other,
    *,
    tolerance,
    stop=1.0,
    native=True,
    block=None,
    gain=-1.0,
    coupling="newton",
):
    """Run the loop of both lags with substeps; return its recording and how many it took."""
    output = "two.y" if isinstance(other, Linear) else "two.x"
    components = {"zero": constant([0.0]), "one": first, "two": other}
    connections = {
        "one.u": Connection((output,), gain=np.array([[gain]])),
        "one.d": "zero.y",
        "two.u": "one.x",
    }
    if not isinstance(other, Linear):
        connections["two.d"] = "zero.y"
    limits = SubstepTolerance(tolerance, tolerance, 1000)
    graph = Graph(components, connections, coupling=coupling, substeps=limits, native=native)
    memory = Memory()
    run(graph, Clock(stop, 0.1, block), memory)
    return memory, graph.substep_controls[0].counts


def errors(memory, other):
    """Return the largest error of x1 and x2 at the communication points."""
    x2 = memory["two.y" if isinstance(other, Linear) else "two.x"]
    found = np.column_stack([memory["one.x"], x2])
    return np.abs(found - [exact(0.1 * k) for k in range(len(found))]).max()


def event_ends(memory):
    return [s.end for s in memory.substeps() if s.accepted and s.event]


@pytest.mark.fast("lines0-0.0-linear", "lines1-1.0-fmu", "lines1-0.0-linear", "lines0-1.0-fmu")
@pytest.mark.parametrize("kind", ["fmu", "linear"])
@pytest.mark.parametrize("announces", [0.0, 1.0])
@pytest.mark.parametrize("lines", [("lines",), ()])
def test_a_loop_ends_its_substeps_at_the_events_of_an_fmu(
    lag, jumping, tmp_path, kind, announces, lines
):
    """At each of the 13 between communication points, and the errors follow the tolerance.

    Refined around the jumps there would be four to six times as many substeps.
    """
    times = [k * PERIOD for k in range(1, 15) if k % 10]
    used = []
    for tolerance in (1e-4, 1e-6):
        options = FmuOptions(start={"event": PERIOD, "announces": announces})
        with load(jumping("events", *lines), options) as fmu:
            other = second(lag, tmp_path, kind)
            memory, counts = run_loop(fmu.component, other, tolerance=tolerance)
            assert errors(memory, other) < 100 * tolerance
        assert event_ends(memory) == times
        assert counts.events == len(times)
        assert counts.missed == 0
        used.append(counts.accepted)
    # of second order, a local error of third: 100 ** (1 / 3) = 4.6 times as many at most
    assert used[0] < used[1] < 5 * used[0] < 300


def test_a_substep_up_to_an_event_ends_with_what_was_before_it(lag, jumping, tmp_path):
    """The other lag takes that, not a ramp up to what is behind it: /cosim/step has both."""
    options = FmuOptions(start={"event": PERIOD, "announces": 1.0})
    with load(jumping("events", "lines"), options) as fmu:
        memory, _ = run_loop(fmu.component, second(lag, tmp_path, "fmu"), tolerance=1e-6)
    (first, *_) = [s for s in memory.substeps() if s.accepted and s.event]
    assert first.event == "one"
    assert first.values[2] == 1.0  # u, d, x of the first component
    assert first.values[-1] == 0.0  # the left limit of what jumps and is followed


def test_an_early_return_without_event_mode_ends_a_substep(lag, jumping, tmp_path):
    """The FMU returns at the multiples of 0.03 s, and wants to be gone on from there."""
    options = FmuOptions(start={"returns": 0.03})
    with load(jumping("lines", "returns"), options) as fmu:
        memory, _ = run_loop(fmu.component, second(lag, tmp_path, "fmu"), tolerance=1e-4)
    assert event_ends(memory)[:4] == [0.03, 0.06, 0.09, 0.12]


@pytest.mark.fast("None-True", "1-True", "3-False")
@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("block", [None, 1, 3])
def test_blocks_and_compiled_code_change_no_bit(lag, jumping, tmp_path, native, block):
    """Neither of the rows nor of the substeps."""
    runs = []
    for options in ({}, {"native": native, "block": block}):
        start = FmuOptions(start={"event": PERIOD, "announces": 1.0})
        with load(jumping("events", "lines"), start) as fmu:
            other = second(lag, tmp_path, "linear")
            runs.append(run_loop(fmu.component, other, tolerance=1e-5, **options)[0])
    first, again = runs
    assert again.substeps() == first.substeps()
    for signal in ("one.u", "one.x", "two.y"):
        assert again[signal].tobytes() == first[signal].tobytes()


# --- state events of model exchange ---

THRESHOLD = 0.8


def switched(t_end):
    """Return x, b and the event of x' = 6 - b - (1 or 4) x, b' = x - b, which switches at 0.8."""

    def right_hand_side(rate):
        return lambda t, y: [6.0 - y[1] - rate * y[0], y[0] - y[1]]

    def crossing(t, y):
        return y[0] - THRESHOLD

    crossing.terminal = True
    precise = {"rtol": 1e-13, "atol": 1e-14, "method": "DOP853"}
    before = solve_ivp(right_hand_side(1.0), (0.0, t_end), [0.0, 0.0], events=crossing, **precise)
    event = before.t[-1]
    after = solve_ivp(right_hand_side(4.0), (event, t_end), before.y[:, -1], **precise)
    return after.y[:, -1], event


def run_switched(lag, tmp_path, *, version, solver, tolerance, native=True):
    """Run that loop, x from an FMU for model exchange and b from a lag, for 1 s."""
    rtol = None if solver == "rk4" else 1e-11
    options = FmuOptions(solver=solver, start={"p": THRESHOLD}, tolerance=rtol)
    with load(eventful.build("SWITCH", version), options) as fmu:
        components = {
            "zero": constant([0.0]),
            "six": constant([6.0]),
            "a": fmu.component,
            "b": second(lag, tmp_path, "fmu"),
        }
        connections = {
            "a.u": Connection(("b.x", "six.y"), gain=np.array([[-1.0, 1.0]])),
            "a.d": "zero.y",
            "b.d": "zero.y",
            "b.u": "a.x",
        }
        limits = SubstepTolerance(tolerance, tolerance, 1000)
        graph = Graph(components, connections, coupling="newton", substeps=limits, native=native)
        memory = Memory()
        run(graph, Clock(1.0, 0.1), memory)
    return memory


@pytest.mark.slow
@pytest.mark.parametrize(
    ("version", "solver"),
    [(2, "rk4"), (3, "RK45"), pytest.param(2, "BDF", marks=pytest.mark.campaign)],
)
def test_a_state_event_ends_a_substep(lag, tmp_path, version, solver):
    """Where it is with the inputs of the loop is found by and by, in compiled code as in Python."""
    expected, event = switched(1.0)
    for tolerance in (1e-4, 1e-6):
        memory = run_switched(lag, tmp_path, version=version, solver=solver, tolerance=tolerance)
        found = [memory["a.x"][-1], memory["b.x"][-1]]
        assert np.abs(found - expected).max() < 20 * tolerance
        ends = event_ends(memory)
        assert 1 <= len(ends) <= 10
        assert abs(ends[-1] - event) < tolerance
        python = run_switched(
            lag, tmp_path, version=version, solver=solver, tolerance=tolerance, native=False
        )
        assert python.substeps() == memory.substeps()


SAW = 0.3  # where x of RESET falls to 0


def sawing(gain, t_end):
    """Return x and b of x' = 1 + gain b, b' = x - b, and the times at which x falls from SAW."""

    def right_hand_side(t, y):
        return [1.0 + gain * y[1], y[0] - y[1]]

    def full(t, y):
        return y[0] - SAW

    full.terminal = True
    full.direction = 1.0
    precise = {"rtol": 1e-13, "atol": 1e-14, "method": "DOP853", "events": full}
    t, y, events = 0.0, np.zeros(2), []
    while True:
        solution = solve_ivp(right_hand_side, (t, t_end), y, **precise)
        t, y = solution.t[-1], solution.y[:, -1]
        if solution.status == 0:
            return y, events
        events.append(t)
        y = y - [SAW, 0.0]


@pytest.mark.fast("linear--1.0-newton", "linear--1.0-gauss-seidel")
@pytest.mark.parametrize("coupling", ["newton", "gauss-seidel"])
@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize("kind", ["fmu", "linear"])
def test_a_jump_that_moves_its_own_event_ends_a_substep(lag, tmp_path, kind, gain, coupling):
    """With a gain of 1 a jump inside a part puts itself off until behind it: nothing solves that.

    What one and two steps are compared by are the left limits: only one of both may have jumped.
    """
    expected, events = sawing(gain, 1.0)
    for tolerance in (1e-4, 1e-6):
        # local errors of order 3 or 2, of which each may be as large as tolerated
        bound = 100 * tolerance if coupling == "newton" else math.sqrt(tolerance)
        options = FmuOptions(solver="RK45", start={"p": SAW}, tolerance=1e-11)
        with load(eventful.build("RESET"), options) as fmu:
            other = second(lag, tmp_path, kind)
            memory, counts = run_loop(
                fmu.component, other, tolerance=tolerance, gain=gain, coupling=coupling
            )
        found = [memory["one.x"][-1], memory["two.x" if kind == "fmu" else "two.y"][-1]]
        assert np.abs(found - expected).max() < bound
        ends = np.array(event_ends(memory))
        assert max(np.abs(ends - event).min() for event in events) < bound
        assert len(ends) <= 4 * len(events)
        assert counts.missed == 0


# --- logs ---

SCENARIO = """
[scenario]
name = "jumps"
stop = 0.5
step = 0.1
coupling = "newton"
[scenario.substeps]
rtol = 1e-5
atol = 1e-5
[components]
zero = {{ kind = "constant", value = 0.0 }}
one = {{ kind = "fmu", path = "{one}", start = {{ event = 0.07, announces = 1.0 }} }}
two = {{ kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]] }}
[connections]
"one.u" = {{ from = "two.y", gain = -1.0 }}
"one.d" = "zero.y"
"two.u" = "one.x"
"""


def test_a_log_is_replayed_with_its_substeps_at_events(jumping, tmp_path):
    """The linear component takes them again, of lengths that no design was recorded for."""
    scenario = tmp_path / "jumps.toml"
    scenario.write_text(SCENARIO.format(one=jumping("events", "lines")))
    log = cosim.run(str(scenario), out=tmp_path / "x.mcap")
    ends = [s.end for s in log.substeps() if s.accepted and s.event]
    assert ends == [k * PERIOD for k in range(1, 8)]
    assert log["two.y"][-1] == pytest.approx(exact(0.5)[1], abs=1e-3)
    replayed = cosim.replay(log)
    verification = verify(log, replayed)
    assert verification.passed, verification.problems
    assert replayed.substeps() == log.substeps()
    assert all(math.isfinite(value) for s in log.substeps() for value in s.values)


def test_a_recording_of_a_component_with_events_inside_steps_is_warned_of(jumping, tmp_path):
    """Of its substeps, another scenario takes the rows alone; the one at 0.7 s is a jump there."""
    scenario = tmp_path / "jumps.toml"
    scenario.write_text(SCENARIO.format(one=jumping("events", "lines")).replace("0.5", "0.8"))
    log = cosim.run(str(scenario), out=tmp_path / "x.mcap")
    swapped = cosim.run(str(scenario), swap={"one": log.path})
    texts = [message.text for message in swapped.messages() if message.level == "warning"]
    jump = "has 1 jump(s), the first at t = 0.7 s: what it drives gets a ramp of a step"
    inside = (
        "has 10 event(s) between communication points, the first at t = 0.07 s: between its rows "
    )
    for part in (jump, inside):
        assert sum(part in text for text in texts) == 1


@pytest.mark.parametrize("coupling", ["newton", "gauss-seidel"])
def test_why_an_fmu_cannot_go_back_is_said_with_the_refusal(tmp_path, coupling):
    """It declares that it can; the trial is what shows that it cannot, here as it ends."""
    scenario = tmp_path / "ends.toml"
    text = SCENARIO.format(one=eventful.build("ENDS")).replace("newton", coupling)
    scenario.write_text(text.replace("event = 0.07, announces = 1.0", "p = 0.1"))
    with pytest.raises(ScenarioError) as caught:
        cosim.run(str(scenario))
    refusal, reason = str(caught.value).splitlines()
    assert "ends.toml:7: scenario.substeps: one in this loop cannot take part of a step" in refusal
    assert "components.one: ENDS: its state is not saved, although it says that it can be" in reason


def test_a_run_that_an_fmu_ends_inside_a_step_is_verified(jumping, tmp_path):
    """The substeps of the step that has no row are not those of the run."""
    scenario = tmp_path / "jumps.toml"
    text = SCENARIO.format(one=jumping("events", "lines"))
    scenario.write_text(text.replace("announces = 1.0", "announces = 1.0, end = 0.35"))
    log = cosim.run(str(scenario), out=tmp_path / "x.mcap")
    assert log.time("two.y")[-1] == 0.3
    assert max(s.end for s in log.substeps()) == 0.3
    verification = verify(log, cosim.replay(log))
    assert verification.passed, verification.problems
