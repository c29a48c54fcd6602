"""Loops that run away: where a run ends, with what words, and what is none."""

import math

import numpy as np
import pytest

from cosim.blocks.source import step
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.stages.runaway import HISTORY, LIMIT, LoopWatch
from cosim.errors import RunawayError
from tests.core.graphs import state_space

ROOT = math.sqrt(3.0)


class Map:
    """y[k + 1] = factor * u[k] + offset."""

    def __init__(self, factor, start, offset=0.0, nominal=1.0):
        y = Signal("y", nominal=(nominal,))
        self.interface = Interface((Signal("u"),), (y,), delayed=("u",))
        self._factor = factor
        self._start = start
        self._offset = offset

    def initialize(self, t, u):
        self._y = self._start
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self._y])

    def advance(self, t, h, u):
        rows = []
        for value in u[:-1, 0]:
            self._y = self._factor * float(value) + self._offset
            rows.append([self._y])
        return np.array(rows)


def growing(factor=-ROOT, **options):
    """Return a loop that grows threefold in two steps; its values change their sign."""
    components = {"a": Map(factor, 1.0, **options), "b": Map(ROOT, 1.0, **options)}
    graph = Graph(components, {"a.u": "b.y", "b.u": "a.y"}, coupling="jacobi")
    graph.watched = frozenset(["a"])
    return graph


def run_away(graph, *, stop=1.0, block=None):
    memory = Memory()
    with pytest.raises(RunawayError) as error:
        run(graph, Clock(stop, 0.01, block), memory)
    return memory, str(error.value)


def test_a_loop_that_grows_without_end_stops_the_run():
    """At the first row beyond the limit, which is not kept."""
    memory, text = run_away(growing())
    peaks = np.maximum(np.abs(memory["a.y"]), np.abs(memory["b.y"]))
    assert peaks[-1] <= LIMIT < peaks[-1] * ROOT * 1.001
    assert (
        "'a.u' diverges: -1.47e+12 at t = 0.51 s, after growth by a steady factor of 1.732" in text
    )
    assert "by a steady factor of 1.732 per step" in text
    assert "b.y -> a.u" in text
    assert f"at t = {0.01 * len(peaks):.12g}" in text


@pytest.mark.parametrize("block", [1, 3, 7, 10])
def test_where_it_ends_does_not_depend_on_blocks(block):
    whole, text = run_away(growing())
    divided, same_text = run_away(growing(), block=block)
    assert same_text == text
    assert divided["a.y"].tobytes() == whole["a.y"].tobytes()


def test_a_loop_that_is_not_watched_goes_on():
    graph = growing()
    graph.watched = frozenset()
    memory = Memory()
    run(graph, Clock(1.0, 0.01), memory)
    assert abs(memory["a.y"][-1]) > 1e3 * LIMIT


def test_the_limit_follows_nominal_values():
    """Signals of 1e20 are nothing special in a loop whose signals have that size."""
    memory, _ = run_away(growing(nominal=1e9))
    assert np.abs(memory["a.y"][-1]) > 1e20


def test_a_signal_that_jumps_to_a_large_value_does_not_run_away():
    """From 0 to 1e20 in some steps, and there it stays."""
    components = {
        "source": step(time=0.05, before=0.0, after=1e20),
        "one": state_space(-900.0, 900.0, 1.0, 0.0, 0.0),
        "two": state_space(-900.0, 900.0, 0.1, 0.0, 0.0),
    }
    both = Connection(("source.y", "two.y"), gain=np.array([[1.0, 1.0]]))
    graph = Graph(components, {"one.u": both, "two.u": "one.y"})
    graph.watched = frozenset(["one", "two"])
    memory = Memory()
    run(graph, Clock(0.5, 0.01), memory)
    assert memory["one.y"][-1] > 1e20


def test_a_session_stops_at_the_same_row():
    memory, text = run_away(growing())
    simulation = Simulation(growing(), Clock(1.0, 0.01))
    for _ in range(len(memory["a.y"]) - 1):
        simulation.step(1)
    with pytest.raises(RunawayError) as error:
        simulation.step(1)
    assert str(error.value) == text


@pytest.mark.parametrize("slope", [1e14, 1e16])
def test_ramps_do_not_run_away(slope):
    """An integrator in a loop, driven by a constant: 1e16 after a second."""
    components = {
        "source": step(time=0.05, before=0.0, after=slope),
        "one": state_space(0.0, 1.0, 1.0, 0.0, 0.0),
        "two": state_space(-1.0, 1e-3, 1.0, 0.0, 0.0),
    }
    both = Connection(("source.y", "two.y"), gain=np.array([[1.0, 1.0]]))
    graph = Graph(components, {"one.u": both, "two.u": "one.y"})
    graph.watched = frozenset(["one"])
    memory = Memory()
    run(graph, Clock(3.0, 0.01), memory)
    assert memory["one.y"][-1] > 10 * LIMIT


def test_a_loop_that_oscillates_while_it_grows_is_found():
    """Each component turns and stretches: the values of a row need not be larger than before."""
    components = {"a": Map(-1.2, 1.0), "b": Map(1.1, 0.0)}
    graph = Graph(components, {"a.u": "b.y", "b.u": "a.y"}, coupling="jacobi")
    graph.watched = frozenset(["b"])
    memory, text = run_away(graph, stop=10.0)
    peaks = np.abs(memory["a.y"])
    assert not (peaks[1:] > peaks[:-1]).all()
    assert f"factor of {math.sqrt(1.32):.3f} per step" in text


def test_memory_does_not_grow_with_the_run():
    """Of the rows before a block it is those that growth is seen in."""
    members = list(growing().members.values())
    watch = LoopWatch([members])
    for block in Clock(10.0, 0.01, 4).blocks(4, 0.0):
        watch.advance(block, np.ones((block.steps + 1, 4)))
    (loop,) = watch._loops
    assert len(loop._peaks) <= HISTORY + 5
