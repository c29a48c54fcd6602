"""Inputs of a recorded component that its map names: outputs, in the place of what drives them.

``plant.u`` of samples from the field is what the plant was driven with. An observer that takes the
same signal, ``u.y``, has to take what was recorded too, else it would see the difference as a
disturbance: ``"plant.u" = "u.y"`` and ``"observer.u" = "u.y"`` become ``"observer.u" = "plant.u"``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.errors import GraphError
from cosim.scenario.document.problems import Problem
from cosim.scenario.document.swap import MapEntry

Connections = Mapping[Port, Connection]
Maps = Mapping[str, list[MapEntry]]


@dataclass(frozen=True, slots=True)
class RecordedInput:
    """An input whose recorded values others take.

    Parameters
    ----------
    port : Port
        Of the recorded component, an output of it now.
    replaced : tuple of Port
        Outputs that drove it.
    followers : tuple of Port
        Inputs that took one of these and take the recorded values now.
    """

    port: Port
    replaced: tuple[Port, ...]
    followers: tuple[Port, ...]

    def text(self) -> str:
        """Return what that means, in words."""
        drivers = ", ".join(map(str, self.replaced))
        if not self.followers:
            return f"'{self.port}' is recorded; nothing else takes {drivers}"
        followers = ", ".join(map(str, self.followers))
        takes = "takes" if len(self.followers) == 1 else "take"
        return f"'{self.port}' is recorded: {followers} {takes} it in the place of {drivers}"


def with_recorded_inputs(
    without_inputs: Iterable[str], maps: Maps, connections: Connections, written: Connections
) -> tuple[dict[str, list[MapEntry]], dict[Port, Connection], list[RecordedInput], list[Problem]]:
    """Return maps and connections in which recorded inputs are outputs.

    Parameters
    ----------
    without_inputs : iterable of str
        The components that follow no inputs.
    maps : mapping of component name to list of MapEntry
    connections : mapping of Port to Connection
        Without those to these components.
    written : mapping of Port to Connection
        With them.

    Returns
    -------
    maps, connections
    list of RecordedInput
    list of Problem
        Of entries whose values nobody else can take.
    """
    changed_maps = dict(maps)
    changed = dict(connections)
    inputs: list[RecordedInput] = []
    problems: list[Problem] = []
    for name in without_inputs:
        entries = []
        for entry in maps.get(name, []):
            if entry.renaming.causality == "input":
                try:
                    replacements = _replacements(entry, written)
                except GraphError as error:
                    problems.append((entry.key, str(error)))
                    continue
                followers = _replace(changed, replacements)
                port = entry.renaming.port
                inputs.append(RecordedInput(port, tuple(replacements), tuple(followers)))
                entry = replace(entry, renaming=replace(entry.renaming, causality="output"))
            entries.append(entry)
        if name in maps:
            changed_maps[name] = entries
    return changed_maps, changed, inputs, problems


def _replacements(entry: MapEntry, written: Connections) -> dict[Port, Port]:
    """Return which port takes the place of each of those that drive an input.

    Raises
    ------
    GraphError
        If what drives it is not what was recorded.
    """
    port = entry.renaming.port
    connection = written.get(port)
    if connection is None:
        drivers = [str(to) for to in written if to.whole == port.whole]
        raise GraphError(
            f"'{port}' is connected by its elements; expected the ports of [connections]: "
            f"{', '.join(drivers)}"
        )
    label = connection.label
    gain = connection.matrix
    if gain.ndim or gain != 1.0 or connection.offset or connection.unit is not None:
        raise GraphError(
            f"'{port}' takes {label} with a gain, an offset or a unit, so its recorded values are "
            f"not those of {label}; swap {connection.sources[0].component!r}, too, and map "
            f"'{connection.sources[0]}'"
        )
    sources = connection.sources
    if len(sources) == 1:
        return {sources[0]: port}
    names = entry.renaming.sources
    if len(names) != len(sources):
        raise GraphError(
            f"'{port}' takes {len(sources)} signals, {label}; expected one name for each in its "
            f"map, got {len(names)}"
        )
    return {source: replace(port, element=index) for index, source in enumerate(sources)}


def _replace(connections: dict[Port, Connection], replacements: Mapping[Port, Port]) -> list[Port]:
    """Replace sources of connections; return the inputs whose sources were replaced."""
    followers = []
    for to, connection in connections.items():
        sources = [_replaced(source, replacements) for source in connection.sources]
        if sources != list(connection.sources):
            followers.append(to)
            connections[to] = Connection(
                sources, connection.gain, connection.offset, connection.unit
            )
    return followers


def _replaced(source: Port, replacements: Mapping[Port, Port]) -> Port:
    """Return what takes the place of a source, also where it is an element of what is replaced."""
    if source in replacements:
        return replacements[source]
    whole = replacements.get(source.whole)
    if whole is not None and whole.element is None:
        return replace(whole, element=source.element)
    return source
