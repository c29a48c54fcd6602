"""What is followed through a step ends it with the left limit, where it jumps."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from cosim.blocks.dynamics import Delay
from cosim.blocks.source import Noise, Table, step
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear, LinearModel
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.recording import SignalEvent
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.errors import AlgebraicLoopError, RunError
from tests.core.graphs import RATE, derivative_filter, stand
from tests.core.parts import InPython, half_through, integrator, through, times


def recorded(graph: Graph, clock: Clock) -> Memory:
    memory = Memory()
    run(graph, clock, memory)
    return memory


def content(memory: Memory) -> tuple[object, ...]:
    """Return all rows by their bits, and the events."""
    rows = [memory.rows(name).tobytes() for name in memory.channels]
    return rows, memory.events()


@pytest.mark.parametrize("native", [True, False])
def test_a_jump_that_cancels_leaves_the_filter_at_zero(native):
    """Of y = 2 - u the derivative of y + u is 0, also where u jumps.

    With a ramp of y over the step before, d would be a (1 - (1 - e^(-a h))/(a h)) = 368 there. What
    is left are roundings of a q: a few times 2^-52 of 2000.
    """
    components = {"u": step(time=0.5), "plant": stand(), "filter": derivative_filter()}
    connections = {"plant.u": "u.y", "filter.u": "u.y", "filter.y": "plant.y"}
    graph = Graph(components, connections, native=native)
    assert graph.warnings == []
    memory = recorded(graph, Clock(1.0, 1e-3))
    assert np.abs(memory["filter.d"]).max() <= 16 * 2.0**-52 * 2.0 * RATE
    assert memory["plant.y"][499:502].tolist() == [2.0, 1.0, 1.0]
    assert memory["filter.y"][499:502].tolist() == [2.0, 1.0, 1.0]
    assert memory.events() == [SignalEvent(500_000_000, "jump", "plant.y", (2.0,))]


def test_a_lag_behind_a_jump_is_exact():
    """z' = -z + y for y = 2, from 0.5 s on 1, behind a gain; z(0) = 0."""
    components = {"u": step(time=0.5), "plant": stand(), "gain": times(3.0), "z": integrator()}
    connections = {"plant.u": "u.y", "gain.u": "plant.y", "z.u": "gain.y"}
    memory = recorded(Graph(components, connections), Clock(1.0, 0.125))
    t = memory.time("z")
    exact = 6.0 * (1.0 - np.exp(-t)) - np.where(t > 0.5, 3.0 * (1.0 - np.exp(0.5 - t)), 0.0)
    np.testing.assert_allclose(memory["z.y"], exact, rtol=1e-14, atol=1e-15)
    signals = [(event.signal, event.values) for event in memory.events()]
    assert signals == [("plant.y", (2.0,)), ("gain.y", (6.0,))]


def test_jumps_at_every_point_are_integrated_exactly():
    """The integral of y = 2 - u, u a table of seven values that hold for 1/8 s each."""
    u = np.array([3.0, -1.0, 0.5, 4.0, 0.25, -2.0, 1.0, 1.0])
    t = 0.125 * np.arange(8)
    table = Table(t, u[:, np.newaxis], hold=True, extrapolate=True)
    integral = Linear(controller(A=np.zeros((1, 1)), B=np.eye(1), C=np.eye(1), D=np.zeros((1, 1))))
    components = {"u": table, "plant": stand(), "integral": integral}
    connections = {"plant.u": "u.y", "integral.u": "plant.y"}
    memory = recorded(Graph(components, connections), Clock(0.875, 0.125))
    expected = 0.125 * np.cumsum(2.0 - u[:-1])  # short binary fractions: no rounding
    assert memory["integral.y"][1:].tolist() == expected.tolist()
    left = [event.values[0] for event in memory.events()]
    assert left == [2.0 - before for before, after in pairwise(u) if before != after]


def monolithic(t: np.ndarray, coupling: float) -> np.ndarray:
    """Return z of x' = -x + w, y = x - u, z' = y - z, w = coupling z, u a step at 0.5 s."""
    A = np.array([[-1.0, coupling, 0.0], [1.0, -1.0, -1.0], [0.0, 0.0, 0.0]])  # x, z, u
    values = []
    for time in t.tolist():
        state = expm(A * min(time, 0.5)) @ np.array([1.0, 0.0, 0.0])
        if time > 0.5:
            state[2] = 1.0
            state = expm(A * (time - 0.5)) @ state
        values.append(state[1])
    return np.array(values)


