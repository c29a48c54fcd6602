"""Connections that run, but may be meant otherwise, are pointed out."""

import numpy as np

from cosim.blocks.source import constant
from cosim.core.graph import Graph
from cosim.core.signals import Interface, Signal


class Array:
    """A component with an array as its input that is numbered from 1 in its FMU."""

    interface = Interface((Signal("u", 2, first=1, connection="optional"),), (Signal("y"),))

    def initialize(self, t, u):
        return np.zeros(1)

    def outputs(self, t, u):
        return np.zeros(1)

    def advance(self, t, h, u):
        return np.zeros((len(t) - 1, 1))


def test_an_element_of_an_fmu_is_pointed_out_where_others_are_not_driven():
    """The number may be meant as in the FMU. Who drives every element knows where they begin."""
    components = {"a": constant([1.0]), "array": Array()}
    (warning,) = Graph(components, {"array.u[1]": "a.y"}).warnings
    name, text = warning
    assert name == "array"
    assert "array.u[1] is u[2] of the FMU" in text
    assert "write array.u[1:2]" in text
    assert Graph(components, {"array.u[0]": "a.y", "array.u[1]": "a.y"}).warnings == []
