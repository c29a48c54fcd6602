"""From the text of a scenario to its validated tables, with every problem that shows without building anything."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from cosim.core.connections import Connection
from cosim.errors import CosimError, ScenarioError, nearest
from cosim.scenario.document import FLAT, Document, Key, Problem, flatten
from cosim.scenario.kinds import KINDS, Kind
from cosim.scenario.problems import problems_of
from cosim.scenario.schema import File

Problems = list[Problem]


@dataclass(frozen=True)
class Parsed:
    """The tables of a scenario file.

    Parameters
    ----------
    document : Document
    file : File
    specs : mapping of component name to Kind
    connections : mapping of ``component.input`` to Connection
    tree : mapping
        As they stand in the file, changes applied.
    """

    document: Document
    file: File
    specs: Mapping[str, Kind]
    connections: Mapping[str, Connection]
    tree: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.scenario.name

    def driver(self, to: str) -> str | None:
        """Give the component that drives an input, ``component.input``."""
        connection = self.connections.get(to)
        return connection.sources[0].component if connection is not None else None


def read(document: Document) -> tuple[Parsed, Problems]:
    """Read and validate a document; give what is wrong with it beside it, where the rest can be judged.

    Raises
    ------
    ScenarioError
        With every problem, where nothing more can be judged.
    """
    tree, problems = document.tree()
    for table in FLAT:  # once more, for what was set
        if isinstance(tree.get(table), dict):
            tree[table], more = flatten(tree[table], (table,))
            problems += more
    try:
        file = File.model_validate(tree)
    except ValidationError as error:
        problems += problems_of(error, File, tree, ())
        specs, more = _specs(tree.get("components", {}))
        raise report(document, [*problems, *more]) from error
    specs, more = _specs(file.components)
    wires = {}
    for to, given in file.connections.items():
        parts = (
            (given,)
            if isinstance(given, str)
            else (given.source, given.gain, given.offset, given.unit)
        )
        try:
            wires[to] = Connection(*parts)
        except CosimError as error:
            more.append((("connections", to), str(error)))
            with suppress(CosimError):
                wires[to] = Connection(parts[0])
    return Parsed(document, file, specs, wires, tree), [*problems, *more]


def _specs(tables: Any) -> tuple[dict[str, Kind], Problems]:
    specs: dict[str, Kind] = {}
    problems: Problems = []
    for name, table in tables.items() if isinstance(tables, dict) else ():
        key: Key = ("components", name)
        if not isinstance(table, dict):
            continue
        kind = str(table.get("kind"))
        if kind not in KINDS:
            said = f"unknown kind {kind!r}" if "kind" in table else "'kind' is missing"
            problems.append(
                ((*key, "kind") if "kind" in table else key, f"{said}; {nearest(kind, KINDS)}")
            )
            continue
        try:
            specs[name] = KINDS[kind].model_validate(table)
        except ValidationError as error:
            problems += problems_of(error, KINDS[kind], table, key)
    return specs, problems


def report(document: Document, problems: Iterable[Problem]) -> ScenarioError:
    """Put problems into one error, each with its place; one that several components run into is told once."""
    first: dict[str, Key] = {}
    for key, text in problems:
        first.setdefault(text, key)
    lines = []
    for text, key in first.items():
        lines += [f"{document.label(key)}: {line}" for line in text.splitlines()]
    return ScenarioError("\n".join(lines))
