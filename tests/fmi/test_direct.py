"""The correction of outputs by D asks for what a unit can answer."""

from types import SimpleNamespace

import numpy as np

from cosim.fmi.description import Description
from cosim.fmi.driving.direct import DirectFeedthrough
from cosim.fmi.variable import Variable


def test_only_double_precision_is_corrected():
    """Directional derivatives are for Float64: the Float32 input w has none here, so y, which depends on it, is not exact."""
    description = Description(
        "x",
        "",
        "3.0",
        (
            Variable("w", 0, "input", "Float32"),
            Variable("u", 1, "input"),
            Variable("y", 2, "output"),
            Variable("z", 3, "output"),
            Variable("v", 4, "output", "Float32"),
        ),
        dependencies={"y": ("u", "w"), "z": ("u",), "v": ("u",)},
    )
    asked = []

    def answer(unknowns, knowns, seed):
        asked.append(
            [
                (g.type, g.references.tolist())
                for references in (unknowns, knowns)
                for g in references.groups
            ]
        )
        return np.array([2.0, 3.0]) * seed

    unit = SimpleNamespace(
        description=description, interface=description.interface, get_directional_derivative=answer
    )
    feedthrough = DirectFeedthrough(unit, frozenset())
    assert np.array_equal(feedthrough.add(np.zeros(3), np.array([5.0, 1.0])), [2.0, 3.0, 0.0])
    assert asked == [[("Float64", [2, 3]), ("Float64", [1])]]
    assert feedthrough.corrected == {"z"}
