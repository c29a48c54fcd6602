"""Which input elements have a zero-order hold, by the variability of their sources."""

import pytest

from cosim.blocks.source import constant
from cosim.core.graph import Graph
from cosim.core.signals import Interface, Signal
from tests.core.parts import Scripted, integrator


def test_an_element_that_nothing_drives_has_no_zero_order_hold():
    """It is constant: a hold there would cost a component its second order for nothing."""
    part = Scripted([0.0] * 3)
    part.interface = Interface((Signal("u", 2, connection="optional"),), (Signal("y"),), {"y": ()})
    graph = Graph({"a": integrator(), "part": part}, {"a.u": "a.y", "part.u[1]": "a.y"})
    assert graph.held["part"].tolist() == [False, False]


def test_the_masks_of_a_graph_are_read_only():
    """They are handed to components, and go to the log as they are."""
    graph = Graph({"s": constant([1.0]), "a": integrator()}, {"a.u": "s.y"})
    with pytest.raises(ValueError, match="read-only"):
        graph.held["a"][0] = True
