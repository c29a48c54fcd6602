"""Faults of signals: what an input gets in place of what its source gives."""

import math
import pickle

import numpy as np
import pytest

from cosim.blocks.arithmetic import gain
from cosim.blocks.source import constant, sine
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.recorders import Memory
from cosim.core.recording import SignalEvent
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.stepping.repeating import RecordedChanges, repeat
from cosim.errors import GraphError, LogError, NonFiniteError
from tests.core.graphs import loop
from tests.core.parts import Scripted, integrator, times

STEP = 0.1
BEGIN = 5
FAULTS = [
    ("freeze", ()),
    ("offset", (0.5,)),
    ("gain", (-2.0,)),
    ("drift", (0.25,)),
    ("noise", (0.1, 7)),
    ("drop", (0.4, 7)),
    ("delay", (3,)),
]
ids = [kind for kind, _ in FAULTS]


def clock(steps=40):
    return Clock(steps * STEP, STEP)


def driven(**options):
    """Return a source, a gain of 1 and an integrator behind it."""
    components = {"s": sine(rate=1.0, offset=1.0), "g": times(1.0), "x": integrator()}
    return Graph(components, {"g.u": "s.y", "x.u": "g.y"}, **options)


def faulty(kind, parameters, graph=None, to="g.u", steps=35):
    """Return source and input from the beginning of a fault on, without the row of its instant."""
    simulation = Simulation(driven() if graph is None else graph, clock())
    before = simulation.step(BEGIN)
    simulation.inject(to, kind, parameters)
    rows = simulation.step(steps)
    s = np.concatenate([before["s.y"][-1:], rows["s.y"]])[:, 0]
    return s, rows[to][:, 0]


def test_a_frozen_input_keeps_its_value():
    """That of the row at the instant."""
    s, u = faulty("freeze", ())
    assert (u == s[0]).all()


def test_an_offset_is_added():
    """At once, and at every communication point."""
    s, u = faulty("offset", (0.5,))
    assert (u == s[1:] + 0.5).all()


@pytest.mark.parametrize("factor", [-2.0, 0.0])
def test_a_gain_scales(factor):
    """0 is a gain like any other."""
    s, u = faulty("gain", (factor,))
    assert (u == factor * s[1:]).all()


def test_a_drift_grows_from_zero():
    """By rate times the time since its beginning."""
    s, u = faulty("drift", (0.25,))
    assert (u == s[1:] + 0.25 * (np.arange(1, 36) * STEP)).all()


def test_a_delay_holds_the_first_value_until_it_has_passed():
    """s(max(t0, t - d))."""
    s, u = faulty("delay", (3,))
    assert u[:2].tolist() == [s[0]] * 2
    assert u[2:].tolist() == s[:-3].tolist()


def test_noise_has_its_deviation_and_depends_on_seed_and_element_alone():
    """Mean and deviation of N numbers lie within 5/sqrt(N), 5/sqrt(2 N) deviations of theirs."""
    count = 4000
    components = {"c": constant([0.0, 0.0]), "g": gain(np.eye(2))}
    runs = {}
    for seed in (1, 2):
        graph = Graph(components, {"g.u": "c.y"})
        simulation = Simulation(graph, clock(count + BEGIN))
        simulation.step(BEGIN)
        simulation.inject("g.u", "noise", (0.1, seed, 0.1, seed))
        runs[seed] = simulation.step(count)["g.u"]
        u = runs[seed]
        assert (abs(u.mean(axis=0)) < 0.1 * 5 / np.sqrt(count)).all()
        assert (abs(u.std(axis=0) - 0.1) < 0.1 * 5 / np.sqrt(2 * count)).all()
        assert abs(np.corrcoef(u.T)[0, 1]) < 5 / np.sqrt(count)
    assert abs(np.corrcoef(runs[1][:, 0], runs[2][:, 0])[0, 1]) < 5 / np.sqrt(count)
    simulation = Simulation(Graph(components, {"g.u": "c.y"}), clock(count))
    simulation.inject("g.u[1]", "noise", (0.1, 2))
    assert (simulation.step(20)["g.u"][:, 1] == runs[2][:20, 1]).all()


def test_a_dropped_sample_leaves_the_last_value_that_arrived():
    """With the probability, within 5 sqrt(p (1 - p) / N)."""
    count = 4000
    simulation = Simulation(driven(), clock(count + BEGIN))
    before = simulation.step(BEGIN)
    simulation.inject("g.u", "drop", (0.25, 3))
    rows = simulation.step(count)
    s = rows["s.y"][:, 0]
    u = rows["g.u"][:, 0]
    lost = u != s
    last = np.concatenate([before["g.u"][-1], u])[:-1]
    assert (u[lost] == last[lost]).all()
    assert abs(lost.mean() - 0.25) < 5 * np.sqrt(0.25 * 0.75 / count)


