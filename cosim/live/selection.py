"""Which channels are published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cosim.core.recorded.selection import is_pattern, select_signals
from cosim.core.recorded.signals import find_channel
from cosim.core.signals import Channel
from cosim.log.layout import Part


def selected(
    parts: Sequence[Part], names: Sequence[str], channels: Mapping[str, Channel], *, source: str
) -> list[Part]:
    """Return the parts of components that hold what is named; no names: all of them.

    Parameters
    ----------
    parts : sequence of Part
    names : sequence of str
        Components, signals, elements of signals, or patterns of these: ``*.y``.
    channels : mapping of component name to Channel
    source : str
        Where they are looked for, for the message.

    Raises
    ------
    UnknownSignalError
        If one of them chooses nothing; names the nearest.
    """
    if not names:
        return list(parts)
    wanted: list[tuple[str, slice]] = []
    for name in names:
        if "." not in name and not is_pattern(name):
            channel = find_channel(channels, name, source=source)
            wanted.append((channel.name, slice(0, channel.columns.stop - channel.start)))
            continue
        for port in select_signals(channels, name, source=source).values():
            wanted.append((port.channel.name, port.columns))
    return [part for part in parts if _holds_any(part, wanted)]


def _holds_any(part: Part, wanted: Sequence[tuple[str, slice]]) -> bool:
    own = part.columns
    for component, columns in wanted:
        overlaps = columns.start < own.stop and own.start < columns.stop
        # A component without elements is wanted as a whole.
        is_empty = columns.start == columns.stop
        if component == part.channel.name and (overlaps or is_empty):
            return True
    return False
