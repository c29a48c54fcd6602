"""A graph advanced by hand: the bits of a run, overrides and what follows them, states."""

import pickle
import threading

import numpy as np
import pytest

from cosim.blocks.arithmetic import gain, sum_of
from cosim.blocks.dynamics import Delay
from cosim.blocks.source import Noise, Table, ramp, sine
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.recording import SignalEvent
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.stepping.repeating import RecordedChanges, repeat
from cosim.core.stepping.row_filler import POINTS
from cosim.errors import (
    ClockError,
    GraphError,
    LogError,
    NonFiniteError,
    UnknownSignalError,
    UsageError,
)
from tests.core.parts import Scripted, half_through, integrator, through, times

STEP = 0.1


def clock(steps=40):
    return Clock(steps * STEP, STEP)


def mixed(**options):
    """Return sources, a cascade with feedthrough, a loop, a delay, and a component in Python."""
    components = {
        "u": sine(amplitude=1.0, rate=1.0),
        "noise": Noise(deviation=0.1, seed=3),
        "sum": sum_of([1.0, -1.0]),
        "plant": half_through(),
        "controller": through(),
        "late": Delay(3),
        "script": Scripted(np.sqrt(np.arange(50)), inputs=1),
        "table": Table(np.array([0.0, 1.0, 9.0]), np.array([[1.0], [3.0], [2.0]])),
    }
    connections = {
        "sum.u1": "u.y",
        "sum.u2": "noise.y",
        "controller.u": Connection("plant.v", gain=-0.5),
        "plant.u": "controller.y",
        "late.u": "plant.y",
        "script.u0": "late.y",
    }
    return Graph(components, connections, **options)


def driven_lag():
    return Graph({"u": sine(rate=1.0), "x": integrator()}, {"x.u": "u.y"})


def call_often(function, times, *arguments):
    for _ in range(times):
        function(*arguments)


def recorded(graph, steps=40):
    memory = Memory()
    run(graph, clock(steps), memory)
    return memory


def chain(**options):
    """Return a source, two gains and an integrator: the gains follow at once."""
    components = {
        "u": sine(amplitude=1.0, rate=1.0),
        "first": times(2.0),
        "second": times(3.0),
        "x": integrator(),
    }
    connections = {"first.u": "u.y", "second.u": "first.y", "x.u": "second.y"}
    return Graph(components, connections, **options)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("size", [1, 7, 40])
def test_steps_by_hand_give_the_bits_of_a_run(size, native):
    """Whatever the size of the steps, and with stages in compiled code or not."""
    memory = recorded(mixed())
    simulation = Simulation(mixed(native=native), clock())
    rows = {name: [simulation[name][np.newaxis]] for name in memory}
    while simulation.steps_left:
        step = simulation.step(min(size, simulation.steps_left))
        for name in memory:
            rows[name].append(step[name])
    for name, parts in rows.items():
        whole = np.concatenate(parts)
        assert whole.tobytes() == np.ascontiguousarray(memory[name]).tobytes(), name


def test_the_rows_of_a_step_are_yours_to_keep():
    """Later steps and overrides change nothing in them, and nobody else does."""
    simulation = Simulation(chain(), clock())
    rows = simulation.step(5)
    assert rows["x.y"].shape == (5, 1)
    assert rows.time_ns.tolist() == [10**8 * k for k in range(1, 6)]
    assert set(rows) == {"u.y", "first.u", "first.y", "second.u", "second.y", "x.u", "x.y"}
    assert (len(rows), rows.steps) == (7, 5)
    before = {name: values.copy() for name, values in rows.items()}
    simulation["first.u"] = 7.0
    simulation["second.y"]
    simulation.step(5)
    for name, values in rows.items():
        assert values.tobytes() == before[name].tobytes()
    with pytest.raises(ValueError, match="read-only"):
        rows["x.y"][0] = 1.0


