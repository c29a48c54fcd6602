"""Swaps: other components in the place of some of a scenario, and the ports with other names there.

A swap replaces the component's whole table. Its map says what the ports of the scenario are there,
``PORT = NAME``::

    plant.u = "force"             the input plant.u is the input force of the new component
    plant.y = "out[2]"            the output plant.y is one element of its output out
    plant.x_a = ["s1", "s2"]      a vector is made of several, or is a part of one: "s[0:2]"
    observer.y = "out1"           the output that drives observer.y, plant.y, is its output out1
    plant.y = "/drive/state.a"    a field of the messages in an MCAP of another tool

The new component is shown under the scenario's names (:mod:`cosim.blocks.port_map`), so that its
connections, truths and log do not know of the map.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from cosim.core.connections import Connection
from cosim.core.port import Port, named_ports
from cosim.core.signals import Causality, Interface
from cosim.errors import GraphError, UsageError, nearest, option
from cosim.files import file_type
from cosim.scenario.document.places import Key, Problem

if TYPE_CHECKING:
    from cosim.blocks.renaming import Renaming

Tables: TypeAlias = dict[str, Any]
Connections: TypeAlias = Mapping[Port, Connection]
PortNames: TypeAlias = str | Sequence[str]  # ports of the new component; or as text: "[s1, s2]"

SAMPLES = "#samples"  # behind the path of an MCAP of another tool
MAP = "(map)"  # first part of the key of a problem with a map from outside


@dataclass(frozen=True, slots=True)
class MapEntry:
    """An entry of a map.

    Parameters
    ----------
    key : Key
        Where it stands.
    renaming : Renaming
        The port of the swapped component, and what it is in the new one.
    """

    key: Key
    renaming: Renaming


# --- tables ---


def swapped_components(tree: Mapping[str, Any]) -> list[str]:
    """Return the names of the components that [swap] replaces."""
    components = table_of(tree, "components")
    return [name for name in _paths(tree) if name in components]


def replace_components(tree: Tables, paths: Mapping[str, str]) -> list[Problem]:
    """Replace the tables of the swapped components; return the problems of the swaps.

    Parameters
    ----------
    tree : dict
        Tables of a scenario, changed here: [swap] has all swaps in the end.
    paths : mapping of component name to path
        Swaps from outside, which take the place of entries in [swap], their maps too.
    """
    entries = {**table_of(tree, "swap"), **paths}
    if entries:
        tree["swap"] = entries
        for name, entry in entries.items():
            if isinstance(entry, str):
                entries[name] = {"path": entry}
    problems: list[Problem] = []
    components = table_of(tree, "components")
    for name, path in _paths(tree).items():
        if name not in components:
            text = f"unknown component {name!r}; {nearest(name, components)}"
            problems.append((("swap", name), text))
            continue
        try:
            components[name] = component_table(name, path)
        except UsageError as error:
            problems.append((("swap", name), str(error)))
    return problems


def table_of(tree: Mapping[str, Any], name: str) -> Tables:
    """Return a table of a scenario; empty where there is none, or something else."""
    table = tree.get(name)
    return table if isinstance(table, dict) else {}


def _paths(tree: Mapping[str, Any]) -> dict[str, str]:
    """Return the path of every entry in [swap]; the schema names the entries without one."""
    paths: dict[str, str] = {}
    for name, entry in table_of(tree, "swap").items():
        path = entry.get("path") if isinstance(entry, dict) else entry
        if isinstance(path, str):
            paths[name] = path
    return paths


def component_table(name: str, path: str) -> Tables:
    """Return the table of the component that a path names.

    Parameters
    ----------
    name : str
        Of the component that is replaced; it has this name in a recorded log too.
    path : str
        Of an .fmu, ``x.fmu#me`` or ``x.fmu#cs`` where it is for both, of a log (.mcap), or of
        samples: a table (.csv, .xlsx, ...), or ``x.mcap#samples``, of another tool.

    Raises
    ------
    UsageError
        If the path ends in something else.
    """
    if re.fullmatch(rf"(?i).*\.mcap{SAMPLES}", path):
        return {"kind": "field-data", "path": path.removesuffix(SAMPLES)}
    suffix = re.fullmatch(r"(?i)(.*\.fmu)#(.*)", path)
    file = path if suffix is None else suffix[1]
    interface_type = None if suffix is None else suffix[2]
    if interface_type not in (None, "me", "cs"):
        raise UsageError(
            "expected '#me' (model exchange) or '#cs' (co-simulation) after the path, got "
            f"'#{interface_type}'"
        )
    match file_type(file):
        case "FMU":
            table = {"kind": "fmu", "path": file}
            return table if interface_type is None else {**table, "interface_type": interface_type}
        case "log":
            return {"kind": "recording", "log": file, "component": name}
        case "table":
            return {"kind": "field-data", "path": file}
        case _:
            raise UsageError(
                "expected a path that ends in .fmu (an FMU), .mcap (a recorded log), or .csv, "
                f".txt, .parquet, .xlsx, .mat or .mcap{SAMPLES} (samples with their times), got "
                f"{path!r}"
            )


def marked_path(path: str) -> str:
    """Return the path of an MCAP of another tool as that of samples.

    Behind a run its log has the mark: a replay does not look into the file.
    """
    if file_type(path) == "log":
        from cosim.log.foreign.topics import is_foreign  # rarely needed

        if is_foreign(Path(path)):
            return path + SAMPLES
    return path


# --- maps ---


def owner_of(tree: Mapping[str, Any], port: str) -> str | None:
    """Return the swapped component that a port of a map belongs to, or that drives it."""
    return WrittenPorts(tree).owner(port, swapped_components(tree))


def resolve_maps(
    tree: Mapping[str, Any], maps: Mapping[str, PortNames]
) -> tuple[dict[str, list[MapEntry]], list[Problem]]:
    """Return what the maps of all swaps say, by component, and the problems of their entries.

    Parameters
    ----------
    tree : mapping
        Tables of a scenario, swaps applied.
    maps : mapping of port to names
        Maps from outside; each belongs to the swap of its component, or of the one that drives it.
    """
    swapped = swapped_components(tree)
    if not (swapped or maps):
        return {}, []
    ports = WrittenPorts(tree)
    problems: list[Problem] = []
    written: dict[str, dict[str, PortNames]] = {}
    for name in swapped:
        written[name] = table_of(table_of(tree, "swap")[name], "map")
    for port, names in maps.items():
        owner = ports.owner(port, swapped)
        if owner is None:
            text = ports.unknown(port, swapped)
            problems.append(((MAP, port), text))
        else:
            written[owner] = {**written[owner], port: names}
    entries: dict[str, list[MapEntry]] = {}
    for name, table in written.items():
        entries[name], map_problems = _resolve_map(name, table, ports)
        problems += map_problems
    return entries, problems


def _resolve_map(
    component: str, table: Mapping[str, PortNames], ports: WrittenPorts
) -> tuple[list[MapEntry], list[Problem]]:
    """Return the entries of the map of a component, and the problems of the others."""
    from cosim.blocks.renaming import Renaming  # rarely needed

    entries: dict[Port, MapEntry] = {}
    problems: list[Problem] = []
    for written, names in table.items():
        key = ("swap", component, "map", written)
        try:
            port = ports.meant(written, component)
            sources = _sources(component, names)
            renaming = Renaming(port, sources, ports.causality(port))
        except GraphError as error:
            problems.append((key, str(error)))
            continue
        first = entries.setdefault(renaming.port, MapEntry(key, renaming))
        if first.renaming != renaming:
            first_use = f"as {_listed(first.renaming)} for '{first.key[-1]}'"
            second_use = f"as {_listed(renaming)} for '{written}'"
            text = f"'{port}' is given twice, {first_use} and {second_use}; remove one"
            problems.append((key, text))
    return list(entries.values()), problems


def _listed(renaming: Renaming) -> str:
    return ", ".join(repr(source.name) for source in renaming.sources)


def _sources(component: str, names: PortNames) -> tuple[Port, ...]:
    """Return the ports of a component that an entry names.

    Raises
    ------
    GraphError
        If a name is missing or none of a port.
    """
    listed = port_names(names)
    if not listed or "" in listed:
        raise GraphError(
            f"expected the name of a port of the component that replaces {component!r}, got none"
        )
    return tuple(Port.parse(f"{component}.{name}") for name in listed)


def is_map_key(key: Key) -> bool:
    """Return whether a problem's key is that of an entry of a map."""
    return key[:1] == (MAP,) or (key[:1] == ("swap",) and key[2:3] == ("map",))


