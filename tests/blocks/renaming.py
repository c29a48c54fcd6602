"""A linear component under other port names."""

from __future__ import annotations

import numpy as np

from cosim.blocks import Renamed, Renaming, map_ports
from cosim.core.linear import Linear, LinearModel
from cosim.core.port import Port
from cosim.core.signals import Interface, Signal

INTERFACE = Interface(
    (Signal("push", unit="kN", start=(0.5,)), Signal("f", 2, unit="N"), Signal("g", unit="kN")),
    (Signal("s", 2, role="state"), Signal("out", 3), Signal("v")),
    {"out": ("f",), "v": ("push",)},
    {"s": ("g",), "out": ("f", "g")},
)


A = np.array([[-1.0, 1.0], [-1.0, -2.0]])


CASES = {
    "other names": {"u": ["push"], "x_a": ["s"], "y": ["v"]},
    "the same names in another place": {"v": ["push"], "push": ["v"]},
    "elements of a vector": {"y": ["out[2]"], "a": ["f[1]"], "b": ["f[0]"], "x": ["s[1]"]},
    "vectors": {"u": ["g", "push"], "x_a": ["v", "s"], "z": ["out[0:2]", "s[0]"], "f_": ["f"]},
}


def linear():
    """x' = A x + B u, s = x, out = (x_1 + f_0, x_2 + f_1, x_1), v = push; x(0) depends on g."""
    B = np.array([[1.0, 0.5, 0.0, 0.1], [0.0, 0.0, 2.0, 0.3]])
    C = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    D = np.zeros((6, 4))
    D[2, 1] = 1.0
    D[3, 2] = 1.0
    D[5, 0] = 1.0
    Xu = np.zeros((2, 4))
    Xu[1, 3] = 0.7
    model = LinearModel(INTERFACE, ("s[0]", "s[1]"), A, B, C, D, np.array([1.0, -1.0]), Xu)
    return Linear(model)


def renamings(names, component="plant"):
    return [
        Renaming(
            Port.parse(f"{component}.{port}"),
            tuple(Port.parse(f"{component}.{source}") for source in sources),
        )
        for port, sources in names.items()
    ]


def renamed(names, component=None, replaced=None):
    component = component or linear()
    return Renamed(component, map_ports(component.interface, renamings(names), replaced))
