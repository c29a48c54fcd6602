"""Reading descriptions, comparing ports, units."""

import hashlib
from dataclasses import replace

import pytest

from cosim.errors import FmuError
from cosim.fmi.description import Description
from cosim.fmi.reading.model_description import read
from cosim.fmi.variable import Variable
from tests.fmi.plant import FACE


def outputs(*names, **changes):
    variables = tuple(Variable(name, i, "output", **changes) for i, name in enumerate(names))
    return [(s.name, s.size) for s in Description("m", "", "2.0", variables).interface.outputs]


def test_vectors_are_put_together_again():
    """Consecutive numbers from 0 or 1, whatever the order in the file; gaps, other starts and taken names stand alone."""
    assert outputs("x[0]", "x[1]", "y") == [("x", 2), ("y", 1)]
    assert outputs("x[2]", "x[1]") == [("x", 2)]
    assert outputs("x[0]", "x[2]") == [("x[0]", 1), ("x[2]", 1)]
    assert outputs("x[2]", "x[3]") == [("x[2]", 1), ("x[3]", 1)]
    assert outputs("x", "x[0]") == [("x", 1), ("x[0]", 1)]
    assert outputs("a[1].b[1]", "a[1].b[2]", "a[1,1]") == [("a[1].b", 2), ("a[1,1]", 1)]


def test_arrays_of_fmi_3_are_vectors():
    """One variable of several elements is one signal."""
    assert outputs("x", size=6) == [("x", 6)]


def test_feedthrough_is_unknown_where_nothing_is_said():
    """An output that says nothing may depend on every input, also beside others that say what they depend on."""
    variables = (Variable("u", 0, "input"), Variable("y", 1, "output"), Variable("z", 2, "output"))
    assert Description("m", "", "2.0", variables).interface.feedthrough == {"y": None, "z": None}
    mixed = Description("m", "", "2.0", variables, dependencies={"y": ()}).interface
    assert mixed.feedthrough == {"y": (), "z": None}
    assert mixed.feeds("z") == ("u",)
    assert not mixed.knows("z")


def test_a_file_is_read_without_unpacking_it(exported):
    """Both kinds with what they can do, the sum of the file, and the nearest name for one that is not there."""
    found = read(exported)
    assert found.sha256 == hashlib.sha256(exported.read_bytes()).hexdigest()
    assert found.description.capabilities["cs"].interpolates_inputs
    assert not found.description.capabilities["me"].completed_step
    assert found.description.interface == replace(FACE, initial={"y": ("u",), "x_b": ("u",)})
    with pytest.raises(FmuError, match="no variable 'yy'; did you mean 'y'"):
        found.description["yy"]
