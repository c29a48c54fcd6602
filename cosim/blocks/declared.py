"""Units that a scenario declares for ports whose component does not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast, final

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import (
    Component,
    Design,
    InputWiring,
    Native,
    Rollback,
    first_event,
    left_limits,
    linearized,
    prepare,
    prepare_substeps,
    take_wiring,
)
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface, PortUnit, Signal
from cosim.errors import GraphError, nearest
from cosim.native.step import NativeStep
from cosim.units import Unit


def with_units(component: Component, units: Mapping[str, PortUnit]) -> Component:
    """Return a component whose ports have the units given; itself, where they have them already.

    Raises
    ------
    GraphError
        If there is no such port, its size is another, or it has another unit that is known.
    """
    interface = declare_units(component.interface, units)
    return component if interface == component.interface else Declared(component, interface)


def declare_units(interface: Interface, units: Mapping[str, PortUnit]) -> Interface:
    """Return an interface with the units given, by port.

    Raises
    ------
    GraphError
        If there is no such port, its size is another, or it has another unit that is known: values
        in it would be taken for what they are not.
    """
    names = [signal.name for signal in interface.signals]
    for port in units:
        if port not in names:
            raise GraphError(f"unit: there is no port {port!r}; {nearest(port, names)}")
    inputs = tuple(_declared(signal, units) for signal in interface.inputs)
    outputs = tuple(_declared(signal, units) for signal in interface.outputs)
    return replace(interface, inputs=inputs, outputs=outputs)


def _declared(signal: Signal, units_by_port: Mapping[str, PortUnit]) -> Signal:
    if signal.name not in units_by_port:
        return signal
    unit = units_by_port[signal.name]
    names = (unit,) * signal.size if isinstance(unit, str) else tuple(unit)
    if len(names) != signal.size:
        raise GraphError(
            f"unit of {signal.name!r}: expected {signal.size} units, one for each element, or one "
            f"for all, got {list(names)}"
        )
    own = signal.measures
    units = [
        of_element if of_element.name == name else Unit(name)
        for of_element, name in zip(own, names, strict=True)
    ]
    if any(old.si is not None and old != new for old, new in set(zip(own, units, strict=True))):
        raise GraphError(
            f"unit of {signal.name!r}: got {unit!r}, but the component itself declares "
            f"{signal.unit_text!r}; omit it, as connections convert units"
        )
    return signal.in_units(units)


@final
class Declared:
    """A component with another declaration of its ports.

    Parameters
    ----------
    component : Component
    interface : Interface
        That of the component, but for the units.
    """

    def __init__(self, component: Component, interface: Interface) -> None:
        self.interface = interface
        self._component = component

    def take_wiring(self, wiring: InputWiring) -> None:
        """Say it to the component."""
        take_wiring(self._component, wiring)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component."""
        return prepare(self._component, h, held, recorded)

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Prepare the component."""
        return prepare_substeps(self._component, lengths, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the component."""
        return self._component.initialize(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs of the component."""
        return self._component.outputs(t, u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance the component."""
        return self._component.advance(t, h, u)

    def left_limits(self, t: Vector) -> Mapping[int, Vector]:
        """Return the left limits of the component."""
        return left_limits(self._component, t)

    def first_event(self) -> float:
        """Return the time of the first event inside the last step of the component."""
        return first_event(self._component)

    def native(self) -> NativeStep | None:
        """Return the compiled step of the component."""
        return cast(Native, self._component).native()

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize the component."""
        return linearized(self._component, t, u)

    def save(self) -> object:
        """Copy the state of the component."""
        return cast(Rollback[object], self._component).save()

    def restore(self, state: object) -> None:
        """Go back to a saved state of the component."""
        cast(Rollback[object], self._component).restore(state)
