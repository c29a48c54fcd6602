"""What does not fit together is refused before the first step, everything at once."""

import numpy as np
import pytest

from cosim.blocks import dynamics
from cosim.blocks.arithmetic import gain, sum_of
from cosim.blocks.dynamics import Delay, lag
from cosim.blocks.source import Expression, Noise, Table, constant, sine, step
from cosim.blocks.transfer import transfer_function
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import AlgebraicLoopError, GraphError
from cosim.units import BaseUnit, Conversion
from tests.core.parts import Scripted, integrator, through, times


def graph(connections, **options):
    components = {
        "u": constant([1.0, 2.0, 3.0], unit="m"),
        "one": constant([4.0]),
        "lag": Linear(lag(time_constant=1.0, size=3, unit="m")),
        "small": Linear(lag(time_constant=1.0, unit="s")),
    }
    return Graph(components, {"lag.u": "u.y", "small.u": "one.y", **connections}, **options)


@pytest.mark.parametrize(
    ("connections", "text"),
    [
        (
            {"lab.u": "u.y"},
            "'lab.u': there is no component 'lab'",
        ),
        ({"lag.u": "v.y"}, "'v.y': there is no component 'v'"),
        ({"lag.yy": "u.y"}, "'lag.yy': 'lag' has no input 'yy'"),
        (
            {"lag.u": "small.yy"},
            "'small.yy': 'small' has no output 'yy'",
        ),
        ({"u.x": "one.y"}, "'u.x': 'u' has no input 'x'"),
        ({"lag": "u.y"}, "port COMPONENT.SIGNAL, such as plant.y, got 'lag'"),
        ({"lag.u": "one.y"}, "one.y -> lag.u: size 1 cannot drive size 3 [m]"),
        (
            {"small.u": "u.y[-1]"},
            "'u.y[-1]': 'u' has no output 'y[-1]'",
        ),
        ({"small.u": "u.y[3]"}, "'u.y[3]': 'u.y' has 3 elements, numbered from 0"),
        (
            {"small.u": "u.y[1]"},
            "u.y[1] -> small.u: unit 'm' cannot drive unit 's'; convert with { from = "
            "'u.y[1]', gain = ..., unit = 's' }",
        ),
        (
            {"lag.u": Connection("u.y", unit="mm")},
            "u.y -> lag.u: the source has unit 'm'",
        ),
        (
            {"lag.u": Connection("u.y", ((1.0, 2.0, 3.0),))},
            "u.y -> lag.u: gain: expected shape (3, 3), got (1, 3)",
        ),
        (
            {"small.u": Connection("u.y", ((1.0,),), unit="s")},
            "u.y -> small.u: gain: expected shape (1, 3), got (1, 1)",
        ),
    ],
)
def test_a_connection_that_does_not_fit_is_refused(connections, text):
    """With both ends, what was found and what was needed, and the nearest name."""
    with pytest.raises(GraphError) as error:
        graph(connections)
    assert text in str(error.value)


def test_several_problems_are_reported_together():
    """One line each."""
    with pytest.raises(GraphError) as error:
        Graph(
            {"a": integrator(), "b": integrator(), "c": constant([1.0, 2.0])},
            {"a.u": "c.y", "b.v": "c.y", "x.u": "c.y"},
        )
    lines = str(error.value).splitlines()
    assert len(lines) == 4
    assert lines[0].startswith("c.y -> a.u: size 2 cannot drive size 1")
    assert lines[3] == "'b.u' is not connected; give it a source in [connections]"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"coupling": "newtonian"},
            "coupling: got 'newtonian'; did you mean 'newton'? Available: gauss-seidel, jacobi,",
        ),
        (
            {"coupling": "gauss-seidl"},
            "coupling: got 'gauss-seidl'",
        ),
        (
            {"input_interpolation": "liner"},
            "input_interpolation: got 'liner'",
        ),
        ({"periods": {"lab": 2}}, "periods: there is no component 'lab'; did you mean 'lag'?"),
        ({"periods": {"lag": 0}}, "periods: expected at least 1 step for 'lag', got 0"),
    ],
)
def test_an_option_that_is_none_is_refused(options, text):
    """With the names there are."""
    with pytest.raises(GraphError) as error:
        graph({}, **options)
    assert text in str(error.value)


