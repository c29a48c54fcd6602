"""A component under other port names keeps the contract; errors for wrong names list the ports."""

from collections.abc import Mapping
from dataclasses import fields

import numpy as np
import pytest

from cosim.blocks import map_ports
from cosim.blocks.replay import Replay
from cosim.blocks.source import Expression
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear, LinearModel
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import GraphError
from cosim.testing import check_component, check_rollback
from tests.blocks.renaming import CASES, INTERFACE, linear, renamed, renamings


@pytest.mark.parametrize("case", CASES)
def test_a_renamed_component_keeps_the_contract(case):
    """With rollback; the dependencies that are declared hold for the shown ports."""
    INTERFACE_WITHOUT_UNITS = CASES[case]
    check_component(lambda: renamed(INTERFACE_WITHOUT_UNITS))
    check_rollback(lambda: renamed(INTERFACE_WITHOUT_UNITS))


@pytest.mark.parametrize("case", CASES)
def test_a_component_without_a_compiled_step_has_none_under_other_names(case):
    """It may have one, as an FMU may, and has not: its methods take every step."""

    def shown():
        component = linear()
        component.native = lambda: None
        return renamed(CASES[case], component)

    assert shown().native() is None
    check_component(shown)


def test_shown_ports_have_the_bits_of_what_they_stand_for():
    """Inputs in their places, outputs put together and taken apart."""
    component = linear()
    shown = renamed(CASES["vectors"])
    u = np.array([0.1, 0.2, 0.3, 0.4])  # shown: u = (g, push), f_ = f
    names = [signal.name for signal in shown.interface.inputs]
    assert names == ["f_", "u"]
    for part in (component, shown):
        part.prepare(1e-3, np.zeros(4, np.bool_), {})
    y = component.initialize(0.0, np.array([u[3], u[0], u[1], u[2]]))
    rows = shown.initialize(0.0, u)
    columns = shown.interface.output_columns()
    assert (rows[columns["x_a"]] == y[[5, 0, 1]]).all()
    assert (rows[columns["z"]] == y[[2, 3, 0]]).all()
    assert (rows[columns["out"]] == y[2:5]).all(), "what no port covers is shown under its own name"
    assert set(columns) == {"x_a", "z", "out"}


def test_dependencies_are_shown_in_the_shown_names():
    """Feedthrough, dependencies of initial values; unknown where one part is unknown."""
    shown = renamed(CASES["vectors"]).interface
    assert shown.feedthrough == {"x_a": ("u",), "z": ("f_",), "out": ("f_",)}
    assert shown.initial == {"x_a": ("u",), "z": ("f_", "u"), "out": ("f_", "u")}
    unknown = Interface((Signal("a"),), (Signal("b"), Signal("c")), {"b": None, "c": ("a",)})
    names = renamings({"y": ["c", "b"]})
    assert map_ports(unknown, names).interface.feedthrough == {"y": None}


def test_all_names_of_an_interface_are_shown_anew():
    """Every field of it: of two ports, one has another name, and both are in what has names."""
    own = Interface(
        (Signal("a"), Signal("b")),
        (Signal("p"), Signal("q")),
        {"p": ("a", "b")},
        {"p": ("a", "b")},
        delayed=("a", "b"),
        lagging=("p", "q"),
        jumping=("p", "q"),
        left_limits=("p", "q"),
        one_value=("a", "b"),
    )
    shown = map_ports(own, renamings({"u": ["a"], "y": ["p"]})).interface
    names = {"a": "u", "b": "b", "p": "y", "q": "q"}
    for field in fields(Interface):
        expected = in_names(getattr(own, field.name), names)
        assert in_names(getattr(shown, field.name), {}) == expected, field.name
        assert isinstance(expected, bool) or expected, f"{field.name} is empty here"


