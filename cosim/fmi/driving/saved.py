"""Saved states of units, for components that can go back."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

from cosim.errors import FmuError
from cosim.fmi.description import Capabilities
from cosim.fmi.instance import Instance


@dataclass(frozen=True, eq=False)
class SavedState:
    """A unit's state and what its component keeps beside it; the unit's copy is freed with this object."""

    instance: object
    own: tuple[object, ...]


def save(instance: Instance, capabilities: Capabilities, own: tuple[object, ...]) -> SavedState:
    """Copy a unit's state.

    Raises
    ------
    FmuError
        If the unit cannot.
    """
    if not capabilities.saves_state:
        raise FmuError(
            f"{instance.description.name}: the unit cannot save its state (canGetAndSetFMUstate is false)"
        )
    saved = SavedState(instance.get_fmu_state(), own)
    weakref.finalize(saved, instance.free_fmu_state, saved.instance)
    return saved