def test_names_and_numbers_are_checked():
    """No components, a dot in a name, a signal of no size, one declared twice."""
    with pytest.raises(GraphError, match=r"the graph has no components.*at least one"):
        Graph({}, {})
    with pytest.raises(
        GraphError,
        match=r"component 'a\.b': .*without dots as its name",
    ):
        Graph({"a.b": constant([1.0])}, {})
    with pytest.raises(GraphError, match="component '': expected a non-empty string without dots"):
        Graph({"": constant([1.0])}, {})
    with pytest.raises(GraphError, match=r"signal 'y': size: .*at least 1, got 0"):
        Signal("y", 0)
    with pytest.raises(GraphError, match="signal 'y' is declared twice in one interface"):
        Interface((Signal("y"),), (Signal("y"),))


def test_an_optional_output_drives_only_what_takes_no_value():
    """NaN means "no value yet" and must not reach an input that needs one."""
    with pytest.raises(
        GraphError,
        match=r"a\.y -> b\.u: the source may.*NaN; the input.*value at every step",
    ):
        Graph({"a": Scripted([0.0], optional=True), "b": integrator()}, {"b.u": "a.y"})


def test_elements_gains_offsets_and_matrices_reach_the_input():
    """`x[1]` is one element; a gain and an offset act on each; a matrix maps.

    A signal whose name looks like an element is found by that name.
    """
    odd = Interface((), (Signal("x[1]"), Signal("x", 2)), {})
    memory = Memory()
    components = {
        "c": constant([1.0, 2.0, 4.0]),
        "odd": Scripted([0.0] * 9),
        "a": Delay(1),
        "b": Delay(1),
        "m": Delay(1, size=2),
    }
    components["odd"].interface = odd
    components["odd"].outputs = lambda t, u: np.array([7.0, 8.0, 9.0])
    components["odd"].advance = lambda t, h, u: np.tile([7.0, 8.0, 9.0], (len(t) - 1, 1))
    components["n"] = Delay(1)
    connections = {
        "a.u": Connection("c.y[2]", 3.0, 0.5),
        "b.u": "odd.x[1]",
        "n.u": "odd.x[0]",
        "m.u": Connection("c.y", ((1.0, 0.0, -1.0), (0.0, 2.0, 0.25)), 10.0),
    }
    run(Graph(components, connections), Clock(0.002, 1e-3), memory)
    assert (memory["a.u"] == 12.5).all()
    assert (memory["b.u"] == 7.0).all()
    assert (memory["n.u"] == 8.0).all()
    assert (memory["m.u"] == [7.0, 15.0]).all()


def conversions_of(components, connections):
    """Return the one conversion of all elements of each connection that converts."""
    alike = {}
    for to, by_element in Graph(components, connections).conversions.items():
        (alike[str(to)],) = set(by_element)
    return alike


def converted(connection, source, target):
    """Return what arrives at the input of 2.5 and -40 at an output, both by unit."""
    sink = Delay(1, size=2)
    sink.interface = Interface((Signal("u", 2, target),), sink.interface.outputs)
    components = {"c": constant([2.5, -40.0], unit=source), "d": sink}
    row = np.zeros(6)
    Graph(components, {"d.u": connection}).initialize(0.0, row)
    return row[2:4].tolist(), conversions_of(components, {"d.u": connection})


def stacked(sources, units, target="m", **options):
    """Return what arrives at an input of size 3 from outputs of two constants."""
    components = {
        "a": constant([1.0, 2.0, 3.0], unit=units[0]),
        "b": constant([10.0], unit=units[1]),
        "d": Delay(1, size=3),
    }
    components["d"].interface = Interface(
        (Signal("u", 3, target),), components["d"].interface.outputs
    )
    graph = Graph(components, {"d.u": Connection(sources, **options)})
    row = np.zeros(graph.layout.width)
    graph.initialize(0.0, row)
    return row[graph.layout["d"].inputs].tolist()


def test_a_connection_selects_and_stacks():
    """Elements, slices and several sources, each converted from its own unit."""
    assert stacked("a.y", ("m", "m")) == [1.0, 2.0, 3.0]
    assert stacked(["a.y[1:3]", "b.y"], ("m", "m")) == [2.0, 3.0, 10.0]
    assert stacked(["b.y", "a.y[2]", "a.y[0]"], ("m", "mm")) == [0.01, 3.0, 1.0]
    assert stacked(["b.y", "a.y[0:2]"], ("m", "m"), gain=2.0, offset=1.0) == [21.0, 3.0, 5.0]
    matrix = [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]
    assert stacked(["a.y[0:2]", "b.y"], ("m", "m"), gain=matrix) == [11.0, 2.0, 20.0]


