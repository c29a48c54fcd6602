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
from dataclasses import replace
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
PortNames: TypeAlias = str | Sequence[str]  # ports of the new component; or as text: "[s1, s2]"
Map: TypeAlias = "dict[Key, Renaming]"  # of one component, by where an entry stands

SAMPLES = "#samples"  # behind the path of an MCAP of another tool
MAP = "(map)"  # first part of the key of a problem with a map from outside


# --- tables ---


def table_of(tree: Mapping[str, Any], name: str) -> Tables:
    """Return a table of a scenario; empty where there is none, or something else."""
    table = tree.get(name)
    return table if isinstance(table, dict) else {}


def replace_components(tree: Tables, paths: Mapping[str, str], problems: list[Problem]) -> Tables:
    """Replace the tables of the swapped components; return those that were there.

    Parameters
    ----------
    tree : dict
        Tables of a scenario, changed here: [swap] has all swaps in the end.
    paths : mapping of component name to path
        Swaps from outside, which take the place of entries in [swap], their maps too.
    problems : list of Problem
        Gets those of the swaps.
    """
    replaced: Tables = {}
    components = table_of(tree, "components")
    swaps: Tables = {**table_of(tree, "swap"), **paths}
    for name, entry in swaps.items():
        swaps[name] = {"path": entry} if isinstance(entry, str) else entry
        path = table_of(swaps, name).get("path")
        if not isinstance(path, str):
            continue  # the schema names that
        try:
            if name not in components:
                raise UsageError(f"unknown component {name!r}; {nearest(name, components)}")
            replaced[name] = components[name]
            components[name] = component_table(name, path)
        except UsageError as error:
            problems.append((("swap", name), str(error)))
    if swaps:
        tree["swap"] = swaps
    return replaced


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
    file, _, mark = path.rpartition("#")
    match file_type(file), mark:
        case "FMU", "me" | "cs":
            return {"kind": "fmu", "path": file, "interface_type": mark}
        case "FMU", _:
            raise UsageError(
                "expected '#me' (model exchange) or '#cs' (co-simulation) after the path, got "
                f"'#{mark}'"
            )
        case "log", "samples":
            return {"kind": "field-data", "path": file}
    match file_type(path):
        case "FMU":
            return {"kind": "fmu", "path": path}
        case "log":
            return {"kind": "recording", "log": path, "component": name}
        case "table":
            return {"kind": "field-data", "path": path}
    raise UsageError(
        "expected a path that ends in .fmu (an FMU), .mcap (a recorded log), or .csv, .txt, "
        f".parquet, .xlsx, .mat or .mcap{SAMPLES} (samples with their times), got {path!r}"
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
    return [re.sub(r"""^(["'])(.*)\1$""", r"\2", name.strip()) for name in listed[1].split(",")]


def resolve_maps(
    tree: Mapping[str, Any], maps: Mapping[str, PortNames]
) -> tuple[dict[str, Map], list[Problem]]:
    """Return what the maps of all swaps say, by component, and the problems of their entries.

    Parameters
    ----------
    tree : mapping
        Tables of a scenario, swaps applied.
    maps : mapping of port to names
        Maps from outside, in the place of equal entries in the file; each belongs to the swap of
        its component, or of the one that drives it.
    """
    swaps = table_of(tree, "swap")
    swapped = [name for name in swaps if name in table_of(tree, "components")]
    if not (swapped or maps):
        return {}, []
    from cosim.blocks.renaming import Renaming  # rarely needed

    given: list[tuple[Key, PortNames, list[str]]] = []  # with the components that it may be of
    for name in swapped:
        for text, names in table_of(swaps[name], "map").items():
            if text not in maps:
                given.append((("swap", name, "map", text), names, [name]))
    given += [((MAP, text), names, swapped) for text, names in maps.items()]
    ports = WrittenPorts(tree)
    resolved: dict[str, Map] = {name: {} for name in swapped}
    first_keys: dict[Port, Key] = {}
    problems: list[Problem] = []
    for key, names, owners in given:
        try:
            port = ports.meant(str(key[-1]), owners)
            renaming = Renaming(port, _sources(port.component, names), ports.causality(port))
        except GraphError as error:
            problems.append((key, str(error)))
            continue
        first_key = first_keys.setdefault(port, key)
        first = resolved[port.component].setdefault(first_key, renaming)
        if first != renaming:
            uses = []
            for place, other in ((first_key, first), (key, renaming)):
                listed = ", ".join(repr(source.name) for source in other.sources)
                uses.append(f"as {listed} for '{place[-1]}'")
            problems.append((key, f"'{port}' is given twice, {' and '.join(uses)}; remove one"))
    return resolved, problems


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
    tree: Mapping[str, Any], name: str, own: Map, replaced: Interface
) -> list[Problem]:
    """Return the problems of entries for ports that nothing knows.

    Parameters
    ----------
    tree : mapping
        Tables of a scenario, swaps applied.
    name : str
        Of a component.
    own : Map
        Of it.
    replaced : Interface
        Of the component that is replaced.
    """
    known = dict.fromkeys(WrittenPorts(tree).of(name))
    known |= dict.fromkeys(f"{name}.{signal.name}" for signal in replaced.signals)
    problems: list[Problem] = []
    for key, renaming in own.items():
        port = renaming.port
        if known.keys().isdisjoint({str(port), str(port.whole)}):
            text = (
                f"unknown port '{port}': neither connected nor a port of the replaced component; "
                f"{nearest(str(port), known)}"
            )
            problems.append((key, text))
    return problems


