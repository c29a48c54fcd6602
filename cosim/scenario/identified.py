"""What a report needs to judge an identifier: its model, and where its data are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cosim.native.expression import Program
from cosim.theory.disturbance import Family
from cosim.theory.disturbed_plant import DisturbedPlant


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
