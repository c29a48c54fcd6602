"""Branches of a graph give the bits and the ends of one thread, in one thread and in two."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cosim.blocks.source import Table, sine
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.stages import branches
from cosim.core.stages.branches import Branches
from cosim.core.stages.native_stage import NativeStage, advancing_stages
from cosim.errors import CosimError, GraphError
from tests.core.graphs import random_graph, rows_of
from tests.core.parts import InPython, integrator, through


@pytest.fixture(params=[False, True], ids=["in turn", "side by side"])
def in_two(request, monkeypatch):
    monkeypatch.setattr(Branches, "_chooses_two", lambda self: request.param)
    return request.param


def chains(**others):
    """Return a source that drives two chains, whose ends are joined."""
    components = {
        "u": sine(rate=3.0),
        "a1": integrator(),
        "a2": through(),
        "b1": integrator(2.0),
        "b2": integrator(),
        "z": through(),
        **others,
    }
    connections = {
        "a1.u": "u.y",
        "a2.u": "a1.y",
        "b1.u": "u.y",
        "b2.u": "b1.y",
        "z.u": "a2.y",
    }
    return components, connections


@pytest.mark.usefixtures("in_two")
def test_two_chains_behind_a_source_have_the_bits_of_one_thread():
    components, connections = chains()
    graph = Graph(components, connections)
    in_one = Graph(chains()[0], connections, threads=1)
    assert rows_of(graph, 7, 0.5) == rows_of(in_one, None, 0.5)
    assert [type(stage) for stage in advancing_stages(graph)] == [Branches]
    assert [type(stage) for stage in advancing_stages(in_one)] == [NativeStage]


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.booleans())
def test_any_graph_has_the_bits_of_one_thread(seed, python_parts):
    """Also with components that are called in Python, one at a time."""
    graph = random_graph(seed, "gauss-seidel", native=True, python_parts=python_parts)
    assume(graph is not None)
    reference = random_graph(seed, "gauss-seidel", native=False, python_parts=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Branches, "_chooses_two", lambda self: True)
        assert rows_of(graph, 5) == rows_of(reference, 5)


def exploding(rate):
    """Return x' = rate x from 1e300 on: infinite after some steps."""
    one = np.eye(1)
    return Linear(controller(A=rate * one, B=one, C=one, x0=np.array([1e300])))


@pytest.mark.usefixtures("in_two")
@pytest.mark.parametrize(
    "failing",
    [
        {"a1": 3000.0},
        {"b2": 3000.0},
        {"z": 3000.0},
        {"a2": 3000.0, "b1": 3000.0},
        {"b1": 3000.0, "z": 3000.0},
        {"a2": 2000.0, "b2": 9000.0},
        {"z": 9000.0, "b2": 3000.0},
    ],
)
def test_the_first_error_is_that_of_one_thread(failing):
    """Of components that fail at one step it is the first in the order of the stages."""
    ends = []
    for threads in (1, 2):
        components, connections = chains(
            **{name: exploding(rate) for name, rate in failing.items()}
        )
        memory = Memory()
        with pytest.raises(CosimError) as caught:
            run(Graph(components, connections, threads=threads), Clock(0.1, 1e-3, 20), memory)
        ends.append((str(caught.value), memory.rows("u").tobytes(), memory.rows("z").tobytes()))
    assert ends[0] == ends[1]


@pytest.mark.usefixtures("in_two")
def test_a_source_that_ends_at_once_ends_the_run(monkeypatch):
    """The branches behind it have no step whose time could be taken."""
    monkeypatch.setattr(branches, "LONG_ENOUGH", -1.0)
    components, connections = chains(u=Table(np.array([0.0, 0.5e-3]), np.zeros((2, 1))))
    memory = Memory()
    with pytest.raises(Stopped, match=r"'u' stopped at t = 0\.0 s"):
        run(Graph(components, connections), Clock(0.1, 1e-3, 20), memory)
    assert memory.steps == 0


@pytest.mark.usefixtures("in_two")
def test_components_in_python_stay_in_the_first_branch():
    """Only what is compiled may leave the thread of the caller."""
    loop = {"p": InPython(integrator()), "q": InPython(integrator())}
    components, connections = chains(**loop)
    graph = Graph(components, {**connections, "p.u": "q.y", "q.u": "p.y"})
    rows_of(graph, 9)
    (stage,) = advancing_stages(graph)
    _, first, second, _ = stage._parts
    assert {"p", "q"} <= first.names
    assert second.names
    assert not {"p", "q"} & second.names


@pytest.mark.parametrize(("cost", "chosen"), [(0.5e-3, True), (0.95e-3, False), (3e-3, False)])
def test_the_faster_way_is_kept(monkeypatch, cost, chosen):
    """After a few long calls of each; a gain of a few percent does not count."""
    now = [0.0]
    ways = []
    monkeypatch.setattr(branches, "perf_counter", lambda: now[0])

    def noted(name, elapsed):
        original = getattr(Branches, name)

        def way(self, *arguments):
            ways.append(name)
            now[0] += elapsed
            return original(self, *arguments)

        monkeypatch.setattr(Branches, name, way)

    noted("_in_turn", 1e-3)
    noted("_side_by_side", cost)
    components, connections = chains()
    run(Graph(components, connections), Clock(0.1, 1e-3, 1), Memory())
    assert len(ways) == 100
    needed = 100 - branches.TRIALS if chosen else branches.TRIALS
    assert ways.count("_side_by_side") == needed


@pytest.mark.parametrize("threads", [0, 3, True, "2"])
def test_other_numbers_of_threads_are_refused(threads):
    components, connections = chains()
    with pytest.raises(GraphError, match=r"threads:.*1, 2 or None"):
        Graph(components, connections, threads=threads)