def unknown_ports(
    tree: Mapping[str, Any], entries: Iterable[MapEntry], replaced: Interface
) -> list[Problem]:
    """Return the problems of entries for ports that nothing knows.

    Parameters
    ----------
    tree : mapping
        Tables of a scenario, swaps applied.
    entries : iterable of MapEntry
        Of the map of one component.
    replaced : Interface
        Of the component that is replaced.
    """
    ports = WrittenPorts(tree)
    own_names = [signal.name for signal in replaced.signals]
    problems: list[Problem] = []
    for entry in entries:
        port = entry.renaming.port
        if ports.has(port) or not {port.name, port.signal}.isdisjoint(own_names):
            continue
        own_ports = [f"{port.component}.{name}" for name in own_names]
        known = dict.fromkeys([*ports.of(port.component), *own_ports])
        text = (
            f"unknown port '{port}': neither connected nor a port of the replaced component; "
            f"{nearest(str(port), known)}"
        )
        problems.append((entry.key, text))
    return problems


def is_port_names(value: object) -> bool:
    """Return whether a value from outside is a name or a list of names."""
    names = value if isinstance(value, list | tuple) else (value,)
    return all(isinstance(name, str) for name in names)


def port_names(names: PortNames) -> list[str]:
    """Return the names in an entry of a map: one, a list, or a text such as ``[s1, s2]``.

    Names in a text may be in quotes, as they are in a file.

    Raises
    ------
    GraphError
        If a list is not closed.
    """
    if not isinstance(names, str):
        return list(names)
    text = names.strip()
    if text.startswith("[") and text.count("[") != text.count("]"):
        raise GraphError(f"expected [NAME, NAME], got {names!r}")
    listed = re.fullmatch(r"\[(.*)\]", text)
    if listed is None:
        return [names]
    return [_unquoted(name.strip()) for name in listed[1].split(",")]


