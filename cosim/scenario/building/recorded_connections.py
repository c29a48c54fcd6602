"""The connections of a replay: what the run took as it is, is taken so again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from cosim.core.connections import AS_IS, Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recording import Recording
from cosim.core.signals import Interface
from cosim.errors import LogError, quoted
from cosim.log.contents.metadata import json_table


def as_in_run(
    connections: Mapping[Port, Connection],
    recording: Recording,
    components: Mapping[str, Component],
) -> dict[Port, Connection]:
    """Return the connections of a replay, ``unit = "as is"`` where the run converted nothing.

    An earlier version of cosim knew fewer units than this one, and took values in others as they
    are. Units and connections that are not as they were then are left as they stand.

    Parameters
    ----------
    connections : mapping of Port to Connection
        By input, as the scenario has them.
    recording : Recording
    components : mapping of component name to Component
        As they are built again.

    Raises
    ------
    LogError
        If a recorded connection cannot be understood.
    """
    declared = declared_channels(recording.channels)
    before = {name: channel.interface for name, channel in declared.items()}
    again = {name: component.interface for name, component in components.items()}
    recorded = recording.metadata.get("cosim.connections", {})
    found = {}
    for to, connection in connections.items():
        units = list(_units(to, connection, before))
        is_kept = units == list(_units(to, connection, again)) and connection.unit is None
        differ = len({unit for unit in units if unit is not None}) > 1
        if is_kept and differ and str(to) in recorded:
            try:
                values = json_table(recorded[str(to)])
            except ValueError as error:
                text = f"recorded connection to {quoted(str(to))}: {error}"
                raise LogError(f"{recording.label}: {text}") from error
            if "conversions" not in values and values.get("from") == connection.label:
                connection = replace(connection, source=connection.sources, unit=AS_IS)
        found[to] = connection
    return found


def _units(
    to: Port, connection: Connection, interfaces: Mapping[str, Interface]
) -> Iterator[str | tuple[str, ...] | None]:
    """Yield the units of an input and of what drives it, as they are declared."""
    for port in (to, *connection.sources):
        interface = interfaces.get(port.component)
        signal = None if interface is None else interface.by_name.get(port.signal)
        yield None if signal is None else signal.unit