def test_elements_are_read_by_their_numbers():
    """Of the rows, and of the time reached."""
    vector = {"v": gain(np.array([[1.0], [2.0]])), "u": sine(rate=1.0, offset=1.0)}
    simulation = Simulation(Graph(vector, {"v.u": "u.y"}), clock())
    rows = simulation.step(2)
    assert rows["v.y"].shape == (2, 2)
    assert rows["v.y[1]"].tolist() == rows["v.y"][:, 1:].tolist()
    assert simulation["v.y[1]"].tolist() == rows["v.y"][-1, 1:].tolist()
    for signals in (rows, simulation):
        with pytest.raises(UnknownSignalError, match=r"the simulation has no 'v\.z':.*u, y"):
            signals["v.z"]
        with pytest.raises(UnknownSignalError, match=r"'v.y' has 2 elements, numbered from 0"):
            signals["v.y[2]"]
    assert "v.z" not in rows


def test_a_simulation_goes_up_to_an_instant():
    """It is a communication point from the time reached up to the stop."""
    simulation = Simulation(chain(), clock())
    assert simulation.run_until(0.5)["x.y"].shape == (5, 1)
    assert (simulation.t_ns, simulation.t, simulation.index) == (5 * 10**8, 0.5, 5)
    assert simulation.run_until(0.5)["x.y"].shape == (0, 1)
    with pytest.raises(ClockError, match=r"run_until: 0.55 s is not a whole number of 0.1 s steps"):
        simulation.run_until(0.55)
    with pytest.raises(UsageError, match=r"time.*0\.5 s.*0\.4 s"):
        simulation.run_until(0.4)
    with pytest.raises(UsageError, match=r"at most 35 communication steps.* got 4\.1 s"):
        simulation.run_until(4.1)
    assert simulation.index == 5


def test_a_step_beyond_the_end_is_refused():
    """What is left is said; at the end there is nothing."""
    simulation = Simulation(chain(), clock())
    simulation.step(38)
    with pytest.raises(
        UsageError,
        match=r"step:.*at most 2 communication steps, from t = 3\.8 s to the stop at 4\.0 s",
    ):
        simulation.step(3)
    simulation.step(2)
    with pytest.raises(UsageError, match=r"the simulation is at its stop, t = 4.0 s; call reset"):
        simulation.step()


@pytest.mark.parametrize("count", [0, -1, 1.0, True, "2", np.int64(0), np.float64(1.0), np.True_])
def test_a_number_of_steps_is_a_positive_integer(count):
    with pytest.raises(UsageError, match=r"step:.*1.*steps"):
        Simulation(chain(), clock()).step(count)


def test_a_number_of_steps_may_be_one_of_numpy():
    """As it comes of a computation with arrays."""
    assert Simulation(chain(), clock()).step(np.int64(3)).steps == 3


