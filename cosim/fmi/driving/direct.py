"""The direct feedthrough from inputs to outputs of a co-simulation FMU."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from cosim.arrays import Vector
from cosim.fmi.description import Description
from cosim.fmi.instance import Addresses, CoSimulationInstance
from cosim.fmi.references import ReferenceMap
from cosim.native.fmi.co_simulation import CoSimulationStruct


@final
class DirectFeedthrough:
    """D times a change of the inputs, by directional derivatives.

    It leads from real inputs to continuous outputs, all of them Float64, which directional
    derivatives are for.

    Parameters
    ----------
    instance : CoSimulationInstance
    in_events : set of str
        Names of the inputs that change in events only, so that outputs are always read for their
        last values.

    Attributes
    ----------
    corrected : set of str
        Names of the outputs that depend on nothing else directly.
    """

    def __init__(self, instance: CoSimulationInstance, in_events: frozenset[str]) -> None:
        description = instance.description
        interface = instance.interface
        real_inputs = _float64_signals(description, "input") - in_events
        float64_outputs = _float64_signals(description, "output")
        # By output: the inputs that feed through to it, where a real one is among them.
        feeds: dict[str, tuple[str, ...]] = {}
        feeding: set[str] = set()
        for output in interface.outputs:
            if output.name not in float64_outputs or output.variability != "continuous":
                continue
            inputs = interface.feeds(output.name)
            if not real_inputs.isdisjoint(inputs):
                feeds[output.name] = inputs
                feeding |= real_inputs.intersection(inputs)
        followed = real_inputs | in_events
        self.corrected = frozenset(
            name for name, inputs in feeds.items() if followed.issuperset(inputs)
        )
        self._instance = instance
        self._unknowns = _select(description, "output", interface.output_columns(), feeds)
        self._knowns = _select(description, "input", interface.input_columns(), feeding)

    def native(self, addresses: Addresses, struct: CoSimulationStruct) -> None:
        """Write to the struct of a compiled step what it needs to add D du."""
        if self._unknowns.size:
            struct.feedthrough = addresses.directional(self._unknowns, self._knowns)
            struct.unknowns = self._unknowns.columns.ctypes.data
            struct.knowns = self._knowns.columns.ctypes.data

    def add(self, y: Vector, du: Vector) -> Vector:
        """Return y + D du, shape (n_y,)."""
        seed = self._knowns.take(du)
        corrected = y.copy()
        if self._unknowns.size and any(seed.tolist()):  # quicker than seed.any() for a few
            changes = self._instance.get_directional_derivative(self._unknowns, self._knowns, seed)
            corrected[self._unknowns.columns] += changes
        return corrected


def _float64_signals(description: Description, causality: str) -> set[str]:
    """Return the names of the signals all of whose variables are Float64.

    Without local variables: directional derivatives are for those of ModelStructure (FMI 2.0.4
    section 2.1.9).
    """
    names = set()
    for signal, variables in description.ports(causality):
        if all(v.type == "Float64" and v.causality == causality for v in variables):
            names.add(signal.name)
    return names


def _select(
    description: Description, causality: str, columns: Mapping[str, slice], names: Iterable[str]
) -> ReferenceMap:
    """Return the variables behind some inputs or outputs."""
    references = description.references(causality)
    mask = np.zeros(references.size, np.bool_)
    for name in names:
        mask[columns[name]] = True
    return references.select(mask)
