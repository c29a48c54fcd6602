"""What a component costs does not depend on how many there are: ratios of processor time."""

import gc
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from time import process_time

import numpy as np
import pytest

from cosim.blocks.arithmetic import sum_of
from cosim.blocks.dynamics import Delay
from cosim.blocks.port_map import names_of
from cosim.blocks.renaming import Renaming, map_ports
from cosim.blocks.replay import Replay
from cosim.blocks.source import sine
from cosim.core import clock as clock_module
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.core.stages import pacing
from tests.core.parts import integrator

LARGEST_RATIO = 1.5
ATTEMPTS = 5  # the smallest ratio counts: a look-up that is linear is far above the limit in all
FEWEST_PAIRS = 5
MOST_PAIRS = 25


def chain(n):
    """Return a row of lags."""
    components = {"r": sine(rate=1.0)}
    connections = {}
    behind = "r.y"
    for i in range(n):
        components[f"x{i}"] = integrator(2.0)
        connections[f"x{i}.u"] = behind
        behind = f"x{i}.y"
    return components, connections


def inherited(n):
    """Return a row of delays, whose outputs are as continuous as what is at its begin."""
    components, connections = chain(n)
    delays = {name: Delay(2) for name in components if name != "r"}
    return components | delays, connections


def star(n):
    """Return lags behind one source, and a stack of a tenth of them."""
    components = {"r": sine(rate=1.0)}
    connections = {}
    for i in range(n):
        components[f"x{i}"] = integrator(2.0)
        connections[f"x{i}.u"] = "r.y"
    stack = [f"x{i}.y" for i in range(n // 10)]
    components["stack"] = Delay(1, size=len(stack))
    connections["stack.u"] = stack
    return components, connections


def ring(n):
    """Return one loop of all, with a sum in it."""
    components, connections = chain(n)
    components["s"] = sum_of([1.0, -1.0])
    return components, connections | {"s.u1": "r.y", "s.u2": f"x{n - 1}.y", "x0.u": "s.y"}


def costs(make, n):
    """Return the processor time for each component: to build, to run, to replay."""
    components, connections = make(n)
    began = process_time()
    graph = Graph(components, connections)
    built = process_time()
    memory = Memory()
    run(graph, Clock(0.1, 1e-3), memory)
    ran = process_time()
    recorded = {name: Replay(memory, name) for name in components}
    again = Memory()
    run(Graph(recorded, connections), Clock(0.1, 1e-3), again)
    replayed = process_time()
    last = list(components)[-1]
    assert memory[f"{last}.y"].tobytes() == again[f"{last}.y"].tobytes()
    return np.diff([began, built, ran, replayed]) / n


def check_growth(make, small, large, monkeypatch):
    # Machines are not equally fast at all times; blocks shall be the same.
    monkeypatch.setattr(pacing, "perf_counter", lambda: 0.0)
    monkeypatch.setattr(clock_module, "perf_counter", lambda: 0.0)
    ratios = np.full(3, np.inf)
    for _ in range(ATTEMPTS):
        base = np.min([costs(make, small) for _ in range(2)], axis=0)
        ratios = np.minimum(ratios, costs(make, large) / base)
        if (ratios <= LARGEST_RATIO).all():
            return
    raise AssertionError(f"a component costs {ratios} times as much to build, run and replay")


@pytest.mark.slow
@pytest.mark.usefixtures("frozen_heap")
@pytest.mark.parametrize(
    ("make", "small", "large"),
    [(chain, 100, 700), (inherited, 100, 700), (star, 100, 700), (ring, 30, 150)],
)
def test_the_cost_of_a_component_does_not_grow(make, small, large, monkeypatch):
    """To build, to run and to replay: a look-up that is linear in n would be ten times slower."""
    check_growth(make, small, large, monkeypatch)


@pytest.mark.campaign
@pytest.mark.usefixtures("frozen_heap")
@pytest.mark.parametrize(
    ("make", "small", "large"),
    [(chain, 100, 3000), (inherited, 100, 3000), (star, 100, 3000), (ring, 100, 300)],
)
def test_the_cost_of_a_component_does_not_grow_to_thousands(make, small, large, monkeypatch):
    """The same with 3000 components, and a loop of 300."""
    check_growth(make, small, large, monkeypatch)


def declaring(size):
    """Return what declares the outputs of one component."""
    inputs = tuple(Signal(f"u{i}") for i in range(size))
    outputs = tuple(Signal(f"y{i}") for i in range(size))
    feedthrough = {f"y{i}": (f"u{i}",) for i in range(size)}
    return partial(Interface, inputs, outputs, feedthrough, initial=feedthrough)


def reading(size):
    """Return what reads the signals of one component by their names."""
    signals = tuple(Signal(f"s{i}") for i in range(size))
    layout = Layout((Channel("c", Interface((), signals), 0),))
    memory = Memory()
    memory.begin(Plan(layout, 1, {}, {}, ()))

    def read():
        columns = dict(memory)
        assert len(columns) == size
        return columns, [memory.time(name) for name in memory]

    return read


def renaming(size):
    """Return what shows the signals of one component under other names."""
    inputs = tuple(Signal(f"u{i}") for i in range(size))
    renamings = [Renaming(Port("c", f"v{i}"), (Port("c", f"u{i}"),)) for i in range(size)]

    def rename():
        ports = map_ports(Interface(inputs), renamings)
        assert len(ports.interface.inputs) == size
        return ports

    return rename


def naming(size):
    """Return what shows and names the elements of one vector."""
    renamings = [Renaming(Port("c", f"v{i}"), (Port("c", "u", i),)) for i in range(size)]

    def name():
        ports = map_ports(Interface((Signal("u", size),)), renamings)
        for i, port in enumerate(ports.inputs):
            assert names_of(port.elements) == [f"u[{i}]"]
        return ports

    return name


class Wide:
    """A component of many inputs and outputs, which is not run."""

    def __init__(self, inputs, outputs):
        self.interface = Interface(
            tuple(Signal(f"u{i}") for i in range(inputs)),
            tuple(Signal(f"y{i}") for i in range(outputs)),
        )

    def initialize(self, t, u):
        raise NotImplementedError

    outputs = advance = initialize


def checking(size):
    """Return what searches the connections between two components for jumps."""
    connections = {f"b.u{i}": f"a.y{i}" for i in range(size)}
    components = {"a": Wide(0, size), "b": Wide(size, 1)}
    graph = Graph(components, connections)

    def check():
        assert graph.warnings == []
        return graph

    return check


def signal_cost(prepare, size, count):
    """Return the processor time for each signal of ``count`` components, whose memory is kept.

    So few signals of many components do not stay in a cache that many of one do not fit into.
    """
    actions = [prepare(size) for _ in range(count)]
    gc.collect()
    gc.freeze()  # what is there already takes no time of collections from here on
    began = process_time()
    kept = [action() for action in actions]
    cost = (process_time() - began) / (size * count)
    del kept
    return cost


@pytest.fixture(scope="module")
def new_process():
    """Start a process for calls, whose memory no tests of other modules have scattered."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.mark.slow
@pytest.mark.parametrize("prepare", [declaring, reading, renaming, naming, checking])
def test_the_cost_of_a_signal_does_not_grow(prepare, new_process):
    """In a component of many signals each is found as fast as in one of few.

    The median of pairs: few of them see the machine become faster or slower between their halves.
    """
    ratios = []
    for _ in range(MOST_PAIRS):
        base = new_process.submit(signal_cost, prepare, size=200, count=10)
        large = new_process.submit(signal_cost, prepare, size=2000, count=1)
        ratios.append(large.result() / base.result())
        if len(ratios) >= FEWEST_PAIRS and np.median(ratios) <= LARGEST_RATIO:
            return
    raise AssertionError(f"a signal costs {np.median(ratios)} times as much")


def test_blocks_grow_with_the_number_of_stages():
    """Of 3000 stages the calls alone take 50 ms: blocks must not stay at one step for that."""
    components, connections = star(600)
    pacer = pacing.Pacer(Graph(components, connections).stages, divide=True)
    assert pacer.work == pytest.approx(602 * pacing.STAGE_WORK)
    assert pacing.STAGE_WORK >= clock_module.BLOCK_WORK / 100  # what each of a hundred has
    few = pacing.Pacer(Graph(*star(10)).stages, divide=True)
    assert few.work == clock_module.BLOCK_WORK
