"""Put a component in the place of another, under the names that its ports have: on the tables of a scenario file.

A swap replaces the component's whole table. Its map renames ports, ``PORT = NAME``: PORT is a port as the scenario writes it,
NAME the port of the new component that takes its place::

    observer.y = "out1"     the input observer.y, which the swapped component drives, now comes from its output out1
    plant.u = "force"       what drove plant.u now drives plant.force
    plant.y = "out1"        everything that plant.y drove, and every truth that names it, now comes from plant.out1

The more exact of two entries holds: ``observer.y`` before ``plant.y``, ``plant.x_a[0]`` before ``plant.x_a``. All swaps of a
scenario are made at once, so an entry always speaks of the names before.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.errors import UsageError, nearest

Key = tuple[str | int, ...]
Tree = dict[str, Any]
MAP = "--map"  # what the key of a problem begins with that is the option's alone


@dataclass(frozen=True, slots=True)
class Swap:
    """A component's successor.

    Parameters
    ----------
    path : str
        Of an .fmu, ``x.fmu#me`` or ``x.fmu#cs`` where it is for both, or of a recorded log (.mcap).
    map : mapping of port, as the scenario writes it, to the name of the successor's port
    """

    path: str
    map: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Swapped:
    """What became of a scenario's tables.

    Parameters
    ----------
    swaps : mapping of component name to Swap
        All of them, those of the file too.
    origins : mapping of a key in [connections] or [truth] to the keys in [swap] that made it what it is
    problems : list of (key, text)
    """

    swaps: Mapping[str, Swap]
    origins: Mapping[Key, tuple[Key, ...]]
    problems: list[tuple[Key, str]]


def apply(tree: Tree, paths: Mapping[str, str], maps: Mapping[str, str]) -> Swapped:
    """Make every swap, those of [swap] and those given from outside, which replace them; leaves all of them in [swap].

    Parameters
    ----------
    tree : dict
        Tables of a scenario; [connections], [truth] and the maps in [swap] have dotted names of ports as keys. Changed here.
    paths : mapping of component name to path
        Swaps from outside.
    maps : mapping of port to name
        Maps from outside; each belongs to the swap of its component, or of the one that drives it.
    """
    tables = {
        name: {"path": one} if isinstance(one, str) else one
        for name, one in _items(tree.get("swap"))
    }
    tables |= {name: {"path": path} for name, path in paths.items()}
    swaps = {
        name: Swap(one["path"], _names(one.get("map")))
        for name, one in tables.items()
        if _has_path(one)
    }
    problems: list[tuple[Key, str]] = [
        (("swap", name), text)
        for name, swap in swaps.items()
        for text in _replace(tree, name, swap.path)
    ]
    swaps = {name: swap for name, swap in swaps.items() if name in tree.get("components", {})}
    wires = _Wires(tree)
    for port, name in maps.items():
        owner = wires.owner(port, swaps)
        if owner is None:
            problems.append(((MAP, port), wires.lost(port, swaps)))
        else:
            swaps[owner] = Swap(swaps[owner].path, {**swaps[owner].map, port: name})
    for owner, swap in swaps.items():
        found = {port: wires.judge(port, owner, name) for port, name in swap.map.items()}
        problems += [(("swap", owner, "map", port), text) for port, text in found.items() if text]
    if tables:
        tree["swap"] = tables | {
            name: _with_map(tables[name], swap.map) for name, swap in swaps.items()
        }
    renamed = _Renamed(tree, swaps)
    return Swapped(swaps, renamed.origins, [*problems, *renamed.problems])


def _items(table: Any) -> Iterable[tuple[str, Any]]:
    return table.items() if isinstance(table, dict) else ()


def _has_path(table: Any) -> bool:
    return isinstance(table, dict) and isinstance(table.get("path"), str)


def _with_map(table: Tree, names: Mapping[str, str]) -> Tree:
    """Add names to the map of an entry; what is wrong with it stays for the schema to tell."""
    given = table.get("map", {})
    return {**table, "map": {**given, **names} if isinstance(given, dict) else given}


def _names(table: Any) -> dict[str, str]:
    """Keep what is a name; the schema tells the rest."""
    return {port: name for port, name in _items(table) if isinstance(name, str)}


def _replace(tree: Tree, name: str, path: str) -> Iterator[str]:
    components = tree.get("components", {})
    if name not in components:
        yield f"there is no component {name!r}; {nearest(name, components)}"
        return
    try:
        components[name] = component_table(name, path)
    except UsageError as error:
        yield str(error)


def component_table(name: str, path: str) -> Tree:
    """Give the table of the component that stands at a path: an .fmu, ``x.fmu#me`` and ``x.fmu#cs`` too, or a log.

    Raises
    ------
    UsageError
        If the path ends in something else.
    """
    suffix = re.fullmatch(r"(?i)(.*\.fmu)#(.*)", path)
    file, interface_type = (suffix[1], suffix[2]) if suffix else (path, None)
    if interface_type not in (None, "me", "cs"):
        raise UsageError(
            f"found '#{interface_type}' behind the path, needed '#me' (model exchange) or '#cs' (co-simulation)"
        )
    match Path(file).suffix.lower():
        case ".fmu":
            return {"kind": "fmu", "path": file} | (
                {"interface_type": interface_type} if interface_type else {}
            )
        case ".mcap":
            return {"kind": "recording", "log": file, "component": name}
        case _:
            raise UsageError(
                f"found {path!r}, needed a path that ends in .fmu (an FMU) or .mcap (a recorded log)"
            )


class _Wires:
    """The ports that a scenario writes."""

    def __init__(self, tree: Tree) -> None:
        self.components = [name for name, _ in _items(tree.get("components"))]
        self.sources = {
            to: source
            for to, wire in _items(tree.get("connections"))
            if (source := _source(wire)) is not None
        }
        truth = dict(_items(tree.get("truth")))
        named = [
            *self.sources.values(),
            *truth,
            *(true for true in truth.values() if isinstance(true, str)),
        ]
        self.outputs = list(dict.fromkeys(form for port in named for form in (port, _base(port))))

    def of(self, component: str) -> list[str]:
        """Give the ports that a map of ``component`` may name."""
        own = [port for port in (*self.sources, *self.outputs) if _component(port) == component]
        driven = [to for to, source in self.sources.items() if _component(source) == component]
        return list(dict.fromkeys([*own, *driven]))

    def owner(self, port: str, swaps: Iterable[str]) -> str | None:
        """Give the swapped component that a port belongs to: its own, else that which drives it."""
        candidates = (_component(port), _component(self.sources.get(port, "")))
        return next((name for name in candidates if name in swaps), None)

    def judge(self, port: str, owner: str, name: str) -> str:
        """Say what is wrong with an entry of the map of ``owner``; empty: nothing."""
        if not name:
            return f"found no name, needed that of a port of the component that takes the place of {owner!r}"
        return "" if port in self.of(owner) else self.lost(port, [owner])

    def lost(self, port: str, swaps: Iterable[str]) -> str:
        """Say why a port is none of a swapped component's."""
        names, component = list(swaps), _component(port)
        there = [one for name in names for one in self.of(name)]
        if not names:
            return "nothing is swapped, so no port gets another name; needed a swap: --swap COMPONENT=PATH, or [swap]"
        if "." not in port:
            return f"found no dot, needed COMPONENT.PORT; {nearest(port, there)}"
        if component not in self.components:
            return f"there is no component {component!r}; {nearest(component, self.components)}"
        if port in self.sources or port in self.outputs:
            needed = " or ".join(map(repr, names))
            return f"{port!r} does not belong to {needed}, nor does that drive it; {nearest(port, there)}"
        return f"the scenario connects no {port!r}; {nearest(port, there)}"


