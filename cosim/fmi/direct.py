"""The direct way from inputs to outputs of a co-simulation unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.fmi.description import Description
from cosim.fmi.references import References
from cosim.fmi.unit import CoSimulationUnit


@final
class Direct:
    """D times a change of the inputs, by directional derivatives, for real inputs and continuous outputs."""

    def __init__(self, unit: CoSimulationUnit, outputs: Sequence[int], inputs: Sequence[int]) -> None:
        self._unit, self._n_y = unit, unit.interface.n_y
        self._rows, self._columns = np.array(outputs, np.intp), np.array(inputs, np.intp)
        self._unknowns = _select(unit.description, "output", self._rows)
        self._knowns = _select(unit.description, "input", self._columns)

    @staticmethod
    def of(unit: CoSimulationUnit) -> Direct:
        """Find what feeds through."""
        face = unit.interface
        sources = {name for output in face.outputs for name in face.feeds(output.name)}
        moving = [signal.name for signal in face.outputs if signal.kind == "real" and signal.variability == "continuous"]
        fed = [name for name in moving if face.feeds(name)]
        feeding = [signal.name for signal in face.inputs if signal.name in sources and signal.kind == "real"]
        rows, columns = face.output_columns(), face.input_columns()
        return Direct(unit, _elements(rows, fed), _elements(columns, feeding))

    def change(self, du: Vector) -> Vector:
        """D du, shape (n_y,)."""
        seed, dy = du[self._columns], np.zeros(self._n_y)
        if len(self._rows) and seed.any():
            dy[self._rows] = self._unit.get_directional_derivative(self._unknowns, self._knowns, seed)
        return dy


def _elements(columns: Mapping[str, slice], names: Sequence[str]) -> list[int]:
    return [i for name in names for i in range(columns[name].start, columns[name].stop)]


def _select(description: Description, causality: str, elements: NDArray[np.intp]) -> References:
    """Give the references of the variables that hold some elements of the input or output vector."""
    variables = [v for _, group in description.ports(causality) for v in group]
    owner = np.repeat(np.arange(len(variables)), [v.size for v in variables])
    return description.reference(variables[i].name for i in dict.fromkeys(owner[elements].tolist()))
