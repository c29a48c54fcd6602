"""Compare the ports of two components, before one takes the other's place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias, TypedDict

from cosim.core.signals import Interface, Signal
from cosim.fmi.units import same_unit

Status: TypeAlias = Literal["ok", "missing", "wrong causality", "other size", "other unit", "extra"]
Causality: TypeAlias = Literal["input", "output"]


class PortRow(TypedDict):
    """A port of the needed interface, or one that is only in the found interface (``extra``).

    ``needed`` and ``found`` are texts such as ``output 2 [m] from u``; None where the port is not there. ``status`` is the first
    that applies. An ``extra`` input has to be connected, an ``extra`` output need not; a ``missing`` port matters only where it
    is connected. Other feedthrough is not an obstacle: a loop may then be solved in another order.
    """

    name: str
    status: Status
    needed: str | None
    found: str | None


def compare_ports(needed: Interface, found: Interface) -> list[PortRow]:
    """Hold the ports of ``found`` against those of ``needed``, by name: the needed ones in their order, then the extra ones."""
    wanted, there = _ports(needed), _ports(found)
    rows: list[PortRow] = [
        {
            "name": name,
            "status": _status(port, there.get(name)),
            "needed": _text(needed, *port),
            "found": _text(found, *there[name]) if name in there else None,
        }
        for name, port in wanted.items()
    ]
    for name, port in there.items():
        if name not in wanted:
            rows.append({"name": name, "status": "extra", "needed": None, "found": _text(found, *port)})
    return rows


def _ports(interface: Interface) -> Mapping[str, tuple[Causality, Signal]]:
    inputs: dict[str, tuple[Causality, Signal]] = {signal.name: ("input", signal) for signal in interface.inputs}
    return inputs | {signal.name: ("output", signal) for signal in interface.outputs}


def _status(needed: tuple[Causality, Signal], found: tuple[Causality, Signal] | None) -> Status:
    if found is None:
        return "missing"
    if found[0] != needed[0]:
        return "wrong causality"
    if found[1].size != needed[1].size:
        return "other size"
    return "ok" if same_unit(needed[1].unit, found[1].unit) else "other unit"


def _text(interface: Interface, causality: Causality, signal: Signal) -> str:
    text = f"{causality} {signal.size}{f' [{signal.unit}]' if signal.unit else ''}"
    if causality == "input":
        return text
    feeds = "unknown inputs" if interface.feedthrough is None else ", ".join(interface.feeds(signal.name))
    return f"{text} from {feeds}" if feeds else text