@pytest.mark.parametrize("size", [1, 10])
def test_a_stop_of_the_graph_ends_the_simulation(size):
    """The steps before it were taken; further ones are refused with the reason."""
    values = [*range(5), np.inf, *range(6, 20)]
    simulation = Simulation(Graph({"x": Scripted(values)}, {}), clock())
    with pytest.raises(NonFiniteError, match=r"'x.y' became inf at t = 0.5 s"):
        call_often(simulation.step, 10 // size, size)
    assert simulation.t_ns == 4 * 10**8
    assert simulation["x.y"].tolist() == [4.0]
    with pytest.raises(UsageError, match=r"ended at t = 0.4 s: 'x.y' became inf at t = 0.5 s"):
        simulation.step()
    with pytest.raises(UsageError, match=r"state: the simulation ended at t = 0.4 s"):
        _ = simulation.state
    simulation.reset()
    assert simulation.step(4)["x.y"][:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_regular_end_is_raised_too():
    """As of every simulation by blocks; the step that was completed counts."""
    stop = Stopped(np.array([[7.0]]), "enough", failed=False)
    simulation = Simulation(Graph({"x": Scripted([0, 1, stop, 3])}, {}), clock())
    with pytest.raises(Stopped, match=r"'x' stopped at t = 0.2 s: enough") as caught:
        simulation.step(3)
    assert not caught.value.failed
    assert simulation["x.y"].tolist() == [7.0]
    assert simulation.rows["x.y"][:, 0].tolist() == [1.0, 7.0]
    assert simulation.rows.time_ns.tolist() == [10**8, 2 * 10**8]


def test_an_interrupt_inside_a_step_ends_the_simulation():
    """Some components are ahead of others then; a reset begins again."""
    graph = Graph({"x": Scripted([0.0] * 9, inputs=1)}, {"x.u0": "x.y"})
    graph.components["x"].advance = interrupted
    simulation = Simulation(graph, clock())
    with pytest.raises(KeyboardInterrupt):
        simulation.step(3)
    with pytest.raises(UsageError, match=r"ended at t = 0.0 s: it was interrupted inside a step"):
        simulation.step()
    with pytest.raises(UsageError, match=r"override: the simulation ended at t = 0.0 s"):
        simulation["x.u0"] = 1.0
    simulation.reset()
    assert simulation.steps_left == 40


def interrupted(t, h, u):
    raise KeyboardInterrupt


# --- overrides ---


def test_an_override_holds_until_it_is_changed_or_released():
    """The input keeps its value; a lag follows it exactly, x + (u - x)(1 - exp(-h))."""
    simulation = Simulation(driven_lag(), clock())
    simulation.step(3)
    x = simulation["x.y"][0]
    decay = np.exp(-STEP)
    for value in (0.3, -2.0):
        simulation["x.u"] = value
        assert simulation["x.u"].tolist() == [value]
        rows = simulation.step(4)
        assert (rows["x.u"] == value).all()
        for k in range(4):
            x = value + (x - value) * decay
            assert rows["x.y"][k, 0] == pytest.approx(x, abs=1e-15 * 8)
    simulation.release("x.u")
    assert simulation["x.u"] == simulation["u.y"]
    rows = simulation.step(2)
    assert (rows["x.u"] == rows["u.y"]).all()


def test_direct_feedthrough_follows_an_override_at_once():
    """The row that was returned keeps the values before the jump."""
    simulation = Simulation(chain(), clock())
    rows = simulation.step(3)
    x = simulation["x.y"]
    simulation["first.u"] = 5.0
    assert simulation["second.u"].tolist() == [10.0]
    assert simulation["x.u"].tolist() == [30.0]
    assert simulation["x.y"] == x
    assert rows["x.u"][-1] != 30.0
    simulation.release("first.u")
    assert simulation["x.u"] == rows["x.u"][-1]
    simulation["first.u"] = 5.0
    simulation["second.u"] = 1.0
    assert simulation["x.u"].tolist() == [3.0]
    simulation.release("second.u")
    assert simulation["x.u"].tolist() == [30.0]


def test_a_step_after_an_override_starts_from_the_right_limit():
    """The step starts from the right limit: with the left one, the input would be a ramp."""
    driven = {"u": Table(np.array([0.0, 9.0]), np.array([[2.0], [2.0]])), "x": integrator()}
    reference = recorded(Graph(driven, {"x.u": "u.y"}), 5)
    simulation = Simulation(driven_lag(), clock())
    simulation["x.u"] = 2.0
    assert simulation.step(5)["x.y"][:, 0].tolist() == reference["x.y"][1:].tolist()


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_overrides_have_the_same_bits_in_compiled_code_and_in_python(coupling):
    """In loops and cascades, whatever the steps between them."""
    results = []
    for native, size in ((True, 1), (True, 5), (False, 5)):
        simulation = Simulation(mixed(native=native, coupling=coupling), clock())
        rows = []
        for value in (0.3, None, -1.0, 2.0):
            for to in ("plant.u", "late.u", "sum.u1"):
                if value is not None:
                    simulation[to] = [value] * len(simulation[to])
                elif to != "late.u":
                    simulation.release(to)
            rows.append(np.concatenate([simulation[name] for name in simulation.step(1)])[None])
            for _ in range(10 // size - 1):
                step = simulation.step(size)
                rows.append(np.hstack([step[name] for name in step]))
            while simulation.index % 10:
                step = simulation.step(1)
                rows.append(np.hstack([step[name] for name in step]))
        results.append(np.concatenate([part.reshape(-1, rows[0].shape[1]) for part in rows]))
    assert results[0].tobytes() == results[1].tobytes() == results[2].tobytes()


def test_elements_are_overridden_on_their_own():
    """The others stay connected."""
    components = {"u": sine(rate=1.0, offset=1.0), "v": gain(np.eye(2))}
    simulation = Simulation(Graph(components, {"v.u": ["u.y", "u.y"]}), clock())
    simulation["v.u[1]"] = 4.0
    rows = simulation.step(3)
    assert rows["v.u"][:, 1].tolist() == [4.0] * 3
    assert rows["v.u"][:, 0].tolist() == rows["u.y"][:, 0].tolist()
    assert simulation.overrides == {"v.u[1]": 4.0}
    simulation["v.u"] = [1.0, 2.0]
    simulation.release("v.u[1]")
    assert simulation.overrides == {"v.u[0]": 1.0}
    assert simulation.step()["v.u"][0, 1] == simulation["u.y"][0]


def test_an_input_that_nothing_drives_is_overridden_too():
    """Released, it has its start value again."""
    free = Interface(
        (Signal("u", start=(1.5,), connection="optional"),), (Signal("y"),), {"y": ("u",)}
    )

    class Echo:
        interface = free

        def initialize(self, t, u):
            return u.copy()

        def outputs(self, t, u):
            return u.copy()

        def advance(self, t, h, u):
            return u[1:].copy()

    simulation = Simulation(Graph({"x": Echo()}, {}), clock())
    simulation["x.u"] = 2
    assert simulation["x.y"].tolist() == [2.0]
    assert simulation.step(2)["x.y"][:, 0].tolist() == [2.0, 2.0]
    simulation.release("x.u")
    assert simulation.step()["x.y"].tolist() == [[1.5]]


class Vague:
    """y = factor u + bias, without saying whether it feeds through."""

    interface = Interface((Signal("u"),), (Signal("y"),), {"y": None})

    def __init__(self, factor, bias=0.0):
        self.factor = factor
        self.bias = bias

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return self.factor * u + self.bias

    def advance(self, t, h, u):
        return self.factor * u[1:] + self.bias


def test_unknown_feedthrough_around_a_cycle_is_evaluated_until_nothing_changes():
    """In truth one output depends on nothing here, so that three rounds are enough."""
    graph = Graph({"a": Vague(2.0), "b": Vague(0.0, 1.0)}, {"a.u": "b.y", "b.u": "a.y"})
    simulation = Simulation(graph, clock())
    simulation["a.u"] = 4.0
    assert simulation["b.u"].tolist() == [8.0]
    simulation.release("a.u")
    assert simulation["a.y"].tolist() == [2.0]


@pytest.mark.parametrize("values", [[4.0], [4.0, -1.0]])
def test_an_override_that_is_released_at_once_changes_nothing(values):
    """What follows is not evaluated: around a cycle it would be other values than in the step."""

    def simulation():
        components = {"s": sine(rate=3.0), "a": Vague(0.5), "b": Vague(0.5)}
        driving = Connection(("s.y", "b.y"), [[1.0, 1.0]])
        return Simulation(Graph(components, {"a.u": driving, "b.u": "a.y"}), clock())

    expected = simulation()
    expected.step(5)
    found = simulation()
    found.step(5)
    for value in values:
        found["a.u"] = value
    found.release("a.u")
    for name in ("a.u", "a.y", "b.y"):
        assert found[name].tolist() == expected[name].tolist()
    assert taken(found, 3) == taken(expected, 3)


def test_a_value_that_is_not_finite_after_an_override_is_named():
    """The simulation ends there."""
    graph = Graph({"u": sine(rate=1.0), "big": times(1e200)}, {"big.u": "u.y"})
    simulation = Simulation(graph, clock())
    simulation["big.u"] = 1e200
    with pytest.raises(NonFiniteError, match=r"'big.y' became inf at t = 0.0 s"):
        simulation.step()
    with pytest.raises(UsageError, match=r"ended at t = 0.0 s: 'big.y' became inf"):
        simulation.step()


@pytest.mark.parametrize(
    ("to", "value", "text"),
    [
        ("plant.z", 1.0, r"'plant.z': there is no component 'plant'; did you mean|there is"),
        ("v.z", 1.0, r"'v.z': 'v' has no input 'z'; .*u"),
        ("v.y", 1.0, r"'v\.y':.*an input of 'v'.*an output.*u"),
        ("v.u[2]", 1.0, r"'v.u' has 2 elements, numbered from 0"),
        ("v", 1.0, r"port COMPONENT\.SIGNAL.*'v'"),
        (3, 1.0, r"port.*3"),
        ("v.u", 1.0, r"override of 'v\.u':.*2 values, one.*element.*1 values"),
        ("v.u", [1.0, 2.0, 3.0], r"2 values.*3 values"),
        ("v.u", [[1.0, 2.0]], r"2.*shape \(1, 2\)"),
        ("v.u[0]", "0.3", r"override of 'v\.u\[0\]':.*'0\.3'"),
        ("v.u[0]", None, "None"),
        ("v.u[0]", 1j, r"expected numbers"),
        ("v.u", [[1.0], [1.0, 2.0]], r"expected numbers"),
        ("v.u[0]", np.nan, r"override of 'v\.u\[0\]':.*a finite number.*nan"),
        ("v.u", [0.0, np.inf], r"a finite number.*inf"),
        (
            "v.u[0]",
            True,
            r"override of 'v\.u\[0\]':.*true or false.*is not Boolean\)",
        ),
        ("v.u", [1.0, False], r"true or false.*is not Boolean\)"),
        ("v.u", np.array([True, True]), r"true or false.*is not Boolean\)"),
    ],
)
def test_an_override_that_does_not_fit_is_refused(to, value, text):
    """Nothing has changed then."""
    components = {"u": sine(rate=1.0), "v": gain(np.eye(2))}
    simulation = Simulation(Graph(components, {"v.u": ["u.y", "u.y"]}), clock())
    with pytest.raises(GraphError, match=text):
        simulation[to] = value
    assert simulation.overrides == {}
    assert simulation["v.u"].tolist() == [0.0, 0.0]


def test_whole_numbers_stay_whole():
    """Of integer and Boolean inputs; NaN only where it means that there is no value."""

    class Typed(Scripted):
        def __init__(self):
            super().__init__([0.0] * 9)
            inputs = (
                Signal("n", type="integer"),
                Signal("b", type="boolean"),
                Signal("o", optional=True),
            )
            self.interface = Interface(inputs, (Signal("y"),))

    sources = {"s": Typed(), "c": sine(rate=1.0)}
    graph = Graph(sources, {"s.n": "c.y", "s.b": "c.y", "s.o": "c.y"})
    simulation = Simulation(graph, clock(4))
    simulation["s.n"] = 3
    simulation["s.b"] = True
    simulation["s.o"] = np.nan
    assert np.isnan(simulation.step()["s.o"]).all()
    with pytest.raises(GraphError, match=r"'s\.n':.*an integer.*0\.5"):
        simulation["s.n"] = 0.5
    with pytest.raises(GraphError, match=r"'s\.n':.*exactly, got 9007199254740993"):
        simulation["s.n"] = 2**53 + 1  # as a float 2**53
    simulation["s.n"] = -(2**63)
    with pytest.raises(GraphError, match=r"'s.b': .*0 or 1 .*, got 2\.0"):
        simulation["s.b"] = 2


def test_only_what_is_overridden_is_released():
    simulation = Simulation(chain(), clock())
    with pytest.raises(GraphError, match=r"release: 'x.u' is not overridden.*: nothing is"):
        simulation.release("x.u")
    simulation["first.u"] = 1.0
    with pytest.raises(GraphError, match=r"overridden: first.u"):
        simulation.release("x.u")


# --- events ---


class Kept(Memory):
    """Keeps the events too."""

    def __init__(self):
        super().__init__()
        self.events = []

    def event(self, event):
        self.events.append(event)


def two_inputs():
    components = {"a": sine(rate=3.0), "x": gain(np.eye(2)), "y": Delay(2, size=2)}
    return Graph(components, {"x.u": ["a.y", "a.y"], "y.u": "x.y"})


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([("x.u[0]", 2.0), ("x.u[0]", None)], []),
        ([("x.u", [2.0, 3.0]), ("x.u", None)], []),
        ([("x.u[0]", 2.0), ("x.u", [2.0, 3.0]), ("x.u", None)], []),
        ([("x.u", [2.0, 3.0]), ("x.u[0]", None)], [("override", "x.u[1]")]),
        ([("x.u[1]", 2.0), ("x.u[0]", 3.0)], [("override", "x.u")]),
        ([("x.u", [2.0, 3.0]), ("x.u", [2.0, 4.0])], [("override", "x.u")]),
        ([("y.u", None)], [("release", "y.u")]),
        ([("y.u[1]", None)], [("release", "y.u[1]")]),
        ([("y.u[1]", None), ("y.u[0]", None)], [("release", "y.u")]),
        ([("y.u[1]", None), ("y.u[1]", 7.0)], [("override", "y.u[1]")]),
        ([("y.u[1]", None), ("y.u", [7.0, 7.0])], [("override", "y.u")]),
        ([("y.u[1]", None), ("y.u", [5.0, 7.0])], [("override", "y.u[1]")]),
        ([("y.u[1]", 4.0), ("y.u", None)], [("release", "y.u")]),
    ],
)
def test_events_are_what_overrides_at_one_point_come_to(changes, expected):
    """A release of what was overridden there only is none; repeated, they give the same again."""
    memory = Kept()
    graph = two_inputs()
    with memory:
        plan = graph.prepare(clock().step_ns)
        memory.begin(plan)
        simulation = Simulation(graph, clock(8), plan, recorder=memory)
        simulation.step(2)
        simulation["y.u"] = [5.0, 6.0]
        simulation.step(2)
        memory.events.clear()
        for to, value in changes:
            if value is None:
                simulation.release(to)
            else:
                simulation[to] = value
        simulation.step(4)
    own = [(e.cause, e.signal) for e in memory.events if e.cause != "follow"]
    assert own == expected
    first = SignalEvent(2 * 10**8, "override", "y.u", (5.0, 6.0))
    again = Kept()
    repeat(two_inputs(), clock(8), again, changes=RecordedChanges([first, *memory.events]))
    assert again.events == [first, *memory.events]
    for name in again.signals:
        assert again[name].tobytes() == memory[name].tobytes()


def test_events_are_repeated_in_the_order_of_time():
    """Each at its communication point; others are refused."""
    events = [SignalEvent(3 * 10**8, "override", "x.u", (2.0,))]
    memory = Memory()
    repeat(driven_lag(), clock(), memory, changes=RecordedChanges(events))
    simulation = Simulation(driven_lag(), clock())
    simulation.step(3)
    simulation["x.u"] = 2.0
    assert memory["x.y"][4:].tolist() == simulation.step(37)["x.y"][:, 0].tolist()
    assert memory.events() == events
    earlier = [*events, SignalEvent(2 * 10**8, "release", "x.u", (0.0,))]
    with pytest.raises(LogError, match=r"event at t = 0\.2 s.*after a later one"):
        repeat(driven_lag(), clock(), Memory(), changes=RecordedChanges(earlier))
    between = [SignalEvent(10**8 + 1, "override", "x.u", (2.0,))]
    with pytest.raises(LogError, match=r"t = 0.100000001 s is not at a communication point"):
        repeat(driven_lag(), clock(), Memory(), changes=RecordedChanges(between))


def test_a_recorded_row_keeps_the_left_limits_of_a_jump():
    """Also in the memory of the recorder, where the next step starts from the right ones."""
    memory = Memory()
    events = [SignalEvent(3 * 10**8, "override", "first.u", (2.0,))]
    repeat(chain(), clock(), memory, changes=RecordedChanges(events))
    undisturbed = recorded(chain())
    for name in memory:
        assert memory[name][:4].tobytes() == undisturbed[name][:4].tobytes(), name
    assert memory["x.u"][4:].tolist() == [12.0] * 37
    x = memory["x.y"]
    assert x[4] == pytest.approx(12.0 + (x[3] - 12.0) * np.exp(-STEP), abs=12.0 * 8 * 2**-53)


@pytest.mark.parametrize("is_recorded", [True, False])
def test_jumps_of_a_recorded_component_are_taken_from_its_events(is_recorded):
    """Of others it is evaluated."""
    events = [
        SignalEvent(3 * 10**8, "override", "first.u", (2.0,)),
        SignalEvent(3 * 10**8, "follow", "first.y", (5.0,)),
    ]
    memory = Memory()
    recorded = ["first"] if is_recorded else []
    repeat(chain(), clock(), memory, changes=RecordedChanges(events, copied=recorded))
    values = {event.signal: event.values for event in memory.events()}
    assert values["second.y"] == ((15.0,) if is_recorded else (12.0,))


# --- states ---


def stateful():
    """Return a graph of components that can go back: a loop, a delay, noise."""
    components = {
        "noise": Noise(deviation=0.1, seed=3),
        "plant": half_through(),
        "controller": through(),
        "late": Delay(3),
    }
    connections = {
        "controller.u": Connection("plant.v", gain=-0.5),
        "plant.u": "controller.y",
        "late.u": "noise.y",
    }
    return Graph(components, connections)


def taken(simulation, count):
    rows = simulation.step(count)
    return b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows)


