"""Reading descriptions, comparing ports, units."""

import hashlib
from dataclasses import replace

import pytest

from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError
from cosim.fmi.compare import Port, PortRow, compare_ports
from cosim.fmi.description import Description, Variable
from cosim.fmi.reading import read
from cosim.units import base_unit, same_unit
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


def test_ports_are_compared_by_name():
    """Every status, and the texts of a row."""
    needed = Interface(
        (Signal("u", unit="N"), Signal("delta")),
        (Signal("y", unit="Hz"), Signal("x_a", 2), Signal("x_b"), Signal("s", unit="m")),
        {"y": ("u",)},
    )
    found = Interface(
        (Signal("u", unit="kg.m/s2"), Signal("x_b"), Signal("k")),
        (Signal("y", unit="1/s"), Signal("x_a", 3), Signal("s", unit="mm")),
    )
    rows = {row.name: row for row in compare_ports(needed, found)}
    assert {name: row.status for name, row in rows.items()} == {
        "u": "ok", "delta": "missing", "y": "ok", "x_a": "other size", "x_b": "wrong causality", "s": "other unit", "k": "extra",
    }  # fmt: skip
    assert rows["y"] == PortRow("y", Port("output", 1, "Hz", ("u",)), Port("output", 1, "1/s", ()), "ok")
    assert rows["delta"].found is None
    assert {row.status for row in compare_ports(FACE, FACE)} == {"ok"}


def test_units():
    """Products, quotients and powers of SI units; what is not known is not compared as equal."""
    assert base_unit("kg.m2/s^2") == base_unit("J") == base_unit("N*m")
    assert base_unit("1") == base_unit("rad/rad")
    assert base_unit("furlong") is None
    assert base_unit("min").factor == 60.0
    assert same_unit("furlong", "furlong")
    assert same_unit(None, "m")
    assert not same_unit("furlong", "m")
    assert not same_unit("min", "s")
