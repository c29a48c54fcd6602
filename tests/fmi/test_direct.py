"""The correction of outputs by D asks only for derivatives that an FMU provides."""

from types import SimpleNamespace

import numpy as np

from cosim.fmi.description import Description
from cosim.fmi.driving.direct import DirectFeedthrough
from cosim.fmi.variable import Variable


def test_only_double_precision_is_corrected():
    """Directional derivatives are for Float64.

    The Float32 input w has none here, so y, which depends on it, is not exact.
    """
    variables = (
        Variable("w", 0, "input", "Float32"),
        Variable("u", 1, "input"),
        Variable("y", 2, "output"),
        Variable("z", 3, "output"),
        Variable("v", 4, "output", "Float32"),
    )
    dependencies = {"y": ("u", "w"), "z": ("u",), "v": ("u",)}
    description = Description("x", "", "3.0", variables, dependencies=dependencies)
    calls = []

    def typed_references(references):
        return [(group.type, group.references.tolist()) for group in references.groups]

    def get_directional_derivative(unknowns, knowns, seed):
        calls.append((typed_references(unknowns), typed_references(knowns)))
        return np.array([2.0, 3.0]) * seed

    instance = SimpleNamespace(
        description=description,
        interface=description.interface,
        get_directional_derivative=get_directional_derivative,
    )
    feedthrough = DirectFeedthrough(instance, frozenset())
    y = feedthrough.add(np.zeros(3), np.array([5.0, 1.0]))
    assert np.array_equal(y, [2.0, 3.0, 0.0])
    assert calls == [([("Float64", [2, 3])], [("Float64", [1])])]
    assert feedthrough.corrected == {"z"}