@pytest.mark.parametrize("is_pickled", [False, True])
def test_a_saved_state_gives_the_same_steps_again(is_pickled):
    """Time, rows, overrides, delays and random numbers; any number of times."""
    simulation = Simulation(stateful(), clock())
    simulation.step(4)
    simulation["plant.u"] = 0.7
    saved = simulation.state
    first = taken(simulation, 6)
    simulation.release("plant.u")
    simulation["late.u"] = 2.0
    simulation.step(3)
    if is_pickled:
        saved = pickle.loads(pickle.dumps(saved))
    for _ in range(2):
        simulation.state = saved
        assert simulation.t_ns == 4 * 10**8
        assert simulation.overrides == {"plant.u": 0.7}
        assert taken(simulation, 6) == first


def test_single_steps_go_on_from_a_state_of_long_ago():
    """From before the points whose times are computed at once: y = t."""
    simulation = Simulation(Graph({"s": ramp(slope=1.0)}, {}), clock(2 * POINTS))
    saved = simulation.state
    simulation.step(POINTS + 1)
    simulation.step()
    simulation.state = saved
    for k in range(1, 4):
        assert simulation.step()["s.y"] == [[k / 10]]


def test_a_pickled_state_goes_on_in_another_simulation():
    """Of the same graph."""
    simulation = Simulation(stateful(), clock())
    simulation.step(4)
    simulation["plant.u"] = 0.7
    text = pickle.dumps(simulation.state)
    first = taken(simulation, 6)
    other = Simulation(stateful(), clock())
    other.state = pickle.loads(text)
    assert taken(other, 6) == first