def in_names(value, names):
    """Return what a field of an interface has, under other names; those of signals as a set."""
    if isinstance(value, Mapping):
        return {names.get(key, key): in_names(own, names) for key, own in value.items()}
    if isinstance(value, tuple):
        own = [entry.name if isinstance(entry, Signal) else entry for entry in value]
        return {names.get(name, name) for name in own}
    return value


def test_inputs_keep_their_initial_values_and_roles():
    """Before anything drives them."""
    shown = renamed(CASES["vectors"]).interface
    assert [signal.start for signal in shown.inputs] == [(), (0.0, 0.5)]
    assert [signal.role for signal in shown.outputs] == ["output", "output", "output"]
    assert renamed(CASES["other names"]).interface.outputs[0].role == "state"


def test_shown_elements_have_their_nominal_sizes():
    """In their order and unit; 1 where only others have one."""
    small = Signal("a", 2, unit=("mm", "m"), nominal=(10.0, 20.0))
    own = Interface((), (small, Signal("b", unit="m"), Signal("c")))
    shown = map_ports(own, renamings({"y": ["a[1]", "a[0]", "b"], "z": ["c"]})).interface
    nominal = {signal.name: signal.nominal for signal in shown.outputs}
    assert nominal == {"y": (20.0, pytest.approx(0.01), 1.0), "z": ()}


class Gauge:
    """Two lengths in and out, in m and mm; keeps what it was given."""

    interface = Interface(
        (Signal("p", unit="m"), Signal("q", unit="mm", start=(5.0,))),
        (Signal("a", unit="m"), Signal("b", unit="mm")),
        {"a": ("p",), "b": ("q",)},
    )

    def prepare(self, h, held, recorded):
        return {}

    def initialize(self, t, u):
        return u.copy()

    def outputs(self, t, u):
        return u.copy()

    def advance(self, t, h, u):
        return u[1:].copy()


def linear_gauge():
    """Return a gauge with a compiled step, and a state that nothing sees."""
    zero = np.zeros((1, 2))
    matrices = (np.zeros((1, 1)), zero, zero.T, np.eye(2), np.zeros(1), zero)
    return Linear(LinearModel(Gauge.interface, ("x",), *matrices))


def test_a_vector_of_two_units_is_converted_element_by_element():
    """To the unit of the first, or to that of the port that it replaces; 1 m is 100 cm."""
    names = {"x": ["a", "b"], "w": ["p", "q"]}
    first = renamed(names, Gauge())
    assert first.interface.inputs[0].unit == first.interface.outputs[0].unit == "m"
    assert first.outputs(0.0, np.array([2.0, 0.003])) == pytest.approx([2.0, 0.003], rel=1e-15)
    assert first.interface.inputs[0].start == pytest.approx([0.0, 0.005])
    replaced = Interface((), (Signal("x", 2, unit="cm"),))
    shown = renamed(names, Gauge(), replaced)
    assert (shown.interface.inputs[0].unit, shown.interface.outputs[0].unit) == ("m", "cm")
    y = shown.advance(np.array([0.0, 1.0]), 1.0, np.array([[0.0, 0.0], [2.0, 0.003]]))
    assert y == pytest.approx(np.array([[200.0, 0.3]]), rel=1e-15)
    ports = map_ports(Gauge.interface, renamings(names), replaced)
    assert ports.shown_inputs(np.array([2.0, 5.0])) == pytest.approx([2.0, 0.005])
    check_component(lambda: renamed(names, Gauge(), replaced))
    check_component(lambda: renamed(names, linear_gauge(), replaced))
    compiled = renamed(names, linear_gauge(), replaced)
    compiled.prepare(1.0, np.zeros(2, np.bool_), {})
    compiled.initialize(0.0, np.zeros(2))
    assert compiled.native().outputs_at(0.0, np.array([2.0, 0.003])) == pytest.approx([200.0, 0.3])