class Optional:
    """Counts the samples that it gets."""

    def __init__(self):
        self.interface = Interface((Signal("u", optional=True),), (Signal("y"),))

    def initialize(self, t, u):
        self.count = 0.0
        return np.array([self.count])

    def outputs(self, t, u):
        return np.array([self.count])

    def advance(self, t, h, u):
        counts = self.count + np.cumsum(np.isfinite(u[1:, 0]))
        self.count = float(counts[-1])
        return counts[:, np.newaxis]


@pytest.mark.parametrize("native", [True, False])
def test_a_dropped_sample_of_an_optional_input_is_no_value(native):
    """All of them with probability 1, until it is released."""
    components = {"s": Scripted(np.arange(50.0)), "c": Optional()}
    simulation = Simulation(Graph(components, {"c.u": "s.y"}, native=native), clock())
    simulation.step(BEGIN)
    simulation.inject("c.u", "drop", (1.0, 0))
    rows = simulation.step(10)
    assert np.isnan(rows["c.u"]).all()
    assert (rows["c.y"] == BEGIN).all()
    simulation.release("c.u")
    assert simulation.step(3)["c.y"][:, 0].tolist() == [BEGIN + 1.0, BEGIN + 2.0, BEGIN + 3.0]


def test_direct_feedthrough_follows_a_fault_at_once():
    """The row keeps the value before; the step begins behind the jump, with no ramp."""
    simulation = Simulation(driven(), clock())
    rows = simulation.step(BEGIN)
    simulation.inject("g.u", "offset", (0.5,))
    assert simulation["x.u"] == rows["s.y"][-1] + 0.5
    assert rows["x.u"][-1] == rows["s.y"][-1]
    simulation.release("g.u")
    assert simulation["x.u"] == rows["s.y"][-1]


def follow(simulation, kind, parameters, size):
    """Inject faults into a loop and a cascade, release and change them; return the rows."""
    rows = []
    schedule = {
        3: [("controller.u", kind, parameters), ("late.u", kind, parameters)],
        11: [("controller.u[0]", "release", ()), ("plant.u", kind, parameters)],
        17: [("late.u", "offset", (1.0,)), ("plant.u", "offset", (-0.25,))],
        23: [("plant.u", "release", ())],
    }
    for first, last in ((0, 3), (3, 11), (11, 17), (17, 23), (23, 40)):
        for to, cause, values in schedule.get(first, ()):
            if cause == "release":
                simulation.release(to)
            else:
                simulation.inject(to, cause, values)
        while simulation.index < last:
            step = simulation.step(min(size, last - simulation.index))
            rows.append(np.hstack([step[name] for name in step]))
    return np.concatenate(rows)


@pytest.mark.parametrize(("kind", "parameters"), FAULTS, ids=ids)
@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
def test_faults_have_the_same_bits_in_compiled_code_and_in_python(kind, parameters, coupling):
    """In loops and cascades, whatever the steps between them."""
    results = []
    for native, size in ((True, 1), (True, 7), (False, 1), (False, 40)):
        simulation = Simulation(loop(native=native, coupling=coupling), clock())
        results.append(follow(simulation, kind, parameters, size).tobytes())
    assert len(set(results)) == 1


@pytest.mark.parametrize(("kind", "parameters"), FAULTS, ids=ids)
def test_faults_are_recorded_and_repeated(kind, parameters):
    """Events carry the parameters: the same rows and the same events come of them alone."""
    memory = Memory()
    graph = loop()
    with memory:
        plan = graph.prepare(clock().step_ns)
        memory.begin(plan)
        simulation = Simulation(graph, clock(), plan, recorder=memory)
        follow(simulation, kind, parameters, 9)
        simulation.close()
    own = [event for event in memory.events() if event.cause != "follow"]
    assert own[0].cause == kind
    assert own[0].parameters == tuple(map(float, parameters))
    assert own[-1][1:3] == ("release", "plant.u")
    again = Memory()
    repeat(loop(), clock(), again, changes=RecordedChanges(memory.events()))
    assert again.events() == memory.events()
    for name in memory.signals:
        assert again[name].tobytes() == memory[name].tobytes()


@pytest.mark.parametrize(("kind", "parameters"), FAULTS, ids=ids)
@pytest.mark.parametrize("is_pickled", [False, True])
def test_a_state_has_its_faults(kind, parameters, is_pickled):
    """Going back gives the same rows again, also after the fault was released."""
    components = {"s": sine(rate=1.0, offset=1.0), "x": integrator()}
    simulation = Simulation(Graph(components, {"x.u": "s.y"}), clock())
    simulation.step(BEGIN)
    simulation.inject("x.u", kind, parameters)
    simulation.step(7)
    state = simulation.state
    if is_pickled:
        state = pickle.loads(pickle.dumps(state))
    first = simulation.step(9)["x.u"].tobytes()
    simulation.release("x.u")
    simulation.step(2)
    for _ in range(2):
        simulation.state = state
        assert simulation.step(9)["x.u"].tobytes() == first