def test_the_state_of_another_graph_is_refused():
    """One of another structure, of other values, or of another step."""
    saved = Simulation(stateful(), clock()).state
    others = [
        Simulation(Graph({"x": integrator()}, {"x.u": "x.y"}), clock()),
        Simulation(stateful(), Clock(4.0, 0.2)),
    ]
    for other in others:
        with pytest.raises(UsageError, match=r"state:.*state of.*graph.*one of another graph"):
            other.state = saved
    fast = Simulation(Graph({"x": integrator(2.0)}, {"x.u": "x.y"}), clock()).state
    with pytest.raises(UsageError, match=r"state: .*got one of another graph"):
        others[0].state = fast
    with pytest.raises(UsageError, match=r"state: .*SimulationState, got None"):
        others[0].state = None


def test_components_that_cannot_go_back_are_named():
    components = {"a": Scripted([0.0] * 9), "x": integrator()}
    simulation = Simulation(Graph(components, {"x.u": "a.y"}), clock(4))
    with pytest.raises(UsageError, match=r"state: a cannot go back \(rollback is not declared\)"):
        _ = simulation.state


class Held(Scripted):
    """A component whose state lies in its own memory, as that of an FMU does."""

    def __init__(self):
        super().__init__([0.0] * 9)
        self.interface = Interface((), (Signal("y"),), rollback=True)

    def save(self):
        return threading.Lock()

    def restore(self, state):
        pass


