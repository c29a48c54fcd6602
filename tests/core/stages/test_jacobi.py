"""Jacobi: in every step all components take what the others gave before it."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim import blocks
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.simulation import Simulation
from tests.core.graphs import discretized, gain_of, pair, pair_map, record
from tests.core.parts import half_through, integrator, through


@pytest.mark.parametrize("interpolation", ["linear", "zero-order", "latest"])
@pytest.mark.parametrize("native", [True, False])
def test_an_algebraic_loop_takes_the_outputs_from_before_the_step(interpolation, native):
    """Row by row the map worked out by hand; the inputs recorded are what the sources gave last."""
    h = 6e-4
    graph = pair("jacobi", input_interpolation=interpolation, native=native)
    rows = record(graph, 0.3, h)[["one.x", "two.x", "one.y", "two.y"]]
    for before, after in pairwise(rows):
        # rounding of sums of values below 50, and of exp(A h)
        np.testing.assert_allclose(after, pair_map(h) @ before, rtol=0, atol=1e-12)
    memory = record(pair("jacobi"), 0.3, h)
    assert memory["one.u"].tobytes() == memory["two.y"].tobytes()
    assert memory["two.u"].tobytes() == memory["one.y"].tobytes()


@pytest.mark.parametrize("native", [True, False])
def test_an_override_of_what_is_kept_holds_from_where_it_is_set(native):
    """The output follows it at once, as it is no output from before the step."""
    simulation = Simulation(pair("jacobi", native=native), Clock(0.6, 6e-4))
    simulation.step(3)
    simulation["one.u"] = 2.0
    rows = simulation.step(4)
    np.testing.assert_allclose(rows["one.y"], 3.0 * rows["one.x"] + 2.0, rtol=1e-13)
    simulation.release("one.u")
    before = [simulation[name][0] for name in ("one.x", "two.x", "one.y", "two.y")]
    simulation.step(1)
    after = [simulation[name][0] for name in ("one.x", "two.x", "one.y", "two.y")]
    np.testing.assert_allclose(after, pair_map(6e-4) @ before, rtol=0, atol=1e-12)


@pytest.mark.parametrize("h", [0.01, 6.1e-4, 6e-4, 1e-4])
def test_the_gain_of_an_algebraic_loop_is_that_of_the_map_by_hand(h):
    """1.97 a step of 10 ms, which is refused; below 0.61 ms it is stable, and accepted."""
    gain = gain_of(pair("jacobi"), Clock(1000 * h, h))
    radius = np.abs(np.linalg.eigvals(pair_map(h))).max()
    assert gain.rho == pytest.approx(radius, rel=1e-12)
    if h == 0.01:
        assert gain.rho == pytest.approx(1.97, abs=0.005)
        assert gain.verdict == "refused"
    elif h <= 6e-4:
        assert gain.rho < 1.0
        assert gain.verdict == "fine"


def two_inputs():
    """Return x' = -2 x + u0 + 3 u1, y = x + 0.5 u0 + 0.3 u1."""
    D = np.array([[0.5, 0.3]])
    return Linear(controller(A=-2.0 * np.eye(1), B=np.array([[1.0, 3.0]]), C=np.eye(1), D=D))


def test_what_is_evaluated_again_keeps_what_closes_an_algebraic_loop():
    """a and b feed through to each other; a has a second input, known as soon as c has advanced.

    Outputs are evaluated again for that one, and belong to the other one from before the step.
    """
    h = 0.01
    parts = {"a": two_inputs(), "b": through(0.4), "c": integrator(3.0, 1.0)}
    connections = {"a.u": ["b.y", "c.y"], "b.u": "a.y", "c.u": "a.y"}
    graph = Graph(parts, connections, coupling="jacobi")
    (stage,) = graph.stages
    assert ("refresh", "a") in stage.order
    grown, by_input = discretized(-2.0, 1.0, h)
    grown_c, by_input_c = discretized(-3.0, 3.0, h)
    M = np.zeros((5, 5))  # of x_a, x_b, y_a, y_b, y_c
    M[0] = [grown, 0.0, 0.0, by_input, 3.0 * by_input]
    M[1] = [0.0, grown, by_input, 0.0, 0.0]
    M[4] = [0.0, 0.0, by_input_c, 0.0, grown_c]
    M[2] = M[0] + 0.3 * M[4]
    M[2, 3] += 0.5
    M[3] = M[1]
    M[3, 2] += 0.4
    gain = gain_of(Graph(parts, connections, coupling="jacobi"), Clock(1.0, h))
    assert gain.rho == pytest.approx(np.abs(np.linalg.eigvals(M)).max(), rel=1e-12)
    for native in (True, False):
        graph = Graph(parts, connections, coupling="jacobi", native=native)
        rows = record(graph, 1.0, h)[["a.x", "b.x", "a.y", "b.y", "c.y"]]
        for before, after in pairwise(rows):
            np.testing.assert_allclose(after, M @ before, rtol=0, atol=1e-14)