def loop(names: tuple[str, str], native: bool = True) -> Graph:
    """Return that loop, of a plant whose output jumps and an integrator whose output does not."""
    plant, lag = names
    interface = Interface(
        (Signal("u"), Signal("w")), (Signal("x"), Signal("y")), {"x": (), "y": ("u",)}
    )
    C = np.ones((2, 1))
    D = np.array([[0.0, 0.0], [-1.0, 0.0]])
    B = np.array([[0.0, 1.0]])
    A = -np.eye(1)
    parts = {
        plant: Linear(LinearModel(interface, ("x",), A, B, C, D, np.ones(1), np.zeros((1, 2)))),
        lag: integrator(),
        "step": step(time=0.5),
    }
    connections = {
        f"{plant}.u": "step.y",
        f"{lag}.u": f"{plant}.y",
        f"{plant}.w": Connection([f"{lag}.y"], -0.5),
    }
    return Graph(parts, connections, coupling="newton", native=native)


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_a_loop_is_solved_for_what_does_not_jump(names):
    """Whatever the names: halving the step quarters the error."""
    assert loop(names).warnings == []
    errors = []
    for h in (0.05, 0.025):
        memory = recorded(loop(names), Clock(1.0, h))
        reference = monolithic(memory.time(names[1]), -0.5)
        errors.append(np.abs(memory[f"{names[1]}.y"] - reference).max())
    assert 3.5 < errors[0] / errors[1] < 4.5


def test_a_loop_in_which_all_outputs_jump_warns_of_first_order():
    """x1' = -x1 - 0.5 y2, y1 = x1 - u, x2' = -x2 + y1, y2 = x2 + u, with u a step at 0.5 s."""

    def part(feedthrough: float, start: float) -> Linear:
        B = np.array([[0.0, 1.0]])
        D = np.array([[feedthrough, 0.0]])
        return Linear(controller(A=-np.eye(1), B=B, C=np.eye(1), D=D, x0=np.array([start])))

    components = {"a": part(-1.0, 1.0), "b": part(1.0, 0.0), "step": step(time=0.5)}
    connections = {
        "a.u[0]": "step.y",
        "a.u[1]": Connection(["b.y"], -0.5),
        "b.u[0]": "step.y",
        "b.u[1]": "a.y",
    }
    A = np.array([[-1.0, -0.5], [1.0, -1.0]])
    rest = -np.linalg.solve(A, [-0.5, -1.0])  # with u = 1
    before = expm(0.5 * A) @ [1.0, 0.0]
    exact = rest + expm(0.5 * A) @ (before - rest)
    errors = []
    for h in (0.05, 0.025):
        graph = Graph(components, connections, coupling="newton")
        memory = recorded(graph, Clock(1.0, h))
        errors.append(abs(memory["a.x"][-1] - exact[0]))
    ((name, text),) = graph.warnings
    assert f"{name}.y jumps with step.y, which feeds through, and drives " in text
    assert "which its loop is solved for: there the jump becomes a ramp" in text
    assert 1.5 < errors[0] / errors[1] < 3.0


def random_graph(seed: int, coupling: str, *, native: bool, python_parts: bool) -> Graph:
    """Return systems with feedthrough behind sources that jump, in cascades and loops."""
    draw = random.Random(seed)
    count = draw.randint(2, 6)
    components = {
        "s0": step(time=0.3),
        "s1": Table(
            np.array([0.0, 0.2, 0.5]), np.array([[1.0], [-1.0], [2.0]]), hold=True, extrapolate=True
        ),
        "s2": Noise(deviation=0.3, seed=seed),
    }
    for i in range(count):
        part = draw.choice([integrator, through, half_through, lambda: times(0.4)])()
        in_python = draw.random() < 0.4 and part.interface.prepares
        components[f"x{i}"] = InPython(part) if in_python and python_parts else part
    connections = {}
    for i in range(count):
        sources = []
        for _ in range(draw.randint(1, 2)):
            name = draw.choice([f"s{draw.randrange(3)}", f"x{draw.randrange(count)}"])
            outputs = components[name].interface.outputs
            sources.append(f"{name}.{draw.choice(outputs).name}")
        gains = [[draw.choice([-0.5, 0.25, 1.0]) for _ in sources]]
        connections[f"x{i}.u"] = Connection(sources, gains if len(sources) > 1 else gains[0][0])
    return Graph(components, connections, coupling=coupling, native=native)


