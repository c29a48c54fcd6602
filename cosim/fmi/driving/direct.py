"""The direct way from inputs to outputs of a co-simulation unit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from cosim.arrays import Vector
from cosim.fmi.description import Description
from cosim.fmi.instance import CoSimulationInstance
from cosim.fmi.references import ReferenceMap


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
        self._unknowns = _select(instance.description, "output", face.output_columns(), fed)
        self._knowns = _select(
            instance.description, "input", face.input_columns(), real.intersection(feeding)
        )

    def add(self, y: Vector, du: Vector) -> Vector:
        """Give y + D du, shape (n_y,)."""
        seed, y = self._knowns.take(du), y.copy()
        if self._unknowns.size and any(seed.tolist()):  # quicker than seed.any() for a few
            y[self._unknowns.columns] += self._instance.get_directional_derivative(
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


def _select(
    description: Description, causality: str, columns: Mapping[str, slice], names: Iterable[str]
) -> ReferenceMap:
    """Return the variables behind some inputs or outputs."""
    references = description.references(causality)
    mask = np.zeros(references.size, np.bool_)
    for name in names:
        mask[columns[name]] = True
    return references.select(mask)
