"""Ports: what their written names mean."""

import re

import pytest

from cosim.core.port import Port
from cosim.core.signals import Signal
from cosim.errors import GraphError

DECLARED = (Signal("y"), Signal("x", 3), Signal("x[1]"), Signal("a.b", 2))
SIGNALS = {signal.name: signal for signal in DECLARED}


@pytest.mark.parametrize(
    ("text", "port"),
    [
        ("plant.y", Port("plant", "y")),
        ("plant.x[2]", Port("plant", "x", 2)),
        ("plant.x[0:2]", Port("plant", "x", range(0, 2))),
        ("plant.a.b[1]", Port("plant", "a.b", 1)),
        ("plant.x[1][2]", Port("plant", "x[1]", 2)),
        ("plant.x[-1]", Port("plant", "x[-1]")),
    ],
)
def test_a_port_is_its_written_name(text, port):
    """Parsing and writing are inverse to each other."""
    assert Port.parse(text) == port
    assert str(port) == text


@pytest.mark.parametrize("text", ["plant", "plant.", ".y", "", "plant.x[2:2]", "plant.x[2:1]"])
def test_only_names_of_ports_are_taken(text):
    """A port needs a component, a signal, and at least one element."""
    with pytest.raises(GraphError, match=re.escape(repr(text))):
        Port.parse(text)


@pytest.mark.parametrize(
    ("text", "name", "elements"),
    [
        ("plant.y", "y", slice(0, 1)),
        ("plant.x", "x", slice(0, 3)),
        ("plant.x[2]", "x", slice(2, 3)),
        ("plant.x[1]", "x[1]", slice(0, 1)),
        ("plant.x[1:3]", "x", slice(1, 3)),
        ("plant.a.b[1]", "a.b", slice(1, 2)),
        ("plant.y[0]", "y", slice(0, 1)),
    ],
)
def test_a_port_finds_its_elements(text, name, elements):
    """A name of its own comes before the element that it looks like."""
    found = Port.parse(text).find(SIGNALS)
    assert found is not None
    assert (found[0].name, found[1]) == (name, elements)


@pytest.mark.parametrize(
    ("text", "size", "names"),
    [
        ("c.x", 1, ["c.x"]),
        ("c.x", 2, ["c.x[0]", "c.x[1]"]),
        ("c.x[2]", 1, ["c.x[2]"]),
        ("c.x[2:3]", 1, ["c.x[2]"]),
        ("c.x[1:3]", 2, ["c.x[1]", "c.x[2]"]),
    ],
)
def test_elements_of_a_port_are_numbered_as_in_its_signal(text, size, names):
    """Of a slice too, also of one element."""
    assert Port.parse(text).element_names(size) == names


def test_a_port_of_another_signal_finds_nothing():
    """None says that there is no such signal."""
    assert Port("plant", "z").find(SIGNALS) is None


@pytest.mark.parametrize("text", ["plant.x[3]", "plant.x[1:4]"])
def test_elements_that_are_not_there_are_refused(text):
    """The message says how many there are."""
    with pytest.raises(GraphError, match=r"'plant.x' has 3 elements, numbered from 0"):
        Port.parse(text).find(SIGNALS)
