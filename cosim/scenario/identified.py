"""What a report needs to judge an identifier: its model, and where its data are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.expression import Program
from cosim.native.step import evaluate_at
from cosim.theory.disturbance import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentifiedPlant:
    """The model of an identifier, and the observer whose inputs y and u are its data.

    Parameters
    ----------
    observer : str
    plant : DisturbedPlant
    families : sequence of Family
        Of the components of the disturbance.
    alphas : sequence of Program
        The known factor of each.
    offset : bool
        A constant on every output is unknown.
    bounds : mapping of index to (lower, upper)
        Of theta.
    """

    observer: str
    plant: DisturbedPlant
    families: Sequence[Family]
    alphas: Sequence[Program]
    offset: bool
    bounds: Mapping[int, tuple[float, float]]

    def data_set(self, t: Vector, y: Matrix, u: Matrix, held: Mask) -> DataSet:
        """Return what the observer took in as the data of output error.

        Parameters
        ----------
        t : Vector, shape (N,)
        y : Matrix, shape (N, n_y)
        u : Matrix, shape (N, n_u)
        held : Mask, shape (n_u,)
            Which of u had a zero-order hold.
        """
        return DataSet(t, y, u, evaluate_at(self.alphas, t), held)