@pytest.mark.slow
@settings(max_examples=20)
@given(st.integers(0, 2**32), st.sampled_from(["gauss-seidel", "jacobi", "newton"]), st.booleans())
def test_bits_and_events_depend_on_nothing_but_the_graph(seed, coupling, python_parts):
    """Compiled or not, in blocks of any length, and step by step."""
    try:
        random_graph(seed, coupling, native=False, python_parts=False)
    except AlgebraicLoopError:
        return
    contents = []
    for native, block in ((True, None), (False, None), (True, 1), (True, 7), (False, 3)):
        graph = random_graph(seed, coupling, native=native, python_parts=python_parts and native)
        try:
            contents.append(content(recorded(graph, Clock(0.7, 0.1, block=block))))
        except RunError as error:
            contents.append((str(error), []))
    assert contents[1:] == contents[:-1]
    graph = random_graph(seed, coupling, native=True, python_parts=False)
    memory = Memory()
    with memory:
        plan = graph.prepare(100_000_000)
        memory.begin(plan)
        simulation = Simulation(graph, Clock(0.7, 0.1), plan, recorder=memory)
        try:
            for _ in range(7):
                simulation.step()
        except RunError:
            return
    assert content(memory) == contents[0]


class Sawtooth:
    """y = t - floor(t/0.5) 0.5, which jumps by itself."""

    def __init__(self, limits=None):
        self.interface = Interface(outputs=(Signal("y"),), left_limits=("y",), rollback=True)
        self._limits = limits

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([t % 0.5])

    def advance(self, t, h, u):
        return (t[1:] % 0.5)[:, np.newaxis]

    def left_limits(self, t):
        if self._limits is not None:
            return self._limits
        return {place: np.array([0.5]) for place in np.flatnonzero(t % 0.5 == 0.0).tolist()}

    def save(self):
        return None

    def restore(self, state):
        pass


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("in_loop", [True, False])
def test_a_component_reports_its_own_jumps(native, in_loop):
    """The integral of a saw tooth over two teeth is 2 (0.5^2 / 2), exactly; a constant more."""
    saw = Sawtooth()
    connections = {"b.u": "a.y"}
    if in_loop:
        saw.interface = replace(saw.interface, inputs=(Signal("u"),))
        connections["a.u"] = "b.y"
    integral = Linear(controller(A=np.zeros((1, 1)), B=np.eye(1), C=np.eye(1), D=np.zeros((1, 1))))
    for block in (None, 1, 3):
        graph = Graph({"a": saw, "b": integral}, connections, native=native)
        memory = recorded(graph, Clock(1.125, 0.125, block=block))
        assert memory["b.y"][8] == 0.25
        assert memory.events() == [
            SignalEvent(500_000_000, "jump", "a.y", (0.5,)),
            SignalEvent(1_000_000_000, "jump", "a.y", (0.5,)),
        ]


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        (
            {3: np.zeros(2)},
            r"left_limits returned an array of float64, shape \(2,\); expected",
        ),
        ({3: 0.5}, "left_limits returned float; expected a float64 array"),
        (None, "left_limits raised KeyError: 7"),
        ({8: np.zeros(1)}, "left_limits: .*from 0 to .*, got 8"),
        ({-1: np.zeros(1)}, "left_limits: .*from 0 to .*, got -1"),
        ({"y": np.zeros(1)}, "left_limits: .*from 0 to .*, got 'y'"),
    ],
)
def test_left_limits_that_are_none_are_refused(limits, text):
    """By the name of the component, as all that it returns."""
    saw = Sawtooth(limits)
    if limits is None:
        saw.left_limits = lambda t: {}[7]
    graph = Graph({"a": saw, "b": integrator()}, {"b.u": "a.y"})
    with pytest.raises(RunError, match=rf"'a' stopped at t = .*: {text}"):
        recorded(graph, Clock(1.0, 0.125))


def test_a_jump_that_arrives_later_is_reported():
    """A delay keeps rows, and no left limits."""
    components = {
        "u": step(time=0.5),
        "plant": stand(),
        "delay": Delay(2),
        "z": integrator(),
    }
    connections = {"plant.u": "u.y", "delay.u": "plant.y", "z.u": "delay.y"}
    ((name, text),) = Graph(components, connections).warnings
    assert name == "delay"
    assert text == (
        "delay.y follows plant.y with a delay, which jumps with u.y, which feeds through: where "
        "that arrives the jump becomes a ramp over the step before it: an error of first order in "
        "the step"
    )
