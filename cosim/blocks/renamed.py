"""A component under other port names, such as those of the component that it replaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast, final

from cosim.arrays import Mask, Matrix, Vector
from cosim.blocks.port_map import PortMap
from cosim.core.contracts import (
    Component,
    Design,
    InputWiring,
    Native,
    Rollback,
    Stopped,
    first_event,
    left_limits,
    linearized,
    prepare,
    prepare_substeps,
    take_wiring,
)
from cosim.core.linearization import Linearized
from cosim.native.blocks.wrapping import ports_step
from cosim.native.step import NativeStep


@final
class Renamed:
    """Shows the ports of a component under other names.

    Parameters
    ----------
    component : Component
    ports : PortMap
        What :func:`cosim.blocks.map_ports` returned for the interface of the component.
    """

    def __init__(self, component: Component, ports: PortMap) -> None:
        self.interface = replace(ports.interface, prepares=True)
        self._component = component
        self._ports = ports

    def take_wiring(self, wiring: InputWiring) -> None:
        """Say it to the component, of its own inputs."""
        take_wiring(self._component, wiring.of(self._ports.component_mask))

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component; the arrays of its design have no ports."""
        own_held = self._ports.component_mask(held)
        return prepare(self._component, h, own_held, recorded)

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Prepare the component; the arrays of its design have no ports."""
        return prepare_substeps(self._component, lengths, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the component; return the shown outputs at ``t``."""
        own_u = self._ports.component_inputs(u)
        y = self._component.initialize(t, own_u)
        return self._ports.shown_outputs(y)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the shown outputs at ``t``, the time reached."""
        own_u = self._ports.component_inputs(u)
        y = self._component.outputs(t, own_u)
        return self._ports.shown_outputs(y)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance the component; return the shown outputs at ``t[1:]``."""
        own_u = self._ports.component_inputs(u)
        try:
            y = self._component.advance(t, h, own_u)
        except Stopped as stop:
            completed = self._ports.shown_outputs(stop.outputs)
            raise Stopped(completed, str(stop), failed=stop.failed) from stop
        return self._ports.shown_outputs(y)

    def left_limits(self, t: Vector) -> Mapping[int, Vector]:
        """Return the left limits of the component, of the shown outputs."""
        own = left_limits(self._component, t)
        return {place: self._ports.shown_outputs(y) for place, y in own.items()}

    def first_event(self) -> float:
        """Return the time of the first event inside the last step of the component."""
        return first_event(self._component)

    def native(self) -> NativeStep | None:
        """Return the compiled step, if the component has one: its own, if nothing has moved."""
        step = cast(Native, self._component).native()
        if step is None or self._ports.keeps_places:
            return step
        return ports_step(step, self._ports.input_elements(), self._ports.output_elements())

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize the component, between the shown ports."""
        own = linearized(self._component, t, self._ports.component_inputs(u))
        return None if own is None else self._ports.shown_linearized(own)

    def save(self) -> object:
        """Copy the state of the component."""
        return cast(Rollback[object], self._component).save()

    def restore(self, state: object) -> None:
        """Go back to a saved state of the component."""
        cast(Rollback[object], self._component).restore(state)
