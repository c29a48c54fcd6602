"""Random graphs of FMUs, blocks and components in Python: one run, in whatever way it is computed.

FMUs of all versions with events of every kind, that may interpolate, go back, return early, discard
steps, fail or ask for the end, also with a period of their own.
"""

import random
from contextlib import ExitStack

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cosim.blocks.dynamics import Delay
from cosim.blocks.sampled import Sampled
from cosim.blocks.source import Noise, sine, step
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.simulation import Simulation
from cosim.core.stages.branches import Branches
from cosim.errors import CosimError, GraphError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.native.numerics.runge_kutta import EXPLICIT
from tests.core.parts import InPython, half_through, integrator, through
from tests.fmi import eventful, lag
from tests.fmi.eventful import LEVELS

H = 0.01
STEPS = 30
BLOCKS = (1, 7, STEPS, None)
COUPLINGS = (
    {"coupling": "gauss-seidel"},
    {"coupling": "jacobi"},
    {"coupling": "newton"},
    {"coupling": "gauss-seidel", "iterations": 2},
    {"coupling": "gauss-seidel", "input_interpolation": "latest"},
)


@pytest.fixture(scope="module")
def lags(tmp_path_factory):
    """Return copies of the lag with some capabilities: versions, and whether they go back."""
    folder = tmp_path_factory.mktemp("lags")
    draw = random.Random(3)
    copies = []
    for version in "123":
        fmu = lag.build(folder, version)
        for number in range(4):
            can = [c for c in lag.CAN[version] if draw.random() < 0.5 and "inner step" not in c]
            if "events" not in can and "d moves" in can:
                can.remove("d moves")
            target = folder / f"lag{version}-{number}.fmu"
            copies.append((lag.able(fmu, target, version, *can), version, "state" in can))
    return copies


class Mixture:
    """Draws a graph, the same one again for the same seed; with ``goes_back`` one that can."""

    def __init__(self, seed, lags, stack, *, goes_back=False):
        self._draw = random.Random(seed)
        self._goes_back = goes_back
        self._lags = [own for own in lags if own[2] or not goes_back]
        self._stack = stack
        self.fmus = []
        self.graph_options = self._draw.choice(COUPLINGS)
        self.components = {f"x{i}": self._component() for i in range(self._draw.randint(2, 6))}
        self.connections = {}
        for number, name in enumerate(self.components):
            for signal in self.components[name].interface.inputs:
                self.connections[f"{name}.{signal.name}"] = self._connection(number)

    def _component(self):
        draw = self._draw
        kind = draw.choice(["eventful", "eventful", "lag", "lag", "block", "source", "python"])
        if kind == "eventful":
            return self._eventful()
        if kind == "lag":
            return self._lag()
        if kind == "source":
            return draw.choice([sine(rate=9.0), step(time=0.07), Noise(deviation=0.2, seed=4)])
        if kind == "python":
            return InPython(draw.choice([integrator, through])())
        return draw.choice([integrator, through, half_through, lambda: Delay(2)])()

    def _eventful(self):
        draw = self._draw
        model = draw.choice(list(LEVELS))
        saves = draw.random() < 0.5 or self._goes_back
        path = eventful.build(model, draw.choice([2, 3]), saves=saves)
        level = LEVELS[model] if LEVELS[model] < STEPS * H else 0.145  # is reached
        return self._loaded(path, FmuOptions(solver=draw.choice(EXPLICIT), start={"p": level}))

    def _lag(self):
        draw = self._draw
        path, version, _ = draw.choice(self._lags)
        start = {}
        if draw.random() < 0.3:
            start["longest"] = 0.006
        if draw.random() < 0.3:
            start["returns"] = 0.0137
        if draw.random() < 0.3:
            start["fail"] = round(draw.uniform(0.0, 0.4), 2)
            start["status"] = draw.choice([2.0, 3.0, 4.0])
        if draw.random() < 0.3:
            start["end"] = round(draw.uniform(0.0, 0.4), 2)
        if version == "3" and draw.random() < 0.5:
            start |= {"event": 0.0333, "announces": draw.choice([0.0, 1.0, 2.0])}
        return self._loaded(path, FmuOptions(start=start))

    def _loaded(self, path, options):
        fmu = self._stack.enter_context(load(path, options))
        self.fmus.append(fmu)
        return Sampled(fmu.component, 3) if self._draw.random() < 0.2 else fmu.component

    def _connection(self, number):
        """Draw a source, most often one before the component."""
        draw = self._draw
        names = list(self.components)
        behind = draw.random() < 0.1 or number == 0
        name = draw.choice(names if behind else names[:number])
        source = f"{name}.{draw.choice(self.components[name].interface.outputs).name}"
        return Connection(source, gain=draw.choice([1.0, -0.5]), offset=draw.choice([0.0, 0.3]))

    def graph(self, *, native, threads):
        return Graph(
            self.components,
            self.connections,
            native=native,
            threads=threads,
            **self.graph_options,
        )

    def condition(self):
        """Draw a condition over an output, which a run may well meet."""
        draw = self._draw
        name = draw.choice(list(self.components))
        channel = self.graph(native=True, threads=1).layout[name]
        signal = draw.choice(channel.interface.outputs)
        level = draw.choice([0.0, 0.05, 0.3, 1.0])
        duration = draw.choice(["", "", " for 30 ms"])
        return f"{name}.{signal.name} {draw.choice(['<', '>', '!='])} {level}{duration}"


