"""Elements of an input are connected one by one, and are driven as in a stack of the sources."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.blocks.dynamics import Delay, lag
from cosim.blocks.source import constant, sine, step
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import GraphError
from tests.core.parts import integrator

STEPS = 20


class Sink:
    """A component with the given inputs, which it adds up."""

    def __init__(self, *inputs):
        self.interface = Interface(
            inputs, (Signal("y"),), {"y": [signal.name for signal in inputs]}
        )

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([u.sum()])

    def advance(self, t, h, u):
        return u[1:].sum(axis=1, keepdims=True)


def sources():
    return {
        "smooth": sine(amplitude=1.0, rate=20.0, phase=0.1, unit="m"),
        "jump": step(time=0.035, before=0.0, after=2.0, unit="m"),
        "delayed": Delay(2, initial=np.array([0.5]), unit="m"),
        "three": Linear(lag(time_constant=0.05, size=3, unit="m")),
        "fixed": constant([1.0, 2.0, 3.0], unit="m"),
    }


SOURCES = {"delayed.u": "smooth.y", "three.u": "fixed.y"}


def recorded(sink, connections, components=None, **options):
    """Run a graph; return it and all that was recorded, as bytes."""
    components = {**(sources() if components is None else components), "sink": sink}
    graph = Graph(components, connections, **options)
    memory = Memory()
    run(graph, Clock(STEPS * 0.005, 0.005), memory)
    values = {f"sink.{s.name}": memory[f"sink.{s.name}"] for s in sink.interface.signals}
    return graph, {name: array.tobytes() for name, array in values.items()}


def system(size):
    """Return an integrator of ``size`` inputs: its result depends on which of them are held."""
    K = np.arange(1.0, size + 1.0)[np.newaxis]
    A, B = np.zeros((1, 1)), K
    C, D = np.eye(1), np.zeros((1, size))
    return Linear(controller(A=A, B=B, C=C, D=D, x0=np.zeros(1)))


@pytest.mark.parametrize("interpolation", ["linear", "zero-order"])
def test_elements_are_driven_as_in_a_stack(interpolation):
    """Interpolated and held element by element, whatever the interpolation of the graph."""
    stack = {**SOURCES, "sink.u": ["smooth.y", "jump.y", "three.y[1:3]", "delayed.y"]}
    parts = {
        **SOURCES,
        "sink.u[2:4]": "three.y[1:3]",
        "sink.u[4]": "delayed.y",
        "sink.u[0]": "smooth.y",
        "sink.u[1:2]": "jump.y",
    }
    stacked, expected = recorded(system(5), stack, input_interpolation=interpolation)
    graph, found = recorded(system(5), parts, input_interpolation=interpolation)
    assert found == expected
    assert graph.held["sink"].tolist() == stacked.held["sink"].tolist()
    held = [False, True, False, False, False] if interpolation == "linear" else [True] * 5
    assert graph.held["sink"].tolist() == held


def test_every_element_has_its_own_gain_offset_and_unit():
    """y = gain u + offset in the unit reached, converted to that of the input: 2.5 km and 1 cm."""
    sink = Sink(Signal("u", 3, "m"))
    connections = {
        "sink.u[0]": Connection("fixed.y[0]", gain=2.0, offset=0.5, unit="km"),
        "sink.u[1]": Connection("fixed.y[1]", gain=[[0.5]], unit="cm"),
        "sink.u[2]": "fixed.y[2]",
    }
    graph, found = recorded(sink, {**SOURCES, **connections})
    assert np.frombuffer(found["sink.u"])[:3].tolist() == [2500.0, 0.01, 3.0]
    assert {str(port) for port in graph.conversions} == {"sink.u[0]", "sink.u[1]"}


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_loops_are_ordered_as_with_a_stack(coupling):
    """Two integrators in a ring through one element each; the other comes from outside."""

    def ring(connections):
        one, two = system(2), system(2)
        components = {**sources(), "one": one, "two": two}
        every = {**SOURCES, **connections}
        graph, found = recorded(Sink(Signal("u", 2)), every, components, coupling=coupling)
        return [stage.description for stage in graph.stages], found, graph.held["one"].tolist()

    both = {"sink.u": ["one.y", "two.y"]}
    stack = {"one.u": ["two.y", "jump.y"], "two.u": ["smooth.y", "one.y"]}
    parts = {
        "one.u[0]": "two.y",
        "one.u[1]": "jump.y",
        "two.u[1]": "one.y",
        "two.u[0]": "smooth.y",
    }
    assert ring({**both, **parts}) == ring({**both, **stack})


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_partition_of_an_input_equals_the_stack(data):
    """Of its elements and slices, connected in any order."""
    size = data.draw(st.integers(1, 7))
    cuts = data.draw(st.sets(st.integers(1, size - 1))) if size > 1 else set()
    starts = [0, *sorted(cuts)]
    gain = data.draw(st.sampled_from([1.0, -0.3]))
    offset = data.draw(st.sampled_from([0.0, 0.7]))
    components = {
        "smooth": sine(amplitude=1.0, rate=20.0, phase=0.1),
        "jump": step(time=0.035, before=0.0, after=2.0),
        "wide": constant(np.arange(7.0)),
    }
    stack, parts = [], {}
    for start, stop in zip(starts, [*starts[1:], size], strict=True):
        choices = [f"wide.y[{start}:{stop}]"]
        if stop == start + 1:
            choices += ["smooth.y", "jump.y", f"wide.y[{start}]"]
        source = data.draw(st.sampled_from(choices))
        to = f"sink.u[{start}:{stop}]"
        if stop == start + 1 and data.draw(st.booleans()):
            to = f"sink.u[{start}]"
        stack.append(source)
        parts[to] = Connection(source, gain, offset)
    shuffled = dict(data.draw(st.permutations(list(parts.items()))))
    stacked = {"sink.u": Connection(stack, gain, offset)}
    graph, expected = recorded(system(size), stacked, components)
    parted, found = recorded(system(size), shuffled, components)
    assert found == expected
    assert parted.held["sink"].tolist() == graph.held["sink"].tolist()
    assert parted.sources_of(Port("sink", "u")) == graph.sources_of(Port("sink", "u"))


@pytest.mark.parametrize(
    ("connections", "text"),
    [
        (
            {"sink.u[0:2]": "fixed.y[0:2]", "sink.u[1:3]": "fixed.y[1:3]"},
            "'sink.u[1:3]' overlaps 'sink.u[0:2]': an element has one source (add signals with a "
            "'sum'); connect 'sink.u' as a whole, or each element once",
        ),
        (
            {"sink.u": "fixed.y", "sink.u[1]": "smooth.y"},
            "'sink.u[1]' overlaps 'sink.u': an element has one source (add signals with a "
            "'sum'); connect 'sink.u' as a whole, or each element once",
        ),
        (
            {"sink.u[1]": "smooth.y", "sink.u[1:2]": "smooth.y", "sink.u[0]": "smooth.y"},
            "'sink.u[1:2]' overlaps 'sink.u[1]': an element has one source (add signals with a "
            "'sum'); connect 'sink.u' as a whole, or each element once\n"
            "'sink.u[2]' is not connected; give it a source in [connections]; 'sink.u' has 3 "
            "elements, numbered from 0",
        ),
        (
            {"sink.u[2]": "smooth.y"},
            "'sink.u[0:2]' are not connected; give them a source in [connections]; 'sink.u' has 3 "
            "elements, numbered from 0",
        ),
        (
            {"sink.u[1]": "smooth.y"},
            "'sink.u[0]', 'sink.u[2]' are not connected; give them a source in [connections]; "
            "'sink.u' has 3 elements, numbered from 0",
        ),
        (
            {"sink.u[1]": "smooth.y", "sink.u[01]": "smooth.y"},
            "'sink.u[1]' is given twice; an input has one source (add signals with a 'sum')",
        ),
        (
            {"sink.u[2:4]": "fixed.y[0:2]"},
            "'sink.u[2:4]': 'sink.u' has 3 elements, numbered from 0",
        ),
        (
            {"sink.u[0]": "fixed.y", "sink.u[1:3]": "smooth.y"},
            "fixed.y -> sink.u[0]: size 3 [m] cannot drive size 1 [m]\n"
            "smooth.y -> sink.u[1:3]: size 1 [m] cannot drive size 2 [m]",
        ),
        (
            {"sink.u[0:2]": Connection("fixed.y", np.eye(3)), "sink.u[2]": "smooth.y"},
            "fixed.y -> sink.u[0:2]: gain: expected shape (2, 3), got (3, 3)",
        ),
        (
            {"sink.w[0]": "fixed.y", "sink.u": "fixed.y"},
            "'sink.w[0]': 'sink' has no input 'w'; available: u",
        ),
        (
            {"sink.y[0]": "fixed.y", "sink.u": "fixed.y"},
            "'sink.y[0]': expected an input of 'sink', got an output; available: u",
        ),
    ],
)
def test_every_element_is_driven_exactly_once(connections, text):
    """One error names the elements that are driven twice, never, or that are not there."""
    components = {**sources(), "sink": Sink(Signal("u", 3, "m"))}
    with pytest.raises(GraphError, match=f"^{re.escape(text)}$"):
        Graph(components, {**SOURCES, **connections})


@pytest.mark.parametrize(
    ("start", "driven", "undriven"),
    [
        ((4.0, 5.0, 6.0, 7.0), "sink.u[1]", {"sink.u[0]": (4.0,), "sink.u[2:4]": (6.0, 7.0)}),
        ((4.0, 5.0, 6.0, 7.0), "sink.u[0]", {"sink.u[1:4]": (5.0, 6.0, 7.0)}),
        ((), "sink.u[3]", {"sink.u[0:3]": (0.0, 0.0, 0.0)}),
    ],
)
def test_elements_that_nothing_drives_keep_their_start_values(start, driven, undriven):
    """Where the input may stay without a connection."""
    sink = Sink(Signal("u", 4, start=start, connection="optional"))
    graph, found = recorded(sink, {**SOURCES, driven: "smooth.y"})
    assert {str(port): values for port, values in graph.unconnected.items()} == undriven
    u = np.frombuffer(found["sink.u"]).reshape(STEPS + 1, 4)
    i = Port.parse(driven).element
    kept = np.delete(np.array(start or [0.0] * 4), i)
    assert (np.delete(u, i, axis=1) == kept).all()
    assert len(set(u[:, i])) > 1


def test_an_input_with_a_start_value_of_its_own_is_not_connected_in_part():
    """Which of its elements have it is not known, so none is overwritten."""
    sink = Sink(Signal("u", 2, start=(1.0, 2.0), connection="forbidden"))
    with pytest.raises(GraphError, match=r"'sink\.u' is connected in part and has.*start value"):
        Graph({"a": constant([1.0]), "sink": sink}, {"sink.u[0]": "a.y"})


def test_a_name_of_its_own_comes_before_the_element():
    """u[1] is an input itself; the element beside it is u[1:2]."""
    sink = Sink(Signal("u", 2), Signal("u[1]"))
    connections = {
        "sink.u[0]": "fixed.y[0]",
        "sink.u[1:2]": "fixed.y[1]",
        "sink.u[1]": "fixed.y[2]",
    }
    graph, found = recorded(sink, {**SOURCES, **connections})
    assert np.frombuffer(found["sink.u"])[:2].tolist() == [1.0, 2.0]
    assert np.frombuffer(found["sink.u[1]"])[0] == 3.0
    assert Port("sink", "u[1]") in graph.connections


def test_a_matrix_mixes_only_what_drives_the_same_elements():
    """So a jump beside a matrix stays a jump, and nothing is said of it."""
    sum_of_two = Connection(["smooth.y", "three.y[0]"], [[1.0, 1.0]])
    connections = {**SOURCES, "sink.u[0]": sum_of_two, "sink.u[1]": "jump.y"}
    graph, _ = recorded(system(2), connections)
    assert graph.held["sink"].tolist() == [False, True]
    assert graph.warnings == []


def test_a_loop_through_one_element_is_initialized():
    """x is 0.5 at first; u = [x, 2 x] of two connections from the same output."""
    components = {"x": integrator(start=0.5)}
    twice = Connection("x.y", 2.0)
    connections = {"x.u": "sink.y", "sink.u[1]": twice, "sink.u[0]": "x.y"}
    _, found = recorded(Sink(Signal("u", 2)), connections, components)
    assert np.frombuffer(found["sink.u"])[:2].tolist() == [0.5, 1.0]
