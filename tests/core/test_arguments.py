"""The border: whatever a user hands over wrongly is an error of cosim that names it."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cosim.blocks.dynamics import Delay
from cosim.blocks.source import constant, sine
from cosim.core.clock import Clock, nanoseconds
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.master import run, simulate
from cosim.core.port import Port
from cosim.core.recorders import Memory, Nothing
from cosim.core.signals import Interface, Signal
from cosim.errors import ClockError, CosimError, GraphError, LogError, UsageError
from tests.core.parts import integrator

PLAIN = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.text(max_size=8),
    st.binary(max_size=4),
    st.sampled_from(
        [
            "plant.y",
            "x.y[0]",
            "x.u",
            "x.y",
            "x.y[9]",
            "x.y[1:0]",
            "x.y[" + "9" * 5000 + "]",
            "1e999999999",
            "1e-999999999",
            "-0",
            "sNaN",
            "Infinity",
            10**400,
            float("nan"),
            np.float32(1.5),
            np.array([1.0]),
            np.array([[1.0, 2.0]]),
            np.array([1j]),
            np.array("x"),
            np.ma.masked_array([1.0], mask=True),
            Port,
            Clock,
            Delay,
            object(),
            Port("x", "y"),
            Port("x", "y", range(2)),
            len,
            Memory(),
            Signal("u"),
            Interface(),
            slice(0, 2),
            range(2),
            ...,
        ]
    ),
)
ANYTHING = st.recursive(
    PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.tuples(inner),
        st.dictionaries(st.one_of(st.text(max_size=3), st.integers()), inner, max_size=2),
    ),
    max_leaves=4,
)


def small():
    return Graph({"u": sine(rate=1.0), "x": integrator()}, {"x.u": "u.y"})


def or_refused(function, *arguments, **options):
    """Return what a call gives, or nothing where it raises an error of cosim; no other may come."""
    with contextlib.suppress(CosimError):
        return function(*arguments, **options)
    return None


settings.register_profile("border", deadline=None, max_examples=30)
BORDER = settings(settings.get_profile("border"), suppress_health_check=[HealthCheck.too_slow])


@BORDER
@given(ANYTHING, ANYTHING, ANYTHING)
def test_ports_are_ports_or_refused(text, signal, element):
    """Nothing else comes out, and what comes out is named as it is written."""
    port = or_refused(Port.parse, text)
    assert port is None or Port.parse(str(port)) == port
    built = or_refused(Port, text, signal, element)
    assert built is None or isinstance(str(built), str)


@BORDER
@given(ANYTHING, ANYTHING, ANYTHING, ANYTHING)
def test_connections_are_finite_or_refused(source, gain, offset, unit):
    """A gain is a number or a matrix, without an imaginary part that is dropped."""
    for connection in (
        or_refused(Connection, source),
        or_refused(Connection, "x.y", gain),
        or_refused(Connection, "x.y", 2.0, offset),
        or_refused(Connection, "x.y", 2.0, 1.0, unit),
    ):
        if connection is not None:
            assert np.isfinite(connection.matrix).all()
            assert connection.matrix.dtype == np.float64
            assert connection.matrix.ndim in (0, 2)
            assert isinstance(connection.offset, float)
            assert connection.sources


@BORDER
@given(ANYTHING, ANYTHING, ANYTHING)
def test_clocks_are_grids_or_refused(stop, step, block):
    """Also numbers that would not fit into any memory."""
    or_refused(nanoseconds, stop)
    for clock in (
        or_refused(Clock, stop, step),
        or_refused(Clock, stop, 1e-3),
        or_refused(Clock, 1.0, step),
        or_refused(Clock, 1.0, 0.5, block),
    ):
        assert clock is None or (clock.step_ns > 0 and clock.steps > 0)


@BORDER
@given(ANYTHING, ANYTHING, ANYTHING)
def test_graphs_are_networks_or_refused(first, second, third):
    """Each argument by itself, then names and values inside the right ones."""
    parts = {"u": sine(rate=1.0), "x": integrator()}
    wires = {"x.u": "u.y"}
    or_refused(Graph, first, second)
    or_refused(Graph, first, wires)
    or_refused(Graph, {"x": first, "u": parts["u"]}, wires)
    or_refused(Graph, parts, first)
    or_refused(Graph, parts, {"x.u": first})
    or_refused(Graph, parts, wires, coupling=first, input_interpolation=second, periods=third)
    or_refused(Graph, parts, wires, periods=first)
    or_refused(Graph, parts, wires, periods={"x": first})
    with contextlib.suppress(TypeError):  # what cannot be a key of a mapping
        or_refused(Graph, {first: integrator()}, {})
        or_refused(Graph, parts, {first: "u.y"})
        or_refused(Graph, parts, wires, periods={first: 1})


@BORDER
@given(ANYTHING, ANYTHING)
def test_runs_are_runs_or_refused(first, second):
    """Graph, clock, recorder and plan, each by itself."""
    clock = Clock(0.01, 1e-3)
    or_refused(run, first, clock, Nothing())
    or_refused(run, small(), first, Nothing())
    if not isinstance(first, Memory):
        or_refused(run, small(), clock, first)
    or_refused(run, small(), clock, Nothing(), first)
    or_refused(lambda: list(simulate(first, second)))
    or_refused(lambda: list(simulate(small(), first)))
    or_refused(lambda: list(simulate(small(), clock, first)))
    or_refused(small().prepare, first)
    or_refused(small().prepare, 10**6, first)
    or_refused(small().prepare, 10**6, {"x": first})


@BORDER
@given(ANYTHING)
def test_memory_gives_signals_or_refuses(key):
    """Of a run, and of none yet."""
    recorded = Memory()
    run(small(), Clock(0.01, 1e-3), recorded)
    for memory in (recorded, Memory()):
        for read in (memory.__getitem__, memory.time, memory.time_ns):
            found = or_refused(read, key)
            assert found is None or isinstance(found, np.ndarray)
    or_refused(Memory, key)


class Carrier:
    """Carries a component, as an opened FMU does."""

    def __init__(self):
        self.component = integrator()


class Broken:
    """Has an interface that cannot be asked for."""

    @property
    def interface(self):
        raise ZeroDivisionError("mine")


class Bare:
    """Has an interface, and nothing else."""

    interface = Interface((), (Signal("y"),), prepares=True, rollback=True)

    def initialize(self, t, u):
        return np.zeros(1)

    def outputs(self, t, u):
        return np.zeros(1)


@pytest.mark.parametrize(
    ("component", "text"),
    [
        (
            Carrier(),
            "component 'p': found an object of type Carrier, whose interface is None; needed a "
            r"component with a cosim\.core\.Interface; it carries one: hand over its \.component",
        ),
        (Delay, "component 'p': found the class Delay; needed an object of it"),
        (None, "component 'p': found None, whose interface is None; needed a component"),
        (Broken(), "component 'p': its interface raised ZeroDivisionError: mine"),
        (
            Bare(),
            "component 'p': found an object of type Bare, which has no advance, prepare, save, "
            "restore; needed a component",
        ),
    ],
)
def test_what_is_no_component_is_refused(component, text):
    """With what was found, what is missing, and the way out where there is one."""
    with pytest.raises(GraphError, match=f"^{text}"):
        Graph({"p": component}, {})


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: run(None, 1, 2), UsageError, "graph: found None, needed a Graph"),
        (lambda: run(small(), 1.0, 2), UsageError, r"clock: found 1\.0, needed a Clock"),
        (
            lambda: run(small(), Clock(1.0, 0.1), Memory),
            UsageError,
            "recorder: found the class Memory; needed an object of it",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), {}),
            UsageError,
            "recorder: found an object of type dict, which has no __enter__, __exit__, begin,",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), Nothing(), {}),
            UsageError,
            "plan: found an object of type dict, needed a Plan",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), Nothing(), small().prepare(1)),
            UsageError,
            "plan: found one for steps of 1 ns, the clock has 100000000 ns, or for another graph",
        ),
        (
            lambda: run(
                small(),
                Clock(1.0, 0.1),
                Nothing(),
                Graph({"c": constant([1.0])}, {}).prepare(10**8),
            ),
            UsageError,
            "plan: found one for steps of 100000000 ns, the clock has 100000000 ns, or for another",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), Nothing(), small().prepare(10**8), designs={}),
            UsageError,
            "found both a plan and designs; needed one of them: a plan has designs",
        ),
        (
            lambda: small().prepare(0),
            GraphError,
            "step_ns: found 0, needed a whole number of nanoseconds, at least 1",
        ),
        (
            lambda: small().prepare(1, {"y": {}}),
            GraphError,
            "recorded: there is no component 'y'; ",
        ),
        (
            lambda: Graph({"c": constant([1.0])}, [("a", "b")]),
            GraphError,
            "connections: found an object of type list, needed a Mapping",
        ),
        (
            lambda: Graph({"c": constant([1.0])}, {"c.u": 3}),
            GraphError,
            "a connection has 3 as its source; needed a port such as 'plant.y', or a list of these",
        ),
        (
            lambda: Connection("c.y", np.array([[1j]])),
            GraphError,
            "'c.y': found gain .*; needed finite numbers or a matrix",
        ),
        (
            lambda: Connection("c.y", "2"),
            GraphError,
            "'c.y': found gain '2'; needed finite numbers or a matrix",
        ),
        (lambda: Connection("c.y", unit=3), GraphError, "'c.y': unit: found 3, needed a str"),
        (lambda: Port("a", "b", -1), GraphError, "'a.b' has no elements -1; needed a number from"),
        (
            lambda: Port("a", "b", range(-2, 1)),
            GraphError,
            r"'a.b' has no elements range\(-2, 1\); needed a number from 0",
        ),
        (lambda: Port("a", "b", range(0, 4, 2)), GraphError, "'a.b' has no elements range"),
        (
            lambda: Connection("c.y", np.ma.masked_array([[1.0]], mask=True)),
            GraphError,
            r"'c.y': found gain masked_array",
        ),
        (lambda: Port("a", ""), GraphError, "port: found '', needed the name of a component and"),
        (
            lambda: nanoseconds("1e999999999"),
            ClockError,
            "'1e999999999' s is not within 1e-400 to 1e400 s",
        ),
        (lambda: Clock(True, 1e-3), ClockError, "True is not a time in seconds"),
        (lambda: Clock(1.0, 0.1, 2.5), ClockError, r"block: found 2\.5 steps, needed at least 1"),
        (lambda: Memory(5), UsageError, "metadata: found 5, needed a Mapping"),
        (lambda: Memory()["x.y"], LogError, "the run has no component 'x'; there are none"),
        (
            lambda: Memory()[3],
            LogError,
            "the run: found 3; needed the name of a signal, or a list of names",
        ),
        (lambda: Memory().time(None), LogError, "the run: found None, needed a component's name"),
    ],
)
def test_wrong_arguments_are_named(call, error, text):
    """With what was found, and what was needed."""
    with pytest.raises(error, match=f"^{text}"):
        call()