def by_hand(graph, clock, memory, until=None):
    """Take steps one by one, then the others at once."""
    try:
        with memory:
            plan = graph.prepare(clock.step_ns)
            memory.begin(plan)
            simulation = Simulation(graph, clock, plan, recorder=memory, until=until)
            for _ in range(STEPS // 2):
                simulation.step()
            simulation.step(simulation.steps_left)
    except Stopped as stop:
        if stop.failed:
            raise


def outcome(seed, lags, *, native=True, threads=1, block=None, way=run, ends=False):
    """Return how a run ended, its rows, and what the FMUs said if it is complete.

    With ``ends`` a condition may end it.
    """
    with ExitStack() as stack:
        mixture = Mixture(seed, lags, stack, goes_back=ends and seed % 2 == 0)
        memory = Memory()
        error = ""
        try:
            until = mixture.condition() if ends else None
            graph = mixture.graph(native=native, threads=threads)
            way(graph, Clock(STEPS * H, H, block), memory, until=until)
        except GraphError:  # components that cannot go back, or no initial values
            return None
        except CosimError as raised:
            error = str(raised)
        rows = [memory.rows(name).tobytes() for name in mixture.components]
        said = []
        if not memory.reason or memory.reason.startswith("until"):
            said = [(m.time, m.level, m.text) for fmu in mixture.fmus for m in fmu.drain()]
        return error, memory.status, memory.reason, rows, said


def check_outcome(lags, seed):
    """Check it in Python and compiled, in blocks of any length, in two threads, and by hand."""
    expected = outcome(seed, lags, native=False, block=1)
    assume(expected is not None)
    for block in BLOCKS:
        assert outcome(seed, lags, block=block) == expected
    assert outcome(seed, lags, native=False, block=None) == expected
    assert outcome(seed, lags, way=by_hand) == expected
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Branches, "_chooses_two", lambda self: True)
        assert outcome(seed, lags, threads=2, block=7) == expected


@pytest.mark.slow
@settings(deadline=None, max_examples=5)
@given(st.integers(0, 10**6))
def test_mixed_graphs_have_one_outcome(lags, seed):
    check_outcome(lags, seed)


@pytest.mark.campaign
@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_many_mixed_graphs_have_one_outcome(lags, seed):
    check_outcome(lags, seed)


@pytest.mark.slow
@settings(deadline=None, max_examples=12)
@given(st.integers(0, 10**6))
def test_a_condition_ends_mixed_graphs_alike(lags, seed):
    """At one row, in whatever way; no FMU has said anything of what is behind it."""
    expected = outcome(seed, lags, native=False, block=1, ends=True)
    assume(expected is not None)
    for block in BLOCKS:
        assert outcome(seed, lags, block=block, ends=True) == expected
    assert outcome(seed, lags, native=False, block=None, ends=True) == expected
    assert outcome(seed, lags, way=by_hand, ends=True) == expected