def graph_of(seed, names, **options):
    """Return a random loop of some names, with feedthrough, algebraic loops, and a sum."""
    draw = random.Random(seed)
    components = {}
    connections = {}
    for name in names:
        components[name] = draw.choice([integrator, through, half_through, two_inputs])()
    for i, name in enumerate(names):
        sources = [names[i - 1], draw.choice(names)]
        ports = []
        for source in sources:
            ports.append(f"{source}.{draw.choice(components[source].interface.outputs).name}")
        gains = np.array([[0.4, draw.choice([-0.3, 0.0, 0.2])]])
        if components[name].interface.n_u == 2:
            gains = np.diag(gains[0])
        connections[f"{name}.u"] = Connection(tuple(ports), gains)
    return Graph(components, connections, coupling="jacobi", **options)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 10**6),
    st.permutations(["a", "b", "c", "d", "e"]),
    st.sampled_from(["linear", "zero-order", "latest"]),
    st.sampled_from([1, 2]),
    st.booleans(),
)
def test_names_decide_nothing(seed, names, interpolation, iterations, native):
    """All see the same, so that it does not matter who advances first."""
    if interpolation == "zero-order":
        iterations = 1  # more change nothing, and are refused
    tables = []
    for own_names in (sorted(names), names):
        options = {"input_interpolation": interpolation, "iterations": iterations}
        graph = graph_of(seed, own_names, native=native, **options)
        memory = Memory()
        run(graph, Clock(0.05, 0.01), memory)
        tables.append(np.hstack([memory.rows(name) for name in own_names]))
    # initial values of algebraic loops are solved for to 1e-12, and 5 steps multiply that by < 100
    np.testing.assert_allclose(tables[0], tables[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("interpolation", ["linear", "latest"])
@pytest.mark.parametrize("iterations", [2, 3])
def test_an_iteration_sees_what_the_one_before_gave(iterations, interpolation, native):
    """Beside a plain loop: x' = v, v' = -4 x, exact for straight lines or for constant inputs.

    A line begins where the one of the step before has ended: with what was tried there at last.

    Of 100 steps each of some roundings of values up to 2.
    """
    components = {
        "x": Linear(blocks.integrator(initial=1.0)),
        "v": Linear(blocks.integrator(initial=0.0)),
    }
    connections = {"x.u": "v.y", "v.u": Connection("x.y", gain=-4.0)}
    options = {"input_interpolation": interpolation, "iterations": iterations}
    memory = Memory()
    graph = Graph(components, connections, coupling="jacobi", native=native, **options)
    run(graph, Clock(1.0, 0.01), memory)
    h = 0.01
    weight = 0.5 if interpolation == "linear" else 1.0
    x, v = 1.0, 0.0
    begin = (v, x)  # of the inputs
    for _ in range(100):
        next_x, next_v = x, v
        for _ in range(iterations):
            end = (next_v, next_x)
            given = tuple(b + weight * (e - b) for b, e in zip(begin, end, strict=True))
            next_x, next_v = x + h * given[0], v - 4.0 * h * given[1]
        begin = end
        x, v = next_x, next_v
    assert memory["x.y"][-1] == pytest.approx(x, abs=1e-13)
    assert memory["v.y"][-1] == pytest.approx(v, abs=1e-13)
