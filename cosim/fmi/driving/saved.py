"""Saved states of FMUs, for components that can go back."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Generic, TypeVar

from cosim.errors import FmuError
from cosim.fmi.description import Capabilities
from cosim.fmi.instance import Instance

ComponentState = TypeVar("ComponentState")


@dataclass(frozen=True, eq=False)
class SavedState(Generic[ComponentState]):
    """An FMU state and what the component keeps beside it.

    The FMU state is freed with this object.

    Parameters
    ----------
    fmu : object
        Copy of the instance's state, as ``get_fmu_state`` returned it.
    component : ComponentState
    messages : object
        What the messages of the instance up to the copy are known by.
    """

    fmu: object
    component: ComponentState
    messages: object


def save(
    instance: Instance, capabilities: Capabilities, component: ComponentState
) -> SavedState[ComponentState]:
    """Copy the state of an instance.

    Raises
    ------
    FmuError
        If the FMU cannot save its state.
    """
    if not capabilities.saves_state:
        raise FmuError(
            f"{instance.description.name}: the FMU cannot save its state "
            "(canGetAndSetFMUstate is false)"
        )
    instance.may_go_back = True
    messages = instance.mark_messages()
    saved = SavedState(instance.get_fmu_state(), component, messages)
    # what it says of the copy is said once a copy, whenever that is
    instance.forget_messages(messages, of_calls=False)
    weakref.finalize(saved, instance.free_fmu_state, saved.fmu)
    return saved


def restore(instance: Instance, state: SavedState[ComponentState]) -> ComponentState:
    """Bring an instance back to a saved state; return what the component kept beside it.

    What the instance said since then, and nobody has fetched, it has not said.
    """
    instance.set_fmu_state(state.fmu)
    instance.forget_messages(state.messages)
    return state.component
