"""Compare the ports of two components, before one takes the other's place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from cosim.core.signals import Interface, Signal
from cosim.units import Unit, conversion

Status: TypeAlias = Literal["ok", "missing", "wrong causality", "other size", "other unit", "extra"]
Causality: TypeAlias = Literal["input", "output"]


@dataclass(frozen=True, slots=True)
class Port:
    """One side of a comparison.

    Parameters
    ----------
    causality : {"input", "output"}
    size : int
    unit : str or None
        None: not declared.
    feedthrough : tuple of str or None
        Of an output: the inputs it depends on directly; None: unknown. Empty for an input.
    """

    causality: Causality
    size: int
    unit: str | None
    feedthrough: tuple[str, ...] | None


@dataclass(frozen=True, slots=True)
class PortRow:
    """A port of the needed interface, or one that is only in the found interface (``extra``).

    Parameters
    ----------
    name : str
    needed, found : Port or None
    status : Status
        The first that applies, in the order of ``Status``. An ``extra`` input must be connected, an ``extra`` output need not;
        a ``missing`` port matters only where it is connected. Other feedthrough is no obstacle: a loop may then be solved in
        another order.
    """

    name: str
    needed: Port | None
    found: Port | None
    status: Status


def compare_ports(needed: Interface, found: Interface) -> tuple[PortRow, ...]:
    """Hold the ports of ``found`` against those of ``needed``, by name: the needed ones in their order, then the extra ones."""
    wanted, there = _ports(needed), _ports(found)
    rows = [PortRow(name, port, there.get(name), _status(port, there.get(name))) for name, port in wanted.items()]
    return (*rows, *(PortRow(name, None, port, "extra") for name, port in there.items() if name not in wanted))


def _status(needed: Port, found: Port | None) -> Status:
    if found is None:
        return "missing"
    if found.causality != needed.causality:
        return "wrong causality"
    if found.size != needed.size:
        return "other size"
    same = conversion(Unit(needed.unit), Unit(found.unit))
    return "ok" if same is not None and same.copies else "other unit"


def _ports(interface: Interface) -> dict[str, Port]:
    def port(signal: Signal, causality: Causality) -> Port:
        feeds: tuple[str, ...] | None = ()
        if causality == "output":
            feeds = interface.feeds(signal.name) if interface.knows(signal.name) else None
        return Port(causality, signal.size, signal.unit, feeds)

    inputs = {signal.name: port(signal, "input") for signal in interface.inputs}
    return inputs | {signal.name: port(signal, "output") for signal in interface.outputs}
