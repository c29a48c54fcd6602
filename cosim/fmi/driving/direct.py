"""The direct way from inputs to outputs of a co-simulation unit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.fmi.description import Description
from cosim.fmi.instance import CoSimulationInstance
from cosim.fmi.references import References


@final
class Direct:
    """D times a change of the inputs, by directional derivatives: from real inputs to continuous outputs, both Float64.

    Parameters
    ----------
    unit : CoSimulationInstance
    in_events : set of str
        Names of the inputs that change in events only, so that outputs are always read for their last values.

    Attributes
    ----------
    corrected : set of str
        Names of the outputs that depend on nothing else directly.
    """

    def __init__(self, instance: CoSimulationInstance, in_events: frozenset[str]) -> None:
        face = instance.interface
        real = set(_doubles(instance.description, "input")) - in_events
        doubles = set(_doubles(instance.description, "output"))
        moving = [
            signal.name
            for signal in face.outputs
            if signal.name in doubles and signal.variability == "continuous"
        ]
        fed = {name: face.feeds(name) for name in moving if real.intersection(face.feeds(name))}
        feeding = [
            signal.name
            for signal in face.inputs
            if any(signal.name in names for names in fed.values())
        ]
        self.corrected = frozenset(
            name for name, names in fed.items() if (real | in_events).issuperset(names)
        )
        self._instance = instance
        self._rows = _elements(face.output_columns(), fed)
        self._columns = _elements(face.input_columns(), [name for name in feeding if name in real])
        self._unknowns = _select(instance.description, "output", self._rows)
        self._knowns = _select(instance.description, "input", self._columns)

    def add(self, y: Vector, du: Vector) -> Vector:
        """Give y + D du, shape (n_y,)."""
        seed, y = du[self._columns], y.copy()
        if len(self._rows) and any(seed.tolist()):  # quicker than seed.any() for a few
            y[self._rows] += self._instance.get_directional_derivative(
                self._unknowns, self._knowns, seed
            )
        return y


def _doubles(description: Description, causality: str) -> list[str]:
    """Give the signals that directional derivatives are for."""
    return [
        signal.name
        for signal, group in description.ports(causality)
        if all(v.type == "Float64" for v in group)
    ]


def _elements(columns: Mapping[str, slice], names: Iterable[str]) -> NDArray[np.intp]:
    return np.array(
        [i for name in names for i in range(columns[name].start, columns[name].stop)], np.intp
    )


def _select(description: Description, causality: str, elements: NDArray[np.intp]) -> References:
    """Give the references of the variables that hold some elements of the input or output vector."""
    variables = [v for _, group in description.ports(causality) for v in group]
    owner = np.repeat(np.arange(len(variables)), [v.size for v in variables])
    return description.reference(variables[i].name for i in dict.fromkeys(owner[elements].tolist()))