@pytest.mark.parametrize(
    ("sources", "options", "text"),
    [
        (["a.y", "b.y"], {}, r"a\.y, b\.y -> d\.u: size 4 \[m\] cannot drive size 3 \[m\]"),
        (["a.y[1:4]"], {}, r"'a\.y\[1:4\]': 'a\.y' has 3 elements, numbered from 0"),
        ([], {}, r"a connection has no source.*at least one"),
        (
            ["a.y[0:2]", "b.y"],
            {"gain": np.ones((3, 3))},
            r"a\.y\[0:2\], b\.y -> d\.u: a gain cannot mix the units 'm', 'mm'.*unit.*unit",
        ),
    ],
)
def test_a_stack_that_does_not_fit_is_refused(sources, options, text):
    """With all its sources, and what was needed."""
    with pytest.raises(GraphError, match=text):
        stacked(sources, ("m", "mm"), **options)


def test_each_element_is_converted_from_its_own_unit():
    """To its own unit, through slices, gains and rows of a matrix: 2 m is 2000 mm, 1 m/s 3.6 km/h.

    A matrix mixes only what its row takes.
    """
    units = (("m", "m/s", "m"), "mm")
    assert stacked("a.y", units, target=("mm", "km/h", "m")) == pytest.approx([1000.0, 7.2, 3.0])
    assert stacked(["a.y[1:3]", "b.y"], units, target=("km/h", "mm", "m")) == pytest.approx(
        [7.2, 3000.0, 0.01]
    )
    assert stacked("a.y", units, target=("mm", "km/h", "m"), gain=2.0) == pytest.approx(
        [2000.0, 14.4, 6.0]
    )
    rows = [[1.0, 0.0, 1.0], [0.0, 5.0, 0.0], [0.0, 0.0, 0.0]]
    rows[2][0] = -1.0
    assert stacked("a.y", units, target=("mm", "km/h", "m"), gain=rows) == pytest.approx(
        [4000.0, 36.0, -1.0]
    )
    named = {"gain": 2.0, "unit": ["N", "m/s", "kN"]}
    assert stacked("a.y", units, target=("kN", "m/s", "N"), **named) == pytest.approx(
        [0.002, 4.0, 6000.0]
    )
    with pytest.raises(GraphError, match=r"a\.y -> d\.u: unit 'm/s' cannot drive unit 'm'"):
        stacked("a.y", units, target=("m", "m", "m"))
    with pytest.raises(GraphError, match=r"unit: expected one for each of 3 elements, got 2"):
        stacked("a.y", units, target=None, gain=2.0, unit=["N", "m"])
    rows[0][1] = 1.0
    with pytest.raises(GraphError, match=r"unit 'm/s' cannot drive unit 'mm'"):
        stacked("a.y", units, target=("mm", "km/h", "m"), gain=rows)


def test_a_stack_holds_the_elements_that_are_discrete():
    """Each element of a stacked input is interpolated as its own source is."""
    components = {
        "s": sine(rate=1.0),
        "n": Noise(deviation=0.1, seed=1),
        "d": Delay(1, size=2),
    }
    graph = Graph(components, {"d.u": ["s.y", "n.y"]})
    assert graph.held["d"].tolist() == [False, True]


def test_values_are_converted_between_units():
    """By the formula, after gain and offset; what has one unit is copied bit for bit."""
    celsius = Conversion(1.0, 273.15, 0.0, 1.0)
    assert converted("c.y", "degC", "K") == ([275.65, -40.0 + 273.15], {"d.u": celsius})
    assert converted("c.y", "mm", "m") == (
        [2.5 * 1e-3, -40.0 * 1e-3],
        {"d.u": Conversion(1e-3, 0.0, 0.0, 1.0)},
    )
    assert converted("c.y", "m", "mm") == (
        [2.5 / 1e-3, -40.0 / 1e-3],
        {"d.u": Conversion(1.0, 0.0, 0.0, 1e-3)},
    )
    assert (
        converted("c.y", "m", "m")
        == converted("c.y", None, "m")
        == converted("c.y", "furlong", "furlong")
        == ([2.5, -40.0], {})
    )
    assert converted(Connection("c.y", 2.0, 1.0), "degC", "K") == (
        [6.0 + 273.15, -79.0 + 273.15],
        {"d.u": celsius},
    )
    assert converted(Connection("c.y", 2.0, 1.0, unit="degC"), "V", "K") == (
        [6.0 + 273.15, -79.0 + 273.15],
        {"d.u": celsius},
    )
    assert converted(Connection("c.y", 2.0, unit="K"), "V", "K") == ([5.0, -80.0], {})
    assert converted(Connection("c.y", unit="degC"), None, "K") == (
        [275.65, -40.0 + 273.15],
        {"d.u": celsius},
    )


