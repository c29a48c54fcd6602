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
            r"component 'p':.*an interface of type cosim\.core\.Interface.*None",
        ),
        (Delay, r"component 'p':.*the class Delay"),
        (None, r"component 'p':.*interface.*None.*None"),
        (Broken(), "component 'p': its interface raised ZeroDivisionError: mine"),
        (
            Bare(),
            r"component 'p':.*an object of type Bare.*advance, prepare, save, restore",
        ),
    ],
)
def test_only_components_are_taken(component, text):
    """With what was found, what is missing, and the way out where there is one."""
    with pytest.raises(GraphError, match=f"^{text}"):
        Graph({"p": component}, {})


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: run(None, 1, 2), UsageError, r"graph:.*a Graph.*None"),
        (lambda: run(small(), 1.0, 2), UsageError, r"clock:.*a Clock.*1\.0"),
        (
            lambda: run(small(), Clock(1.0, 0.1), Memory),
            UsageError,
            r"recorder:.*the class Memory",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), {}),
            UsageError,
            r"recorder:.*recorder.*an object of type dict.*__enter__, __exit__, begin",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), Nothing(), {}),
            UsageError,
            r"plan:.*a Plan.*an object of type dict",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), Nothing(), small().prepare(1)),
            UsageError,
            r"plan:.*graph.*clock",
        ),
        (
            lambda: run(
                small(),
                Clock(1.0, 0.1),
                Nothing(),
                Graph({"c": constant([1.0])}, {}).prepare(10**8),
            ),
            UsageError,
            r"plan:.*clock.*one for another",
        ),
        (
            lambda: run(small(), Clock(1.0, 0.1), Nothing(), small().prepare(10**8), designs={}),
            UsageError,
            r".*a plan.*designs.*both; a plan.*designs",
        ),
        (
            lambda: small().prepare(0),
            GraphError,
            r"step_ns:.*1.*0",
        ),
        (
            lambda: small().prepare(1, {"y": {}}),
            GraphError,
            "recorded: there is no component 'y'; ",
        ),
        (
            lambda: Graph({"c": constant([1.0])}, [("a", "b")]),
            GraphError,
            r"connections:.*a Mapping.*an object of type list",
        ),
        (
            lambda: Graph({"c": constant([1.0])}, {"c.u": 3}),
            GraphError,
            r".*a port such as 'plant\.y', or a list of.*source of a connection.*3",
        ),
        (
            lambda: Connection("c.y", np.array([[1j]])),
            GraphError,
            r"'c\.y':.*finite numbers or a matrix.*gain",
        ),
        (
            lambda: Connection("c.y", "2"),
            GraphError,
            r"'c\.y':.*finite numbers or a matrix.*gain.*'2'",
        ),
        (lambda: Connection("c.y", unit=3), GraphError, r"'c\.y': unit:.*a str.*3"),
        (
            lambda: Port("a", "b", -1),
            GraphError,
            r"'a\.b': .*index from 0.* got -1",
        ),
        (
            lambda: Port("a", "b", range(-2, 1)),
            GraphError,
            r"'a\.b':.*from 0.*range\(-2, 1\)",
        ),
        (
            lambda: Port("a", "b", range(0, 4, 2)),
            GraphError,
            r"'a\.b': .*index from 0.* got range\(0, 4, 2\)",
        ),
        (
            lambda: Connection("c.y", np.ma.masked_array([[1.0]], mask=True)),
            GraphError,
            r"'c\.y':.*gain",
        ),
        (lambda: Port("a", ""), GraphError, r"port:.*a component and a.*name.*''"),
        (
            lambda: nanoseconds("1e999999999"),
            ClockError,
            "'1e999999999' s is not within 1e-400 to 1e400 s",
        ),
        (lambda: Clock(True, 1e-3), ClockError, r".*seconds.*True"),
        (lambda: Clock(1.0, 0.1, 2.5), ClockError, r"block:.*steps.*1.*2\.5"),
        (lambda: Memory(5), UsageError, r"metadata:.*a Mapping.*5"),
        (lambda: Memory()["x.y"], LogError, "the run has no component 'x'; none"),
        (
            lambda: Memory()[3],
            LogError,
            r"the run:.*a signal name, or a list of names.*3",
        ),
        (lambda: Memory().time(None), LogError, r"the run:.*a component name.*None"),
    ],
)
def test_wrong_arguments_are_named(call, error, text):
    """With what was found, and what was needed."""
    with pytest.raises(error, match=f"^{text}"):
        call()
