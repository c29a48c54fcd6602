"""From the text of a scenario to its validated tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.errors import CosimError, nearest
from cosim.scenario.document import Document
from cosim.scenario.kinds import KINDS, Kind
from cosim.scenario.problems import Key, Problem, problems_of
from cosim.scenario.schema import ConnectionTable, File
from cosim.scenario.swap import MapEntry, PortNames, resolve_maps


@dataclass(frozen=True)
class Scenario:
    """A validated scenario.

    Parameters
    ----------
    document : Document
    file : File
    specs : mapping of component name to Kind
    connections : mapping of input Port to Connection
    maps : mapping of component name to list of MapEntry
        Of the swapped components.
    tree : mapping
        The tables as they stand in the file, edits applied.
    parse : callable
        Makes a scenario of an edited document (:func:`cosim.scenario.build.parse`).
    """

    document: Document
    file: File
    specs: Mapping[str, Kind]
    connections: Mapping[Port, Connection]
    maps: Mapping[str, list[MapEntry]]
    tree: Mapping[str, Any]
    parse: Callable[[Document], Scenario] = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.scenario.name

    def driver(self, to: Port) -> str | None:
        """Return the component that drives an input alone.

        None: nothing drives it, or sources of several components do.
        """
        if to not in self.connections:
            return None
        drivers = {source.component for source in self.connections[to].sources}
        return drivers.pop() if len(drivers) == 1 else None

    def edit(
        self,
        *,
        swap: Mapping[str, str | Path] | None = None,
        map: Mapping[str, PortNames] | None = None,
        set: Mapping[str, Any] | None = None,
    ) -> Scenario:
        """Return the scenario with components swapped, their ports mapped, then values set.

        Raises
        ------
        ScenarioError
            With every problem of the file and of these edits.
        """
        document = self.document
        if swap or map:
            document = document.with_swaps(swap or {}, map)
        if set:
            document = document.with_changes(set)
        return self.parse(document)

    def swap(self, *, map: Mapping[str, PortNames] | None = None, **paths: str | Path) -> Scenario:
        """Replace components by an FMU (.fmu) or by a recorded component (.mcap).

        ``map`` gives the names that ports have there, such as ``{"observer.y": "out1"}``; see
        :mod:`cosim.scenario.swap`.
        """
        return self.edit(swap=paths, map=map)

    def set(self, changes: Mapping[str, Any]) -> Scenario:
        """Set values by dotted key, such as ``{"observer.filter_rate": 500.0}``."""
        return self.edit(set=changes)


def read(
    document: Document, parse: Callable[[Document], Scenario]
) -> tuple[Scenario, list[Problem]]:
    """Read and validate a document; return its problems too, where the rest can be checked.

    Parameters
    ----------
    document : Document
    parse : callable
        For edits of the scenario.

    Raises
    ------
    ScenarioError
        With every problem, where the rest cannot be checked.
    """
    tree, problems = document.tree()
    try:
        file = File.model_validate(tree)
    except ValidationError as error:
        problems += problems_of(error, File, tree, ())
        _, more = _validate_components(tree.get("components"))
        raise document.report([*problems, *more]) from error
    maps, map_problems = resolve_maps(tree, document.maps)
    specs, component_problems = _validate_components(file.components)
    connections, connection_problems = _connections(file)
    problems += [*map_problems, *component_problems, *connection_problems]
    scenario = Scenario(document, file, specs, connections, maps, tree, parse)
    return scenario, problems


def _validate_components(tables: Any) -> tuple[dict[str, Kind], list[Problem]]:
    """Return the components' tables by name, and the problems of the others."""
    specs: dict[str, Kind] = {}
    problems: list[Problem] = []
    for name, table in tables.items() if isinstance(tables, dict) else ():
        if not isinstance(table, dict):  # the schema of the file names that
            continue
        key: Key = ("components", name)
        kind = str(table.get("kind"))
        if "kind" not in table:
            problems.append((key, f"'kind' is missing; {nearest(kind, KINDS)}"))
        elif kind not in KINDS:
            text = f"unknown kind {kind!r}; {nearest(kind, KINDS)}"
            problems.append(((*key, "kind"), text))
        else:
            try:
                specs[name] = KINDS[kind].model_validate(table)
            except ValidationError as error:
                problems += problems_of(error, KINDS[kind], table, key)
    return specs, problems


def _connections(file: File) -> tuple[dict[Port, Connection], list[Problem]]:
    """Return the connections by input, and their problems; a wrong gain leaves the sources."""
    connections: dict[Port, Connection] = {}
    problems: list[Problem] = []
    for to, value in file.connections.items():
        try:
            port = Port.parse(to)
            if isinstance(value, ConnectionTable):
                connections[port] = Connection(value.source)
                connections[port] = Connection(value.source, value.gain, value.offset, value.unit)
            else:
                connections[port] = Connection(value)
        except CosimError as error:
            problems.append((("connections", to), str(error)))
    return connections, problems