def test_a_definition_tells_what_a_name_does_not():
    """Also for the unit that a connection names: it is that of the port with this name."""
    feet = constant([3.0], unit="furlong")
    sink = Delay(1)
    sink.interface = Interface((Signal("u", 1, "m"),), sink.interface.outputs)
    with pytest.raises(GraphError, match=r"'furlong' is not known.*to 'm'.*unit = \"as is\""):
        Graph({"c": feet, "d": sink}, {"d.u": "c.y"})
    as_is = Connection("c.y", unit="as is")
    assert conversions_of({"c": feet, "d": sink}, {"d.u": as_is}) == {}
    with pytest.raises(GraphError, match="unit = 'rod': 'rod' is not known"):
        Graph({"c": feet, "d": sink}, {"d.u": Connection("c.y", 2.0, unit="rod")})
    feet.interface = Interface(
        (), (Signal("y", 1, "furlong", base=BaseUnit((0, 1, 0, 0, 0, 0, 0, 0), 0.3048)),)
    )
    assert conversions_of({"c": feet, "d": sink}, {"d.u": "c.y"}) == {
        "d.u": Conversion(0.3048, 0.0, 0.0, 1.0)
    }
    named = Connection("c.y", 2.0, unit="furlong")
    assert conversions_of({"c": feet, "d": sink}, {"d.u": named}) == {
        "d.u": Conversion(0.3048, 0.0, 0.0, 1.0)
    }
    sink.interface = Interface((Signal("u", 1, "s"),), sink.interface.outputs)
    with pytest.raises(GraphError, match=r"unit 'furlong' \(m\) cannot drive unit 's'"):
        Graph({"c": feet, "d": sink}, {"d.u": "c.y"})


def algebraic(components, connections):
    """Return the only warning of a graph, the ports of its loop, and what becomes of it."""
    ((name, text),) = Graph(components, connections).warnings
    cycle, _, rest = text.partition(": ")
    return name, cycle.split(" -> "), rest


def test_an_algebraic_loop_is_reported_with_every_port():
    """The ports stand in the order of the signal flow, and the last is the first again.

    A connection of a component to itself is an algebraic loop too.
    """
    name, ports, rest = algebraic(
        {"r": constant([1.0]), "s": sum_of([1.0, -1.0]), "k": times(2.0), "p": through()},
        {"s.u1": "r.y", "s.u2": "p.y", "k.u": "s.y", "p.u": "k.y"},
    )
    assert rest == (
        "every output here feeds through; this algebraic loop is not solved within a step, but "
        "with a value of the step before (first order); coupling = 'newton' solves it"
    )
    assert ports[0] == ports[-1]
    assert ports[0].startswith(f"{name}.")
    assert set(ports) == {"s.u2", "s.y", "k.u", "k.y", "p.u", "p.y"}
    order = ["s.u2", "s.y", "k.u", "k.y", "p.u", "p.y"]
    start = order.index(ports[0])
    assert ports[:-1] == order[start:] + order[:start]
    _, ports, _ = algebraic({"p": through(0.5)}, {"p.u": "p.y"})
    assert sorted(ports[:-1]) == ["p.u", "p.y"]


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
def test_a_discrete_signal_in_an_algebraic_loop_is_refused(coupling):
    """No value between two others solves it, and that of the step before is another one."""
    relay = Scripted([])
    relay.interface = Interface(
        (Signal("u"),), (Signal("y", variability="discrete"),), {"y": ("u",)}
    )
    expected = r"relay\.y.*'relay\.y' is discrete, so that it"
    with pytest.raises(AlgebraicLoopError, match=expected):
        Graph(
            {"relay": relay, "p": through()},
            {"relay.u": "p.y", "p.u": "relay.y"},
            coupling=coupling,
        )


def unknown(D):
    """Return a component with a state and ``y = x + D u`` that does not say what feeds through."""
    component = through(D)
    inputs = component.interface.inputs
    outputs = component.interface.outputs
    component.interface = Interface(inputs, outputs, {o.name: None for o in outputs})
    return component


