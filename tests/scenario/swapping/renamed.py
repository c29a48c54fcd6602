"""FMUs of the example's plant with other port names in another order, for tests of maps."""

from pathlib import Path

import numpy as np

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.fmi.exporting.export import export
from tests.fmi.plant import START, A, B, C, D

MAP = {"plant.u": "force", "plant.delta": "push", "observer.y": "out1", "plant.x_a": "s"}
PACKED = {"plant.u": "force", "plant.delta": "push", "plant.y": "out[2]", "plant.x_a": "s"}


def renamed(path: Path) -> Path:
    """Export the plant with inputs push and force for delta and u.

    Its outputs are aux, s and out1 for x_b, x_a and y.
    """
    outputs = (Signal("aux"), Signal("s", 2, role="state"), Signal("out1"))
    return _export(path, outputs, {"aux": ("force",), "out1": ("force",)}, [3, 1, 2, 0])


def packed(path: Path) -> Path:
    """Export the same with y in the last place of a vector: out = (x_b, x_b, y)."""
    outputs = (Signal("out", 3), Signal("s", 2, role="state"))
    return _export(path, outputs, {"out": ("force",)}, [3, 3, 0, 1, 2])


def _export(path, outputs, feedthrough, rows):
    inputs = (Signal("push", role="input"), Signal("force", role="input"))
    interface = Interface(inputs, outputs, feedthrough)
    B_turned, D_turned = B[:, [1, 0]], D[rows][:, [1, 0]]
    zero = np.zeros((2, 2))
    model = LinearModel(interface, ("s[0]", "s[1]"), A, B_turned, C[rows], D_turned, START, zero)
    return export(model, path, name=path.stem).path
