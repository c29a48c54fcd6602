"""Compiled stages give the bits, the errors and the ends of the ordinary ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.stages.coupling import Loop
from cosim.core.stages.native_stage import NativeStage, advancing_stages
from cosim.errors import CosimError
from cosim.units import BaseUnit
from tests.core.graphs import random_graph, rows_of
from tests.core.parts import InPython, Scripted, integrator, through

GRAPHS = given(st.integers(0, 10**6), st.sampled_from(["gauss-seidel", "jacobi", "newton"]))


@settings(max_examples=15)
@GRAPHS
def test_compiled_stages_give_the_same_bits(seed, coupling):
    """In cascades and loops, with components in Python among them, in blocks of any length."""
    check_bits(seed, coupling)


@pytest.mark.campaign
@settings(max_examples=150)
@GRAPHS
def test_compiled_stages_give_the_same_bits_in_many_graphs(seed, coupling):
    """The same in ten times as many."""
    check_bits(seed, coupling)


def check_bits(seed, coupling):
    """Compare the rows of a random graph with those of its ordinary stages."""
    ordinary = random_graph(seed, coupling, native=False, python_parts=False)
    assume(ordinary is not None)
    needed = rows_of(ordinary, 13)
    for block in (1, 13, None):
        for python_parts in (False, True):
            graph = random_graph(seed, coupling, native=True, python_parts=python_parts)
            assert rows_of(graph, block) == needed


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
@pytest.mark.parametrize("size", [2, 7, 8, 9])
def test_vectors_are_copied_with_the_same_bits(size, coupling):
    """Few columns one by one, many at once: in a loop, and behind it."""

    def graph(native):
        A = -np.diag(np.arange(1.0, 1.0 + size))
        one, two, behind = (
            Linear(controller(A=A, B=gain * np.eye(size), C=np.eye(size), x0=np.ones(size)))
            for gain in (0.5, -10.0, 1.0)
        )
        components = {"one": one, "two": two, "behind": behind}
        connections = {"one.u": "two.x", "two.u": "one.y", "behind.u": "two.y"}
        return Graph(components, connections, coupling=coupling, native=native)

    assert rows_of(graph(True), 7) == rows_of(graph(False), 13)


def test_units_are_converted_with_the_same_bits():
    """(v factor1 + offset1 - offset2) / factor2, alone and behind a gain; -0.0 keeps its sign."""

    def graph(native):
        celsius = Signal("y", unit="degC", base=BaseUnit((0, 0, 0, 0, 1, 0, 0, 0), 1.0, 273.15))
        kelvin = Signal("u", unit="K", base=BaseUnit((0, 0, 0, 0, 1, 0, 0, 0), 1.0, 0.0))
        source = Scripted([-0.0, 0.1, 1e-300, -7.3, 1e17])
        source.interface = Interface((), (celsius,))
        components = {"s": source}
        for name in ("plain", "scaled", "copied"):
            part = integrator()
            if name != "copied":
                interface = replace(part.interface, inputs=(kelvin,))
                part.interface = interface
            components[name] = part
        connections = {
            "plain.u": "s.y",
            "scaled.u": Connection("s.y", 1.8, offset=-0.7),
            "copied.u": Connection("s.y", 1.0),
        }
        return Graph(components, connections, native=native)

    assert rows_of(graph(True), 2, 0.004) == rows_of(graph(False), 1, 0.004)


def ended(build, native, block, coupling="gauss-seidel"):
    """Return how a run ended: its error, its reason, and its rows."""
    components, connections = build()
    memory = Memory()
    error = None
    try:
        graph = Graph(components, connections, coupling=coupling, native=native)
        run(graph, Clock(0.009, 1e-3, block), memory)
    except CosimError as caught:
        error = f"{type(caught).__name__}: {caught}"
    rows = [memory.rows(name).tobytes() for name in components]
    return error, memory.status, memory.reason, rows


STOP = Stopped(np.empty((0, 1)), "enough", failed=False)
STOP_WITH_ROW = Stopped(np.array([[0.5]]), "that is it", failed=False)


@pytest.mark.parametrize("event", [np.inf, np.nan, ValueError("no"), STOP, STOP_WITH_ROW])
@pytest.mark.parametrize("shape", ["loop", "behind", "before", "between"])
def test_a_run_ends_alike(event, shape):
    """The same error or reason and the same rows, whether its end is in a loop or beside one."""

    def build():
        script = Scripted([0.1, 0.2, 0.3, 0.4, event, 0.6, 0.7, 0.8, 0.9, 1.0], inputs=1)
        components = {"a": integrator(), "script": script, "b": through(), "c": integrator(2.0)}
        connections = {
            "loop": {"a.u": "script.y", "script.u0": "a.y", "b.u": "a.y", "c.u": "b.y"},
            "behind": {"a.u": "b.x", "b.u": "a.y", "script.u0": "b.y", "c.u": "script.y"},
            "before": {"script.u0": "script.y", "a.u": "script.y", "b.u": "c.y", "c.u": "b.x"},
            "between": {"a.u": "a.y", "script.u0": "a.y", "b.u": "script.y", "c.u": "b.y"},
        }
        return components, connections[shape]

    blocks = (1, 4, None)
    if isinstance(event, ValueError) and shape in ("behind", "between"):
        blocks = (1,)  # what a call of many steps had computed before it raised is not known
    different = []
    for coupling in ("gauss-seidel", "jacobi"):
        expected = ended(build, False, 1, coupling)
        for block in blocks:
            found = ended(build, True, block, coupling)
            if found != expected:
                different.append((coupling, block, found, expected))
    assert different == []


def test_a_value_that_goes_around_a_loop_is_named_where_it_arose():
    """The component whose compiled step made it, not the first that was found with it."""

    def build():
        one = np.eye(1)
        unstable = Linear(controller(A=1e5 * one, B=one, C=one, x0=np.array([1e300])))
        return {"a": integrator(), "x": unstable}, {"a.u": "x.y", "x.u": "a.y"}

    error, status, _, rows = ended(build, True, None)
    assert error.startswith("NonFiniteError: 'x.y' became")
    assert status == "failed"
    assert (error, rows) == (ended(build, False, 1)[0], ended(build, False, 1)[3])


def test_neighbors_are_compiled_as_one_and_loops_always():
    """A component in Python outside every loop keeps its one call for a block."""
    components = {
        "a": integrator(),
        "b": through(),
        "c": InPython(integrator()),
        "d": InPython(integrator()),
        "e": InPython(integrator()),
        "f": through(),
    }
    connections = {
        "a.u": "a.y",
        "b.u": "a.y",
        "c.u": "b.y",
        "d.u": "e.y",
        "e.u": "d.y",
        "f.u": "c.y",
    }
    graph = Graph(components, connections, threads=1)
    graph.prepare(10**6)
    graph.initialize(0.0, np.zeros(graph.layout.width))
    kinds = [isinstance(stage, NativeStage) for stage in advancing_stages(graph)]
    assert kinds.count(False) == 1
    assert all(isinstance(stage, Loop) or len(stage.members) == 1 for stage in graph.stages)
    ordinary = Graph(components, connections, native=False)
    assert advancing_stages(ordinary) == ordinary.stages


def test_the_time_of_compiled_steps_is_measured():
    """Each component has its wall time, whether it steps in C or in Python."""
    graph = Graph({"a": integrator(), "b": InPython(integrator())}, {"a.u": "b.y", "b.u": "a.y"})
    seconds = graph.measure()
    run(graph, Clock(0.5, 1e-3), Memory())
    assert seconds["a"] > 0.0
    assert seconds["b"] > seconds["a"]