def test_a_loop_through_feedthrough_that_is_unknown_is_a_warning():
    """With the reason; where the cycle is not closed that way, or is known, there is none."""
    loop = {"a.u": "k.y", "k.u": "a.y"}
    found = Graph({"a": unknown(0.0), "k": times(1.0)}, loop)
    text = (
        "a.y may depend directly on a.u (the FMU does not say): taken as not feeding through; "
        "if it does, the loop is solved "
        "with the value of the step before"
    )
    assert found.warnings == [("a", text)]
    assert Graph({"a": through(0.0), "k": times(1.0)}, loop).warnings == []
    assert Graph({"a": unknown(0.0), "k": integrator()}, loop).warnings == []
    assert Graph({"a": unknown(0.0), "k": constant([1.0])}, {"a.u": "k.y"}).warnings == []
    twice = Graph({"a": unknown(0.0), "b": unknown(0.0)}, {"a.u": "b.y", "b.u": "a.y"})
    assert [name for name, _ in twice.warnings] in (["a"], ["b"])


def test_a_known_cycle_beside_an_unknown_one_is_reported():
    """What is unknown elsewhere excuses nothing."""
    connections = {"s.u1": "k.y", "s.u2": "a.y", "k.u": "s.y", "a.u": "s.y"}
    components = {"a": unknown(0.0), "s": sum_of([1.0, 1.0]), "k": times(0.5)}
    texts = [text for _, text in Graph(components, connections).warnings]
    assert len(texts) == 2
    assert "a.y may depend directly on a.u" in texts[0]
    assert "this algebraic loop is not solved within a step" in texts[1]


def test_a_lag_that_chases_its_own_tail_is_refused():
    """Before anything is recorded."""
    looped = Graph(
        {"lag": Linear(lag(time_constant=1.0))}, {"lag.u": Connection("lag.y", 1.0, 1.0)}
    )
    memory = Memory()
    with pytest.raises(GraphError, match=r"no initial values for lag\.u -> lag\.y -> lag\.u"):
        run(looped, Clock(1.0, 0.1), memory)
    assert len(memory["lag.y"]) == 0


def test_zero_order_holds_follow_variability():
    """Discrete outputs are held, continuous ones interpolated; others inherit from their inputs.

    With ``input_interpolation = "zero-order"`` all inputs are held.
    """
    components = {
        "line": sine(amplitude=1.0, rate=1.0, phase=0.0, offset=0.0),
        "noise": Noise(deviation=1.0, seed=1),
        "table": Table(np.array([0.0, 9.0]), np.ones((2, 1)), hold=True),
        "both": sum_of([1.0, 1.0]),
        "discrete": sum_of([1.0, 1.0]),
        "delayed": Delay(2),
        "sink": gain(np.eye(3)),
        "last": gain(np.ones((1, 4))),
    }
    connections = {
        "both.u1": "line.y",
        "both.u2": "noise.y",
        "discrete.u1": "table.y",
        "discrete.u2": "noise.y",
        "delayed.u": "discrete.y",
        "sink.u": Connection("discrete.y", ((1.0,), (1.0,), (1.0,))),
        "last.u": Connection("both.y", ((1.0,),) * 4),
    }
    held = {
        name: mask.tolist()
        for name, mask in Graph(components, connections).prepare(10**6).held.items()
    }
    assert held == {
        "line": [],
        "noise": [],
        "table": [],
        "both": [False, True],
        "discrete": [True, True],
        "delayed": [True],
        "sink": [True] * 3,
        "last": [False] * 4,
    }
    assert all(
        mask.all()
        for mask in Graph(components, connections, input_interpolation="zero-order")
        .prepare(10**6)
        .held.values()
    )


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_a_stack_extrapolates_only_what_comes_from_its_loop(coupling):
    """Elements from outside a loop are interpolated, beside one that is extrapolated."""
    components = {
        "s": sine(rate=1.0),
        "sum": sum_of([1.0, 1.0], size=2),
        "d": gain(np.array([[0.5, 0.5]])),
        "lag": Linear(lag(time_constant=1.0)),
        "one": constant([1.0, 1.0]),
    }
    connections = {
        "sum.u1": ["lag.y", "s.y"],
        "sum.u2": "one.y",
        "d.u": "sum.y",
        "lag.u": "d.y",
    }
    graph = Graph(components, connections, coupling=coupling)
    expected = [coupling == "jacobi", False, False, False]
    assert graph.held["sum"].tolist() == expected
    assert graph.held["lag"].tolist() == [True]