def test_a_state_that_cannot_leave_its_simulation_is_refused_elsewhere():
    """It is neither pickled nor taken by another simulation; in its own it can be set."""
    simulation = Simulation(Graph({"x": Held()}, {}), clock(4))
    saved = simulation.state
    simulation.step()
    simulation.state = saved
    text = r"state: that of 'x' cannot.*cannot"
    with pytest.raises(UsageError, match=text):
        pickle.dumps(saved)
    with pytest.raises(UsageError, match=text):
        Simulation(Graph({"x": Held()}, {}), clock(4)).state = saved


def test_a_reset_begins_again_without_overrides():
    simulation = Simulation(stateful(), clock())
    first = taken(simulation, 5)
    simulation["plant.u"] = 1.0
    simulation.step(5)
    simulation.reset()
    assert simulation.overrides == {}
    assert simulation.t_ns == 0
    assert taken(simulation, 5) == first


# --- threads ---


def in_thread(function):
    """Call a function in another thread; return what it returned or raised."""
    results = []

    def call():
        try:
            results.append(function())
        except Exception as error:
            results.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    return results[0]


def test_one_simulation_used_from_two_threads_is_an_error():
    """Whatever is asked of it."""
    simulation = Simulation(stateful(), clock())

    def override():
        simulation["plant.u"] = 1.0

    def restore():
        simulation.state = saved

    saved = simulation.state
    uses = [
        simulation.step,
        lambda: simulation.run_until(1.0),
        lambda: simulation["plant.u"],
        override,
        lambda: simulation.release("plant.u"),
        lambda: simulation.state,
        restore,
        simulation.reset,
    ]
    for use in uses:
        error = in_thread(use)
        assert isinstance(error, UsageError)
        assert "was started in another thread" in str(error)
    assert simulation.t_ns == 0


def test_simulations_in_different_threads_are_independent():
    """Side by side they have the bits that each has alone."""
    alone = taken(Simulation(mixed(), clock()), 40)
    barrier = threading.Barrier(2)
    results = []

    def work():
        simulation = Simulation(mixed(), clock())
        barrier.wait()
        parts = []
        while simulation.steps_left:
            parts.append(simulation.step())
        rows = [np.concatenate([part[name] for part in parts]) for name in parts[0]]
        results.append(b"".join(np.ascontiguousarray(values).tobytes() for values in rows))

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [alone, alone]


def test_a_simulation_of_a_graph_that_another_took_over_is_refused():
    """The components have one state each."""
    graph = stateful()
    first = Simulation(graph, clock())
    Simulation(graph, clock())
    with pytest.raises(UsageError, match="another simulation of this graph has begun"):
        first.step()
    with pytest.raises(UsageError, match="another simulation of this graph has begun"):
        first["plant.u"] = 1.0
