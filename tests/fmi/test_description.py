"""Reading descriptions, comparing ports, units."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError
from cosim.fmi.describing import describe
from cosim.fmi.description import Description
from cosim.fmi.reading.model_description import read
from cosim.fmi.references import ReferenceMap, VectorElement
from cosim.fmi.variable import Variable
from tests.fmi.plant import INTERFACE


def outputs(*names, **changes):
    """Return name and size of the output signals of some output variables."""
    variables = [Variable(name, i, "output", **changes) for i, name in enumerate(names)]
    description = Description("m", "", "2.0", tuple(variables))
    return [(signal.name, signal.size) for signal in description.interface.outputs]


def test_vectors_are_put_together_again():
    """Consecutive numbers from 0 or 1 make a vector, whatever their order in the file.

    Gaps, other first numbers and names that are taken stand alone.
    """
    assert outputs("x[0]", "x[1]", "y") == [("x", 2), ("y", 1)]
    assert outputs("x[2]", "x[1]") == [("x", 2)]
    assert outputs("x[0]", "x[2]") == [("x[0]", 1), ("x[2]", 1)]
    assert outputs("x[2]", "x[3]") == [("x[2]", 1), ("x[3]", 1)]
    assert outputs("x", "x[0]") == [("x", 1), ("x[0]", 1)]
    assert outputs("a[1].b[1]", "a[1].b[2]", "a[1,1]") == [("a[1].b", 2), ("a[1,1]", 1)]


def test_scalars_of_different_units_are_a_vector_where_they_are_numbered_from_0():
    """Its elements have the names of the variables then: x[1] is no other one than it was.

    One without a unit stands alone, and so do those that a recording has by themselves.
    """

    def signals(units, first=0, **options):
        variables = []
        for i, unit in enumerate(units):
            variables.append(Variable(f"x[{i + first}]", i, "output", unit=unit))
        described = Description("m", "", "2.0", tuple(variables), **options)
        return [(signal.name, signal.unit) for signal in described.interface.outputs]

    assert signals(["mm", "m/s"]) == [("x", ("mm", "m/s"))]
    assert signals(["mm", "m/s"], first=1) == [("x[1]", "mm"), ("x[2]", "m/s")]
    assert signals(["mm", "mm"], first=1) == [("x", "mm")]
    assert signals(["mm", None]) == [("x[0]", "mm"), ("x[1]", None)]
    alone = signals(["mm", "m/s"], apart=frozenset({"x[0]", "x[1]"}))
    assert alone == [("x[0]", "mm"), ("x[1]", "m/s")]


def test_arrays_of_fmi_3_are_vectors():
    """One variable of several elements is one signal."""
    assert outputs("x", size=6) == [("x", 6)]


def test_a_signal_is_described_as_its_variables_are():
    """Each text stands once, in the order of the elements."""
    variables = (
        Variable("x[1]", 0, "output", doc="position"),
        Variable("x[2]", 1, "output", doc="position"),
        Variable("y[1]", 2, "output", doc="left"),
        Variable("y[2]", 3, "output"),
        Variable("y[3]", 4, "output", doc="right"),
        Variable("z", 5, "output"),
    )
    outputs = Description("m", "", "2.0", variables).interface.outputs
    assert [signal.description for signal in outputs] == ["position", "left; right", ""]


class Ports:
    """A model of which only the ports are described."""

    states = ()

    def __init__(self, interface):
        self.interface = interface


def test_an_exported_component_keeps_its_descriptions():
    """Also where an output may have no value, which its variable says first."""
    described = Interface(
        (Signal("u", description="force"),),
        (Signal("y", 2, description="positions"), Signal("z", optional=True, description="guess")),
    )
    undescribed = Interface((), (Signal("q", optional=True),))
    for interface in (described, undescribed):
        variables = describe(Ports(interface), "m", None).variables
        back = Description("m", "", "2.0", variables).interface
        texts = {signal.name: (signal.description, signal.optional) for signal in back.signals}
        expected = interface.signals
        assert texts == {signal.name: (signal.description, signal.optional) for signal in expected}


def test_feedthrough_is_unknown_where_nothing_is_declared():
    """An output may depend on every input unless its dependencies are listed."""
    variables = (Variable("u", 0, "input"), Variable("y", 1, "output"), Variable("z", 2, "output"))
    unknown = Description("m", "", "2.0", variables).interface
    assert unknown.feedthrough == {"y": None, "z": None}
    mixed = Description("m", "", "2.0", variables, dependencies={"y": ()}).interface
    assert mixed.feedthrough == {"y": (), "z": None}
    assert mixed.feeds("z") == ("u",)
    assert not mixed.knows("z")


def test_a_file_is_read_without_unpacking_it(exported):
    """Both interface types with their capabilities, the file's hash, the nearest name."""
    archive = read(exported)
    assert archive.sha256 == hashlib.sha256(exported.read_bytes()).hexdigest()
    description = archive.description
    assert description.capabilities["cs"].interpolates_inputs
    assert not description.capabilities["me"].completed_step
    initial = {"y": ("u",), "x_b": ("u",)}
    inputs = tuple(replace(signal, connection="optional") for signal in INTERFACE.inputs)
    assert description.interface == replace(INTERFACE, inputs=inputs, initial=initial)
    with pytest.raises(FmuError, match="no variable 'yy'; did you mean 'y'"):
        description["yy"]


def test_a_reference_map_knows_where_elements_stand():
    """Columns follow the order of the variables, groups their types."""
    variables = (
        Variable("a", 7, "input", size=2),
        Variable("n", 8, "input", "Int32"),
        Variable("b", 9, "input"),
        Variable("again", 7, "local", size=2),
    )
    inputs = Description("m", "", "3.0", variables).references("input")
    elements = [f"{element.variable.name}[{element.index}]" for element in inputs.elements]
    assert elements == ["a[0]", "a[1]", "n[0]", "b[0]"]
    float64, int32 = inputs.groups
    assert (float64.type, float64.references.tolist()) == ("Float64", [7, 9])
    assert (int32.type, int32.references.tolist()) == ("Int32", [8])
    assert float64.columns.tolist() == [0, 1, 3]
    assert int32.columns.tolist() == [2]
    assert inputs.ungrouped.references.tolist() == [7, 8, 9]
    reals = inputs.select(inputs.where(lambda variable: variable.type == "Float64"))
    assert (reals.size, reals.all_float64) == (3, True)
    values = np.array([1.0, 2.0, 3.0, 4.0])
    assert reals.take(values).tolist() == [1.0, 2.0, 4.0]
    everything = inputs.select(np.ones(4, np.bool_))
    assert everything.take(values) is values
    alias = VectorElement(variables[3], 1)
    assert ReferenceMap.of_distinct(variables).columns_of([alias]).tolist() == [1]
