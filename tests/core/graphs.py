"""Graphs that tests of loops and stages share, and what they record."""

from __future__ import annotations

import random

import numpy as np
import scipy.linalg

from cosim.blocks.dynamics import Delay
from cosim.blocks.source import Noise, sine
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.graph import Graph
from cosim.core.linear import Linear, LinearModel
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import AlgebraicLoopError
from tests.core.parts import InPython, half_through, integrator, through

PAIR = ((-0.9, 0.5, 3.0, 1.0), (-1.0, 10.0, -31.0, -0.9))
RATE = 1e3  # rad/s


def state_space(A, B, C, D, x0):
    """Return x' = A x + B u, y = C x + D u, x, of scalars."""
    matrices = [np.array([[value]], np.float64) for value in (A, B, C, D)]
    names = dict(zip("ABCD", matrices, strict=True))
    return Linear(controller(**names, x0=np.array([x0], np.float64)))


def pair(coupling="newton", d2=-0.9, **options):
    """x1' = -0.9 x1 + 0.5 u1, y1 = 3 x1 + u1; x2' = -x2 + 10 u2, y2 = -31 x2 + d2 u2."""
    components = {
        "one": state_space(-0.9, 0.5, 3.0, 1.0, 1.0),
        "two": state_space(-1.0, 10.0, -31.0, d2, 1.0),
    }
    connections = {"one.u": "two.y", "two.u": "one.y"}
    return Graph(components, connections, coupling=coupling, **options)


def solution(t, d2=-0.9):
    """Return (x1, x2) of the pair, its algebraic loop eliminated."""
    A = np.diag([-0.9, -1.0])
    B = np.diag([0.5, 10.0])
    C = np.diag([3.0, -31.0])
    D = np.diag([1.0, d2])
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    u_of_x = np.linalg.solve(np.eye(2) - swap @ D, swap @ C)
    return scipy.linalg.expm((A + B @ u_of_x) * t) @ np.ones(2)


def record(graph, stop=1.0, step=0.01, block=None):
    """Run a graph; return what it recorded."""
    memory = Memory()
    run(graph, Clock(stop, step, block), memory)
    return memory


def states(memory):
    """Return the last states of the pair."""
    return np.array([memory["one.x"][-1], memory["two.x"][-1]])


def loop(**options):
    """Return a plant and its controller in a loop, with a delay line and noise beside them."""
    components = {
        "noise": Noise(deviation=0.1, seed=3),
        "s": sine(rate=1.0),
        "plant": half_through(),
        "controller": through(),
        "late": Delay(3),
    }
    connections = {
        "controller.u": Connection("plant.v", gain=-0.5),
        "plant.u": "controller.y",
        "late.u": "s.y",
    }
    return Graph(components, connections, **options)


def random_graph(seed, coupling, *, native, python_parts):
    """Return a graph of first-order systems in cascades and loops, with gains and offsets."""
    draw = random.Random(seed)
    count = draw.randint(2, 7)
    components = {}
    for i in range(count):
        part = draw.choice([integrator, integrator, through, half_through])()
        in_python = draw.random() < 0.4
        components[f"x{i}"] = InPython(part) if python_parts and in_python else part
    connections = {}
    for i in range(count):
        sources = []
        for _ in range(draw.randint(1, 3)):
            source = f"x{draw.randrange(count)}"
            outputs = components[source].interface.outputs
            sources.append(f"{source}.{draw.choice(outputs).name}")
        gains = [[draw.choice([0.0, -0.5, 0.25]) for _ in sources]]
        offset = draw.choice([0.0, 0.3])
        plain = draw.random() < 0.4
        connections[f"x{i}.u"] = (
            sources[0] if plain else Connection(tuple(sources), gains, offset=offset)
        )
    try:
        return Graph(components, connections, coupling=coupling, native=native)
    except AlgebraicLoopError:
        return None


def rows_of(graph, block, stop=0.05):
    """Return the bits of all rows of a run."""
    memory = Memory()
    run(graph, Clock(stop, 1e-3, block), memory)
    return b"".join(memory.rows(name).tobytes() for name in graph.components)


def loops_of(graph, clock):
    """Return the loops of a graph, linearized where it starts."""
    graph.prepare(clock.step_ns)
    row = np.zeros(graph.layout.width)
    graph.initialize(clock.start_time, row)
    return LinearizedLoops.of(graph, clock, row)


def gain_of(graph, clock):
    """Return the gain of a graph's only loop."""
    (found,) = loops_of(graph, clock).gains()
    return found


def discretized(A, B, h):
    """Return exp(A h) and what a constant input adds over a step."""
    return np.exp(A * h), np.expm1(A * h) / A * B


def pair_map(h):
    """Return what a step of Jacobi does to (x1, x2, y1, y2), by hand.

    Each input is the output of the other one from before the step, for the state and for the output
    at its end.
    """
    M = np.zeros((4, 4))
    for i, (A, B, C, D) in enumerate(PAIR):
        growth, per_input = discretized(A, B, h)
        M[i, i] = growth
        M[i, 3 - i] = per_input
        M[2 + i] = C * M[i]
        M[2 + i, 3 - i] += D
    return M


def derivative_filter() -> Linear:
    """Return q' = a (y + u - q), d = a (y + u - q): the filtered derivative of y + u."""
    interface = Interface(
        (Signal("u"), Signal("y")), (Signal("d"),), {"d": ("u", "y")}, {"d": ("u", "y")}
    )
    B = np.array([[RATE, RATE]])
    A = np.array([[-RATE]])
    x0 = np.zeros(1)
    return Linear(LinearModel(interface, ("q",), A, B, A, B, x0, np.ones((1, 2))))


def stand(D: float = -1.0) -> Linear:
    """Return x' = 0, y = x + D u with x = 2."""
    zero = np.zeros((1, 1))
    return Linear(controller(A=zero, B=zero, C=np.eye(1), D=np.array([[D]]), x0=np.array([2.0])))