def test_a_vector_of_units_of_different_kinds_keeps_them():
    """Or has those of the port that it replaces: 2 m and 1 kg are 200 cm and 1000 g."""
    shown = map_ports(MIXED, renamings({"y": ["r", "m"]}))
    assert shown.interface.by_name["y"].unit == ("m", "kg")
    replaced = Interface((), (Signal("y", 2, unit=("cm", "g")),))
    shown = map_ports(MIXED, renamings({"y": ["r", "m"]}), replaced)
    assert shown.interface.by_name["y"].unit == ("cm", "g")
    values = dict(zip(MIXED.output_columns(), [2.0, 0.0, 0.0, 1.0, 0.0, 0.0], strict=True))
    y = shown.shown_outputs(np.array(list(values.values())))[shown.interface.output_columns()["y"]]
    assert y == pytest.approx([200.0, 1000.0], rel=1e-15)


@pytest.mark.parametrize("order", [["p", "q"], ["q", "p"]])
def test_the_linearization_is_that_of_the_shown_ports(order):
    """In their order, and in their units: the output is linear in the inputs."""
    names = {"x": ["b", "a"], "w": order}
    shown = renamed(names, linear_gauge(), Interface((), (Signal("x", 2, unit="cm"),)))
    shown.prepare(1.0, np.zeros(2, np.bool_), {})
    shown.initialize(0.0, np.zeros(2))
    u = np.array([2.0, 0.5])
    y = shown.outputs(0.0, u)
    assert shown.linearized(0.0, u).D @ u == pytest.approx(y, rel=1e-15)


def test_elements_from_0_on_make_a_port():
    """One that was not there, or one in the place of a port of the component."""
    whole = map_ports(INTERFACE, renamings({"y[1]": ["s[0]"], "y[0]": ["v"]}))
    assert [signal.name for signal in whole.interface.outputs] == ["s", "out", "y"]
    assert whole.names == {"y": "v, s[0]"}
    single = map_ports(INTERFACE, renamings({"s[0]": ["out[1]"], "push[0]": ["push"]}))
    assert single.names == {"s": "out[1]", "s_": "s"}
    names = {"f[0]": ["f[1]"], "f[1]": ["f[0]"]}
    turned = renamed(names)
    assert [(signal.name, signal.size) for signal in turned.interface.inputs] == [
        ("push", 1),
        ("f", 2),
        ("g", 1),
    ]
    assert map_ports(INTERFACE, renamings(names)).names == {"f": "f[1], f[0]"}
    check_component(lambda: renamed(names))


def test_a_single_element_of_a_port_of_unknown_size_is_a_signal():
    """No vector of the component is beside it, where it would be in the place of an element."""
    single = map_ports(INTERFACE, renamings({"s[1]": ["v"], "y[1]": ["v"]}))
    assert [(s.name, s.size) for s in single.interface.outputs] == [
        ("s_", 2),
        ("out", 3),
        ("s[1]", 1),
        ("y[1]", 1),
    ]


REPLACED = Interface((), (Signal("x", 2), Signal("y"), Signal("z"), Signal("z[1]")))
PARTS = {
    "an element beside the whole": (
        {"x": ["s"], "x[0]": ["s[1]"]},
        r"'plant\.x\[0\]' \(as s\[1\]\) overlaps 'plant\.x' \(as s\)",
    ),
    "an element beside a slice": (
        {"x[0]": ["v"], "x[0:2]": ["s"]},
        r"'plant\.x\[0:2\]' \(as s\) overlaps 'plant\.x\[0\]' \(as v\)",
    ),
    "an element beside the scalar": (
        {"y[0]": ["v"], "y": ["s[0]"]},
        r"'plant\.y\[0\]' \(as v\) overlaps 'plant\.y' \(as s\[0\]\)",
    ),
    "the second element alone": (
        {"x[1]": ["v"]},
        r"'plant\.x\[1\]' \(as v\) is a part of 'plant\.x', which has 2 elements",
    ),
    "the first element alone": (
        {"x[0]": ["v"]},
        r"'plant\.x'.*entries for the rest too: plant\.x\[1\]",
    ),
    "an element that is not there": (
        {"x[5]": ["v"]},
        r"'plant\.x\[5\]' \(as v\): 'plant\.x' has 2 elements, numbered from 0",
    ),
    "a vector for an element": (
        {"x[0]": ["s"], "x[1]": ["v"]},
        r"'plant\.x\[0\]':.*size 1.*2: s",
    ),
}