def test_an_override_takes_the_place_of_a_fault_and_a_fault_that_of_an_override():
    """One at a time: what came last."""
    simulation = Simulation(driven(), clock())
    simulation.inject("g.u", "drift", (1.0,))
    simulation.step(2)
    simulation["g.u"] = 3.0
    assert simulation.overrides == {"g.u": 3.0}
    assert (simulation.step(2)["g.u"] == 3.0).all()
    simulation.inject("g.u", "offset", (1.0,))
    assert simulation.overrides == {}
    rows = simulation.step(2)
    assert (rows["g.u"] == rows["s.y"] + 1.0).all()
    simulation.release("g.u")
    rows = simulation.step(2)
    assert (rows["g.u"] == rows["s.y"]).all()


def test_elements_have_faults_of_their_own():
    """Changed at one instant, each has its event; alike, they have one together."""
    components = {"a": sine(rate=3.0), "x": gain(np.eye(2))}
    memory = Memory()
    graph = Graph(components, {"x.u": ["a.y", "a.y"]})
    with memory:
        plan = graph.prepare(clock().step_ns)
        memory.begin(plan)
        simulation = Simulation(graph, clock(), plan, recorder=memory)
        simulation.inject("x.u[0]", "offset", (1.0,))
        simulation.inject("x.u[1]", "freeze")
        simulation.step()
        simulation.inject("x.u[1]", "offset", (2.0,))
        simulation.inject("x.u[0]", "offset", (3.0,))
        simulation.step()
        simulation.inject("x.u", "noise", (0.1, 3, 0.2, 3))
        simulation.close()
    own = [event for event in memory.events() if event.cause != "follow"]
    found = [(event.cause, event.signal, event.parameters) for event in own]
    assert found == [
        ("offset", "x.u[0]", (1.0,)),
        ("freeze", "x.u[1]", ()),
        ("offset", "x.u", (3.0, 2.0)),
        ("noise", "x.u", (0.1, 3.0, 0.2, 3.0)),
    ]


@pytest.mark.parametrize("native", [True, False])
def test_a_fault_that_leaves_the_range_of_numbers_is_named(native):
    """With the input, as any value that is not finite."""
    components = {"s": constant([1e300]), "x": integrator()}
    simulation = Simulation(Graph(components, {"x.u": "s.y"}, native=native), clock())
    simulation.step(3)
    simulation.inject("x.u", "gain", (1e10,))
    with pytest.raises(NonFiniteError, match=r"'x.u' became inf at t = 0.4 s"):
        simulation.step(5)


@pytest.mark.parametrize(
    ("kind", "parameters", "text"),
    [
        ("bias", (1.0,), "there is no fault 'bias'; .*freeze"),
        ("offset", (), r"offset:.*each of 1 elements: offset.*0 parameters"),
        ("noise", (0.1,), r"noise:.*each of 1 elements: deviation.*1 parameters"),
        ("offset", (math.nan,), r"offset: offset:.*a finite number.*nan"),
        ("noise", (-0.1, 1), r"noise:.*deviation.*0.*-0\.1"),
        ("drop", (1.5, 0), r"drop:.*a probability.*0.*1.*1\.5"),
        ("drop", (0.5, -1), r"drop: seed:.*0.*-1"),
        ("delay", (0,), r"delay: steps:.*1.*0"),
        ("delay", (1.5,), r"delay: steps:.*1.*1\.5"),
    ],
)
def test_a_fault_that_does_not_fit_is_refused(kind, parameters, text):
    """By what it needs."""
    with pytest.raises(GraphError, match=text):
        Simulation(driven(), clock()).inject("g.u", kind, parameters)


@pytest.mark.parametrize(
    ("signal_type", "kind", "parameters", "text"),
    [
        ("boolean", "offset", (1.0,), r"offset: 'u' is Boolean.*override, freeze, drop or"),
        ("integer", "gain", (0.5,), r"gain: 'u' is an integer.*an integer offset or gain"),
        ("integer", "noise", (0.5, 1), r"noise: 'u' is an integer.*an integer offset or gain"),
        ("integer", "drift", (1.0,), "drift: 'u' is an integer"),
        ("integer", "offset", (2.0,), ""),
        ("boolean", "delay", (2.0,), ""),
    ],
)
def test_values_stay_what_their_type_has(signal_type, kind, parameters, text):
    """No Boolean of 1.5."""
    signal = Signal("u", type=signal_type, connection="optional")
    sink = Scripted(np.zeros(50))
    sink.interface = Interface((signal,), (Signal("y"),))
    simulation = Simulation(Graph({"c": sink}, {}), clock())
    if not text:
        simulation.inject("c.u", kind, parameters)
        return
    with pytest.raises(GraphError, match=text):
        simulation.inject("c.u", kind, parameters)


def test_an_event_of_a_fault_without_its_parameters_is_refused():
    """A log that was damaged."""
    event = SignalEvent(0, "offset", "g.u", (1.0,))
    with pytest.raises(LogError, match=r"does not fit: offset:.*offset.*0 parameters"):
        repeat(driven(), clock(), Memory(), changes=RecordedChanges([event]))
