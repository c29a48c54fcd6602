"""Saved states of units, for components that can go back."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

from cosim.errors import FmuError
from cosim.fmi.description import Capabilities
from cosim.fmi.unit import Unit


@dataclass(frozen=True, eq=False)
class SavedState:
    """A unit's state and what its component keeps beside it; the unit's copy is freed with this object."""

    unit: object
    own: tuple[object, ...]


def save(unit: Unit, capabilities: Capabilities, own: tuple[object, ...]) -> SavedState:
    """Copy a unit's state.

    Raises
    ------
    FmuError
        If the unit cannot.
    """
    if not capabilities.saves_state:
        raise FmuError(f"{unit.description.name}: the unit cannot save its state (canGetAndSetFMUstate is false)")
    saved = SavedState(unit.get_fmu_state(), own)
    weakref.finalize(saved, unit.free_fmu_state, saved.unit)
    return saved