@pytest.mark.parametrize("case", PARTS)
def test_parts_of_a_port_make_the_whole_of_it(case):
    """They neither overlap nor leave out an element."""
    names, text = PARTS[case]
    with pytest.raises(GraphError, match=text):
        map_ports(INTERFACE, renamings(names), REPLACED)


def test_a_name_in_brackets_may_be_that_of_a_port():
    """It is no element of another then; y[0] is the scalar y."""
    names = {"z[1]": ["v"], "z": ["s[0]"], "y[0]": ["s[1]"]}
    ports = map_ports(INTERFACE, renamings(names), REPLACED)
    assert ports.names == {"z[1]": "v", "z": "s[0]", "y": "s[1]"}


def test_a_recording_may_be_renamed_and_ends_where_it_ends():
    """The rows up to there are shown."""
    memory = Memory()
    run(Graph({"plant": Expression(["t"])}, {}), Clock(0.2, 0.1), memory)
    shown = renamed({"z": ["y"]}, Replay(memory, "plant"))
    shown.initialize(0.0, np.zeros(0))
    with pytest.raises(Stopped, match=r"recording ends at 0\.2 s") as stopped:
        shown.advance(np.array([0.0, 0.1, 0.2, 0.3]), 0.1, np.zeros((4, 0)))
    assert stopped.value.outputs.tolist() == [[0.1], [0.2]]


MIXED = Interface(
    (Signal("u", 2), Signal("w")),
    (
        Signal("r", unit="m"),
        Signal("n", type="integer"),
        Signal("k", variability="discrete"),
        Signal("m", unit="kg"),
        Signal("o", optional=True),
        Signal("v"),
    ),
)
WRONG = {
    "no such port": (
        {"y": ["rr"]},
        r"'plant\.rr': 'plant' has no input or output 'rr'; did you mean",
    ),
    "no such element": ({"y": ["r[1]"]}, r"'plant\.r\[1\]': 'plant\.r' has 1 element, numbered"),
    "types": ({"y": ["r", "n"]}, r"'plant\.y' cannot be made of r, n: 'r' is real, 'n' is integer"),
    "variability": (
        {"y": ["r", "k"]},
        r"'r' is continuous, 'k' is discrete, and all of a signal is one or the other; leave "
        r"'plant\.y' out of the map and list them in the connection: \[\"plant\.r\", "
        r"\"plant\.k\"\]",
    ),
    "values that may be missing": ({"y": ["r", "o"]}, r"'r' is never NaN, 'o' is optional"),
    "a unit and none": ({"y": ["r", "v"]}, r"'r' has unit 'm', 'v' has none; leave 'plant\.y'"),
    "causality": ({"y": ["r", "w"]}, r"'r' is output, 'w' is input"),
    "size": ({"y[1]": ["u"]}, r"'plant\.y\[1\]':.*size 1.*2: u"),
    "an input twice": (
        {"a": ["w"], "b": ["w"]},
        r"'plant\.w' is given twice, for 'plant\.a' and 'plant\.b'",
    ),
    "a part of an input": (
        {"a": ["u[1]"]},
        r"'plant\.a' is a part of the input 'u'.*ports for the rest too: u\[0\]",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_name_says_what_there_is(case):
    """What was found, and the way out."""
    names, text = WRONG[case]
    with pytest.raises(GraphError, match=text):
        map_ports(MIXED, renamings(names))