def _unquoted(name: str) -> str:
    quoted = re.fullmatch(r"""(["'])(.*)\1""", name)
    return name if quoted is None else quoted[2]


class WrittenPorts:
    """The ports that a scenario writes in [connections] and [truth].

    Parameters
    ----------
    tree : mapping
        Tables of a scenario; what is no port in them is left to the schema.
    """

    def __init__(self, tree: Mapping[str, Any]) -> None:
        self._components = list(table_of(tree, "components"))
        self._sources: dict[Port, list[Port]] = {}  # by input
        for to, connection in table_of(tree, "connections").items():
            source = connection.get("from") if isinstance(connection, dict) else connection
            sources = source if isinstance(source, list) else [source]
            for port in ports_in([to]):
                self._sources[port] = ports_in(sources)
        self._outputs: list[Port] = []
        for ports in self._sources.values():
            self._outputs += ports
        self._compared: list[Port] = []
        for estimate, true in table_of(tree, "truth").items():
            self._compared += ports_in([estimate, *named_ports(true)])

    def of(self, component: str) -> list[str]:
        """Return the ports that a map of a component may name."""
        names = []
        for port in (*self._sources, *self._outputs, *self._compared):
            if port.component == component:
                names += [str(port), str(port.whole)]
        for to, sources in self._sources.items():
            if any(source.component == component for source in sources):
                names += [str(to), str(to.whole)]
        return list(dict.fromkeys(names))

    def owner(self, written: str, swapped: Sequence[str]) -> str | None:
        """Return the swapped component that a port belongs to, else the one that drives it."""
        for port in ports_in([written]):
            drivers = [source.component for source in self._driving(port)]
            for name in (port.component, *drivers):
                if name in swapped:
                    return name
        return None

    def meant(self, written: str, component: str) -> Port:
        """Return the port of a component that an entry of its map is for.

        Raises
        ------
        GraphError
            If it is a port of another component that this one does not drive, or drives by
            several. Whether there is a port of this one, :func:`unknown_ports` tells.
        """
        ports = ports_in([written])
        if ports and ports[0].component == component:
            return ports[0]
        driving = self._driving(ports[0]) if ports else []
        own = [source for source in driving if source.component == component]
        sources = list(dict.fromkeys(own))
        if not sources:
            raise GraphError(self.unknown(written, [component]))
        if len(sources) > 1:
            names = ", ".join(map(str, sources))
            raise GraphError(f"{written!r} is driven by several ports; name one of them: {names}")
        return sources[0]

    def _driving(self, to: Port) -> list[Port]:
        """Return what is written to drive an input: as a whole, or else by its elements."""
        if to in self._sources:
            return self._sources[to]
        parts = [sources for part, sources in self._sources.items() if part.whole == to]
        return list(chain.from_iterable(parts))

    def _writes(self, written: str, component: str) -> bool:
        """Return whether a port, or the whole of it, is one that a map of a component may name."""
        names = self.of(component)
        wholes = [str(port.whole) for port in ports_in([written])]
        return not set(names).isdisjoint([written, *wholes])

    def causality(self, port: Port) -> Causality | None:
        """Return what a port must be where the scenario connects it; None: anything."""
        inputs = [to.whole for to in self._sources]
        if port in self._sources or port.whole in inputs:
            return "input"
        wholes = [output.whole for output in self._outputs]
        return "output" if port.whole in wholes else None

    def unknown(self, written: str, swapped: Iterable[str]) -> str:
        """Return why an entry is for no port of the swapped components."""
        names = list(swapped)
        if not names:
            return (
                "a map requires a swapped component: "
                f"{option('swap', 'COMPONENT', 'PATH')}, or [swap]"
            )
        known: list[str] = []
        for name in names:
            known += self.of(name)
        if not ports_in([written]):
            return f"expected COMPONENT.PORT, got no dot; {nearest(written, known)}"
        port = Port.parse(written)
        if port.component not in self._components:
            suggestion = nearest(port.component, self._components)
            return f"unknown component {port.component!r}; {suggestion}"
        if self._writes(written, port.component):
            swapped_names = " or ".join(map(repr, names))
            return (
                f"{written!r} neither belongs to {swapped_names} nor is driven by it; "
                f"{nearest(written, known)}"
            )
        return f"{written!r} is not connected in the scenario; {nearest(written, known)}"

    def has(self, port: Port) -> bool:
        """Return whether the scenario writes a port or one with elements of the same signal."""
        return not {str(port), str(port.whole)}.isdisjoint(self.of(port.component))


def ports_in(values: Iterable[Any]) -> list[Port]:
    """Return those values that are ports."""
    ports = []
    for value in values:
        if isinstance(value, str):
            with suppress(GraphError):
                ports.append(Port.parse(value))
    return ports


# --- recorded inputs ---


@dataclass(frozen=True, slots=True)
class RecordedInput:
    """An input of a recorded component that its map names: an output, in the place of its source.

    ``plant.u`` of samples from the field is what the plant was driven with. An observer that takes
    the same signal, ``u.y``, has to take what was recorded too, else it would see the difference as
    a disturbance: ``"plant.u" = "u.y"`` and ``"observer.u" = "u.y"`` become
    ``"observer.u" = "plant.u"``.

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
    without_inputs: Iterable[str],
    maps: Mapping[str, list[MapEntry]],
    connections: Connections,
    written: Connections,
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