class _Renamed:
    """Rename the ports in [connections] and [truth]."""

    def __init__(self, tree: Tree, swaps: Mapping[str, Swap]) -> None:
        self._swaps = swaps
        self.origins: dict[Key, tuple[Key, ...]] = {}
        self.problems: list[tuple[Key, str]] = []
        for table in ("connections", "truth") if any(swap.map for swap in swaps.values()) else ():
            if isinstance(tree.get(table), dict):
                tree[table] = self._table(table, tree[table])

    def _table(self, table: str, before: Tree) -> Tree:
        after: Tree = {}
        written: dict[str, str] = {}
        for port, value in before.items():
            target, by_target = self._own(port)
            given, by_source = (
                self._driven(port, value) if table == "connections" else self._value(value)
            )
            if target in after:
                key = by_target or self.origins.get((table, target), (("connections", target),))[-1]
                self.problems.append(
                    (key, f"{target!r} is given twice, for {written[target]!r} and {port!r}")
                )
            after[target], written[target] = given, port
            self.origins[table, target] = tuple(key for key in (by_target, by_source) if key)
        return after

    def _own(self, port: str) -> tuple[str, Key | None]:
        """Rename a port by the map of its own component."""
        name, swap = _component(port), self._swaps.get(_component(port))
        for form in (port, _base(port)) if swap else ():
            if swap and swap.map.get(form):
                return f"{name}.{swap.map[form]}{port[len(form) :]}", ("swap", name, "map", form)
        return port, None

    def _driven(self, to: str, wire: Any) -> tuple[Any, Key | None]:
        """Rename the source of a connection: by an entry for the input it drives, else as a port of its own component."""
        source = _source(wire)
        if source is None:
            return wire, None
        name, swap = _component(source), self._swaps.get(_component(source))
        if swap and _component(to) != name and swap.map.get(to):
            found, key = f"{name}.{swap.map[to]}", ("swap", name, "map", to)
        else:
            found, key = self._own(source)  # type: ignore[assignment]
        return (found if isinstance(wire, str) else {**wire, "from": found}), key

    def _value(self, true: Any) -> tuple[Any, Key | None]:
        return self._own(true) if isinstance(true, str) else (true, None)


def _source(wire: Any) -> str | None:
    found = wire.get("from") if isinstance(wire, dict) else wire
    return found if isinstance(found, str) else None


def _component(port: str) -> str:
    return port.partition(".")[0]


def _base(port: str) -> str:
    """Give the signal of an element, ``plant.x`` for ``plant.x[0]``."""
    return re.sub(r"\[\d+\]$", "", port)
