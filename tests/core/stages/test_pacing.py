"""Blocks in pieces and calls that stay short, by a clock that only components move."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.blocks.source import sine
from cosim.core import clock as clock_module
from cosim.core.clock import BLOCK_WORK, Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run, simulate
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.stages import pacing
from cosim.errors import CosimError
from tests.core.parts import integrator


class Wall:
    """Wall time as components spend it [s]."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def wall(monkeypatch):
    """Put a clock in the place of the machine's that only components move."""
    wall = Wall()
    monkeypatch.setattr(pacing, "perf_counter", wall)
    monkeypatch.setattr(clock_module, "perf_counter", wall)
    return wall


class Costly:
    """Counts its steps, x + k; step k takes ``cost(k)`` seconds. It stops or fails at step ``end``.

    Attributes
    ----------
    calls : list of (int, float)
        Steps and seconds of each call.
    """

    interface = Interface((Signal("u"),), (Signal("y"),))

    def __init__(self, wall, cost, end=None, value=None):
        self.wall = wall
        self.cost = cost
        self.end = end
        self.value = value
        self.calls = []

    def initialize(self, t, u):
        self.k = 0
        return np.array([u[0]])

    def outputs(self, t, u):
        return np.array([u[0]])

    def advance(self, t, h, u):
        began = self.wall.now
        rows = []
        for k in range(len(t) - 1):
            if self.k + 1 == self.end:
                if self.value is None:
                    raise Stopped(np.array(rows, np.float64).reshape(-1, 1), "enough")
                rows.append([self.value])
            else:
                rows.append([u[k + 1, 0] + self.k])
            self.wall.now += self.cost(self.k)
            self.k += 1
        self.calls.append((len(rows), self.wall.now - began))
        return np.array(rows, np.float64)


class Watching(Memory):
    """Notes when it was written to."""

    def __init__(self, wall):
        super().__init__()
        self.wall = wall
        self.instants = []

    def write(self, block, signals):
        super().write(block, signals)
        self.instants.append(self.wall.now)

    @property
    def longest(self):
        return max(np.diff(self.instants))


def slow_from(k0, fast=3.8e-6, slow=2e-3):
    return lambda k: fast if k < k0 else slow


@pytest.mark.parametrize("block", [None, 13_000])
def test_a_component_that_turns_slow_keeps_the_run_for_a_second_at_most(wall, block):
    """It took 50 ms for a block of 13 000 steps, then 2 ms for each step of it."""
    slow = Costly(wall, slow_from(20_000))
    graph = Graph({"s": sine(rate=1.0), "x": slow, "z": integrator()}, {"x.u": "s.y", "z.u": "x.y"})
    memory = Watching(wall)
    run(graph, Clock(23.0, 1e-3, block), memory)
    assert memory.longest < 1.0
    assert max(seconds for _, seconds in slow.calls) < 0.6
    assert len(memory["x.y"]) == 23_001
    other = Memory()
    again = Costly(wall, lambda k: 0.0)
    graph = Graph(
        {"s": sine(rate=1.0), "x": again, "z": integrator()}, {"x.u": "s.y", "z.u": "x.y"}
    )
    run(graph, Clock(23.0, 1e-3, 1000), other)
    for name in ("s.y", "x.y", "z.u", "z.y"):
        assert memory[name].tobytes() == other[name].tobytes()


def test_calls_are_few_where_a_component_is_fast(wall):
    """Calls grow fourfold to their length, so that their number is that of the blocks and a few."""
    fast = Costly(wall, lambda k: 1e-9)
    memory = Watching(wall)
    run(Graph({"s": sine(rate=1.0), "x": fast}, {"x.u": "s.y"}), Clock(50.0, 1e-3), memory)
    assert len(fast.calls) <= len(memory.instants) + 8
    assert max(steps for steps, _ in fast.calls) > 10_000


def test_a_steady_component_is_called_as_often_as_its_work_asks_for(wall):
    """Calls take their share of a block, whatever a step costs, and blocks their 50 ms."""
    for cost in (1e-5, 1e-4):
        steady = Costly(wall, lambda k, cost=cost: cost)
        memory = Watching(wall)
        steps = round(20 * BLOCK_WORK / cost)
        graph = Graph({"s": sine(rate=1.0), "x": steady}, {"x.u": "s.y"})
        run(graph, Clock(float(steps), 1.0), memory)
        seconds = [elapsed for _, elapsed in steady.calls[10:-1]]
        assert 0.5 * pacing.CALL_WORK < np.median(seconds) <= pacing.CALL_WORK + cost
        assert np.median(np.diff(memory.instants)[8:-1]) == pytest.approx(BLOCK_WORK, rel=0.1)