class WrittenPorts:
    """The ports that a scenario writes in [connections] and [truth].

    Parameters
    ----------
    tree : mapping
        Tables of a scenario; what is no port in them is left to the schema.
    """

    def __init__(self, tree: Mapping[str, Any]) -> None:
        self._driving: dict[Port, list[Port]] = {}  # by input, that of an element by the whole, too
        self._outputs: list[Port] = []
        self._compared: list[Port] = []
        for to, connection in table_of(tree, "connections").items():
            source = connection.get("from") if isinstance(connection, dict) else connection
            sources = ports_in(source if isinstance(source, list) else [source])
            self._outputs += sources
            for port in ports_in([to]):
                for end in {port, port.whole}:
                    self._driving.setdefault(end, []).extend(sources)
        for estimate, true in table_of(tree, "truth").items():
            self._compared += ports_in([estimate, *named_ports(true)])
        self._whole_outputs = {output.whole for output in self._outputs}

    def of(self, component: str) -> list[str]:
        """Return the ports that a map of a component may name: its own, and those it drives."""
        ports = [*self._driving, *self._outputs, *self._compared]
        ports = [port for port in ports if port.component == component]
        for to, sources in self._driving.items():
            if any(source.component == component for source in sources):
                ports.append(to)
        names = chain.from_iterable((str(port), str(port.whole)) for port in ports)
        return list(dict.fromkeys(names))

    def meant(self, written: str, swapped: Sequence[str]) -> Port:
        """Return the port of a swapped component that an entry of a map is for.

        Raises
        ------
        GraphError
            If it is a port of another component that none of them drives, or that one drives by
            several. Whether there is a port of a swapped one, :func:`unknown_ports` tells.
        """
        parsed = ports_in([written])
        for port in parsed:
            if port.component in swapped:
                return port
            meant = [one for one in self._driving.get(port, ()) if one.component in swapped]
            own = dict.fromkeys(one for one in meant if one.component == meant[0].component)
            if len(own) > 1:
                names = ", ".join(map(str, own))
                raise GraphError(
                    f"{written!r} is driven by several ports; name one of them: {names}"
                )
            if own:
                return meant[0]
        if not swapped:
            raise GraphError(
                "a map requires a swapped component: "
                f"{option('swap', 'COMPONENT', 'PATH')}, or [swap]"
            )
        problem = "expected COMPONENT.PORT, got no dot"
        if parsed:
            owners = " or ".join(map(repr, swapped))
            problem = f"{written!r} neither belongs to {owners} nor is driven by it"
        known = list(chain.from_iterable(map(self.of, swapped)))
        raise GraphError(f"{problem}; {nearest(written, known)}")

    def causality(self, port: Port) -> Causality | None:
        """Return what a port must be where the scenario connects it; None: anything."""
        if port.whole in self._driving:
            return "input"
        return "output" if port.whole in self._whole_outputs else None