def jumping():
    """Return a graph whose sum adds a step to a sine, or to a constant."""
    components = {
        "step": step(time=0.5),
        "line": sine(rate=1.0),
        "one": constant([1.0]),
        "sum": sum_of([1.0, 1.0]),
        "lag": Linear(lag(time_constant=1.0, initial=0.0)),
    }
    return components, {"sum.u1": "step.y", "lag.u": "sum.y"}


def test_a_constant_does_not_make_a_held_sum_continuous():
    """A step plus a constant is a step: x' + x = 1 + step(t - 0.5), exactly at every point."""
    components, connections = jumping()
    del components["line"]
    graph = Graph(components, {**connections, "sum.u2": "one.y"})
    assert graph.held["lag"].tolist() == [True]
    assert graph.warnings == []
    memory = Memory()
    run(graph, Clock(1.0, 0.25), memory)
    t = memory.time("lag")
    exact = (1.0 - np.exp(-t)) + np.where(t > 0.5, 1.0 - np.exp(0.5 - t), 0.0)
    np.testing.assert_allclose(memory["lag.y"], exact, rtol=1e-14)


def test_jumps_that_are_interpolated_with_continuous_inputs_are_warned_of():
    """Between two points one value cannot hold and be interpolated."""
    components, connections = jumping()
    del components["one"]
    mixed = {**connections, "sum.u2": "line.y"}
    ((name, text),) = Graph(components, mixed).warnings
    assert name == "sum"
    assert text.startswith("step.y: interpolated linearly together with line.y, so that a jump")
    assert Graph(components, mixed, input_interpolation="zero-order").warnings == []
    del components["sum"]
    product = Connection(["step.y", "line.y"], ((1.0, 1.0),))
    ((name, _),) = Graph(components, {"lag.u": product}).warnings
    assert name == "lag"


def step_into(part, **options):
    """Return the graph of a step at 0.5 s, a part, and an integrator that follows it."""
    components = {
        "step": step(time=0.5),
        "part": part,
        "integral": Linear(dynamics.integrator()),
    }
    connections = {"part.u": "step.y", "integral.u": "part.y"}
    return Graph(components, connections, **options)


def test_a_jump_that_feeds_through_what_is_continuous_is_no_ramp():
    """(s + 2)/(s + 1) of a step at 0.5 s is 2 - e^(0.5 - t) from there on.

    The trapezoidal rule leaves h^2/12 times the change of its slope, 1 - e^-1/2, of the integral; a
    ramp over the step before would add h/2.
    """
    graph = step_into(Linear(transfer_function([1.0, 2.0], [1.0, 1.0])))
    assert graph.warnings == []
    memory = Memory()
    run(graph, Clock(1.0, 0.25), memory)
    exact = 2.0 * 0.5 - (1.0 - np.exp(-0.5))
    error = -(0.25**2) / 12.0 * (1.0 - np.exp(-0.5))
    assert memory["integral.y"][-1] - exact == pytest.approx(error, rel=0.01)
    assert step_into(Linear(transfer_function([1.0], [1.0, 1.0]))).warnings == []
    held = step_into(
        Linear(transfer_function([1.0, 2.0], [1.0, 1.0])), input_interpolation="zero-order"
    )
    assert held.warnings == []


def test_a_delay_with_an_initial_value_of_its_own_is_reported():
    """It jumps once to what arrives; of a constant that is held, of a continuous signal said."""
    components = {
        "source": constant([3.0]),
        "delay": Delay(2, initial=0.0),
        "integral": Linear(dynamics.integrator()),
    }
    connections = {"delay.u": "source.y", "integral.u": "delay.y"}
    graph = Graph(components, connections)
    assert graph.warnings == []
    memory = Memory()
    run(graph, Clock(1.0, 0.25), memory)
    assert memory["integral.y"].tolist() == [0.0, 0.0, 0.0, 0.75, 1.5]
    components["source"] = Expression(["3 + t"])
    ((name, text),) = Graph(components, connections).warnings
    assert name == "delay"
    assert text.startswith("delay.y begins with a value of its own and jumps where the first")
    components["delay"] = Delay(2)
    assert Graph(components, connections).warnings == []
