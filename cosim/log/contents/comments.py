"""Comments in the schema of a component that describe each field to people."""

from __future__ import annotations

from cosim.core.signals import Signal
from cosim.log.contents.layout import Part
from cosim.units import with_unit


def part_comment(part: Part) -> str:
    """Return what a channel holds: ``plant, descriptor``."""
    name = part.channel.name
    return f"{name}, {part.kind}" if part.kind else name


def element_comments(part: Part) -> list[str]:
    """Return what each element of a part is: ``x[0] [m], state: positions of the masses``.

    The description of a signal stands at its first element only, as it may have thousands.
    """
    interface = part.channel.interface
    texts: list[str] = []
    for signal in interface.inputs:
        texts += _signal_comments(signal, "input")
    for signal in interface.outputs:
        texts += _signal_comments(signal, signal.role)
    return texts[part.columns]


def _signal_comments(signal: Signal, role: str) -> list[str]:
    kind = role if signal.type == "real" else f"{role}, {signal.type}"
    comments = []
    for name, unit in zip(signal.elements, signal.measures, strict=True):
        comments.append(f"{with_unit(name, unit.name)}, {kind}")
    if signal.description:
        comments[0] += f": {signal.description}"
    return comments