def ports_in(values: Iterable[Any]) -> list[Port]:
    """Return those values that are ports."""
    ports = []
    for value in values:
        if isinstance(value, str):
            with suppress(GraphError):
                ports.append(Port.parse(value))
    return ports


# --- recorded inputs ---


def record_inputs(
    own: Map, connections: dict[Port, Connection], written: Mapping[Port, Connection]
) -> tuple[Map, dict[Port, str], list[Problem]]:
    """Make outputs of the recorded inputs in the map of a component that follows no inputs.

    ``plant.u`` of samples from the field is what the plant was driven with. An observer that takes
    the same signal, ``u.y``, has to take what was recorded too, else it would see the difference as
    a disturbance: ``"plant.u" = "u.y"`` and ``"observer.u" = "u.y"`` become
    ``"observer.u" = "plant.u"``.

    Parameters
    ----------
    own : Map
        Of the component.
    connections : dict of Port to Connection
        Without those to such components; changed here.
    written : mapping of Port to Connection
        With them.

    Returns
    -------
    Map
        Without the entries whose values nobody else can take.
    dict of Port to str
        What follows of each such input, in words.
    list of Problem
        Of the entries that are left out.
    """
    kept: Map = {}
    texts: dict[Port, str] = {}
    problems: list[Problem] = []
    for key, renaming in own.items():
        port = renaming.port
        if renaming.causality != "input":
            kept[key] = renaming
            continue
        try:
            replaced = _replaced(renaming, written)
        except GraphError as error:
            problems.append((key, str(error)))
            continue
        followers = []
        for to, connection in connections.items():
            sources = [_followed(source, replaced) for source in connection.sources]
            if tuple(sources) != connection.sources:
                followers.append(str(to))
                connections[to] = replace(connection, source=sources)
        drivers = ", ".join(map(str, replaced))
        takes = "takes" if len(followers) == 1 else "take"
        text = f"; nothing else takes {drivers}"
        if followers:
            text = f": {', '.join(followers)} {takes} it in the place of {drivers}"
        texts[port] = f"'{port}' is recorded{text}"
        kept[key] = replace(renaming, causality="output")
    return kept, texts, problems


def _replaced(renaming: Renaming, written: Mapping[Port, Connection]) -> dict[Port, Port]:
    """Return which port takes the place of each of those that drive an input.

    Raises
    ------
    GraphError
        If what drives it is not what was recorded.
    """
    port = renaming.port
    connection = written.get(port)
    if connection is None:
        drivers = [str(to) for to in written if to.whole == port.whole]
        raise GraphError(
            f"'{port}' is connected by its elements; expected the ports of [connections]: "
            f"{', '.join(drivers)}"
        )
    sources = connection.sources
    label = connection.label
    gain = connection.matrix
    if gain.ndim or gain != 1.0 or connection.offset or connection.unit is not None:
        raise GraphError(
            f"'{port}' takes {label} with a gain, an offset or a unit, so its recorded values are "
            f"not those of {label}; swap {sources[0].component!r}, too, and map '{sources[0]}'"
        )
    if len(sources) == 1:
        return {sources[0]: port}
    if len(renaming.sources) != len(sources):
        raise GraphError(
            f"'{port}' takes {len(sources)} signals, {label}; expected one name for each in its "
            f"map, got {len(renaming.sources)}"
        )
    return {source: replace(port, element=index) for index, source in enumerate(sources)}


def _followed(source: Port, replaced: Mapping[Port, Port]) -> Port:
    """Return what takes the place of a source, also where it is an element of what is replaced."""
    whole = replaced.get(source.whole)
    if source not in replaced and whole is not None and whole.element is None:
        return replace(whole, element=source.element)
    return replaced.get(source, source)