def test_one_long_call_shortens_the_next_only_for_a_while(wall):
    """A stall says nothing of the calls behind it."""
    stall = Costly(wall, lambda k: 0.2 if k == 5000 else 1e-6)
    run(Graph({"s": sine(rate=1.0), "x": stall}, {"x.u": "s.y"}), Clock(60.0, 1e-3), Watching(wall))
    steps = [steps for steps, _ in stall.calls]
    assert min(steps[10:-1]) < 10
    assert steps[-8:-2] == [1000] * 6 or min(steps[-8:-2]) > 500


def test_a_short_call_at_the_end_of_a_block_does_not_shorten_the_next(wall):
    """Blocks of 101 steps, of which 100 take the time of a call: two calls each."""
    cost = pacing.CALL_WORK / 100.5
    steady = Costly(wall, lambda k: cost)
    graph = Graph({"s": sine(rate=1.0), "x": steady}, {"x.u": "s.y"})
    run(graph, Clock(101 * 50.0, 1.0, 101), Watching(wall))
    assert [steps for steps, _ in steady.calls[-40:]] == [100, 1] * 20


def test_fixed_blocks_of_a_simulation_are_not_divided(wall):
    """Who steps by hand gets the rows that were asked for, and components stand at the last."""
    slow = Costly(wall, lambda k: 1.0)
    graph = Graph({"s": sine(rate=1.0), "x": slow}, {"x.u": "s.y"})
    for block, signals in simulate(graph, Clock(0.021, 1e-3, 7)):
        assert block.steps == 7
        assert len(signals) == 8
        assert slow.k == block.index + 7
    assert {steps for steps, _ in slow.calls} == {1}


def test_many_steps_of_a_simulation_are_recorded_piece_by_piece(wall):
    """A live view of its log falls behind by less than a second, however long the steps take."""
    graph = Graph({"s": sine(rate=1.0), "x": Costly(wall, lambda k: 0.05)}, {"x.u": "s.y"})
    clock = Clock(0.1, 1e-3)
    memory = Watching(wall)
    plan = graph.prepare(clock.step_ns)
    memory.begin(plan)
    Simulation(graph, clock, plan, recorder=memory).step(100)
    assert wall.now > 4.0
    assert memory.longest < 1.0


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.sampled_from([None, 5, 40]))
def test_rows_do_not_depend_on_the_pace(seed, block):
    """Rows, the first error and its time: with components that turn slow, stop and fail anywhere.

    The reference advances step by step.
    """
    draw = random.Random(seed)
    plan = []
    for _ in range(4):
        turn = draw.randint(0, 40)
        end = draw.choice([None, None, draw.randint(1, 45)])
        value = draw.choice([None, np.inf])
        plan.append((turn, draw.choice([1e-6, 0.1]), end, value))
    shape = draw.choice(["chain", "loop"])
    results = []
    with pytest.MonkeyPatch.context() as patch:
        wall = Wall()
        patch.setattr(pacing, "perf_counter", wall)
        patch.setattr(clock_module, "perf_counter", wall)
        for size, paced in ((block, True), (1, False)):
            components = {"s": sine(rate=1.0)}
            connections = {}
            behind = "s.y"
            for i, (turn, slow, end, value) in enumerate(plan):
                cost = slow_from(turn, 1e-6, slow if paced else 1e-6)
                components[f"x{i}"] = Costly(wall, cost, end, value)
                connections[f"x{i}.u"] = behind
                behind = f"x{i}.y"
            if shape == "loop":
                components["lag"] = integrator()
                connections["lag.u"] = "x2.y"
                connections["x1.u"] = "lag.y"
            memory = Memory()
            error = None
            try:
                run(Graph(components, connections), Clock(0.04, 1e-3, size), memory)
            except CosimError as caught:
                error = str(caught)
            rows = [memory[f"{name}.y"].tobytes() for name in components]
            results.append((error, rows, memory.time_ns("s").tolist()))
    assert results[0] == results[1]


def test_a_stop_waits_for_who_is_behind(wall):
    """What stops early in a long block is known first, and raised when all have come there."""
    early = Costly(wall, lambda k: 1e-7, end=500)
    slow = Costly(wall, slow_from(300, 1e-7, 0.1))
    graph = Graph({"s": sine(rate=1.0), "x": early, "z": slow}, {"x.u": "s.y", "z.u": "x.y"})
    memory = Watching(wall)
    with pytest.raises(Stopped, match=r"'x' stopped at t = 0\.499 s: enough"):
        run(graph, Clock(1.0, 1e-3, 1000), memory)
    assert len(memory["z.y"]) == 500
    assert memory.longest < 1.0
    assert len(memory.instants) > 20
