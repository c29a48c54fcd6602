"""From the text of a scenario to its validated tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from cosim.core.connections import ONE_SOURCE, Connection
from cosim.core.port import Port
from cosim.errors import CosimError, GraphError, nearest, quoted
from cosim.scenario.document.document import Document
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import ActionTable, ConnectionTable, File
from cosim.scenario.document.swaps import record_inputs, resolve_maps
from cosim.scenario.kinds import KINDS, Kind
from cosim.scenario.kinds.base import Scenario

AnyTable = TypeVar("AnyTable", bound=BaseModel)
STAND_INS = {"name": "unnamed", "stop": 1.0, "step": 1.0}  # for settings without a right value


def read_tables(
    document: Document, parse: Callable[[Document], Scenario]
) -> tuple[Scenario, list[Problem]]:
    """Read and validate a document; return what is right in it, and the problems of the rest.

    Parameters
    ----------
    document : Document
    parse : callable
        For edits of the scenario.

    Raises
    ------
    ScenarioError
        If the text is no TOML.
    """
    tables = document.tables()
    problems = list(tables.problems)
    file, invalid = _validate_tables(tables.tree, problems)
    tree = _without(tables.tree, invalid)
    maps, map_problems = resolve_maps(tree, document.maps)
    problems += map_problems
    specs = _validate_components(file.components, document.foreign_kinds, problems)
    written = _connections(file, problems)
    recorded = [name for name, spec in specs.items() if not spec.follows_inputs]
    connections = {to: written[to] for to in written if to.component not in recorded}
    # what takes the place of another component has its inputs
    originals = {n: tables.replaced[n] for n in specs if n in tables.replaced and n not in recorded}
    replaced = _validate_components(originals, document.foreign_kinds, [])
    implied = _add_implied({**specs, **replaced}, connections, problems)
    notes: list[tuple[str, str]] = []
    for name in recorded:
        outputs: dict[Port, str] = {}
        if name in maps:
            maps[name], outputs, wrong = record_inputs(maps[name], connections, written)
            problems += wrong
        left_out = [to.name for to in written if to.component == name and to not in outputs]
        if left_out:
            text = (
                f"has no inputs: the connections to {', '.join(left_out)} are left out, and what "
                "[truth] compares with need not be true of the data"
            )
            notes.append((name, text))
        notes += [(name, text) for text in outputs.values()]
    invalid |= {key[:2] for key, _ in problems if key[:1] == ("connections",)}
    actions: dict[int, ActionTable] = {}
    for number, table in enumerate(file.actions):
        action = _validated(ActionTable, table, ("actions", number), problems)
        if action is not None:
            actions[number] = action
    scenario = Scenario(
        document,
        file,
        specs,
        connections,
        implied,
        maps,
        tree,
        parse,
        frozenset(invalid),
        actions,
        tuple(notes),
    )
    return scenario, problems


def _validated(
    model: type[AnyTable], table: Any, key: Key, problems: list[Problem]
) -> AnyTable | None:
    """Return a table, which stands at a key; None: it is wrong, and ``problems`` has how."""
    try:
        return model.model_validate(table)
    except TableProblems as error:
        problems += [((*key, *inner), text) for inner, text in error.problems]
    except ValidationError as error:
        problems += problems_of(error, model, table, key)
    return None


def _validate_tables(tree: Mapping[str, Any], problems: list[Problem]) -> tuple[File, set[Key]]:
    """Return the file without what is wrong in it, and the keys of that."""
    try:
        return File.model_validate(tree), set()
    except ValidationError as error:
        problems += problems_of(error, File, tree, ())
        details = error.errors(include_url=False, include_input=False)
    invalid: set[Key] = set()
    for item in details:
        table = item["loc"][0]
        if len(item["loc"]) > 1 and isinstance(tree.get(str(table)), dict):
            invalid.add(item["loc"][:2])
            continue
        invalid.add((table,))
        if item["type"] == "extra_forbidden":
            # probably a table under another name, so that nothing is known of that one
            meant = get_close_matches(str(table), File.model_fields, n=1, cutoff=0.5)
            invalid |= {(name,) for name in meant if name not in tree}
    valid = {"components": {}, **_without(tree, invalid)}
    valid["scenario"] = {**STAND_INS, **valid.get("scenario", {})}
    return File.model_validate(valid), invalid


def _without(tree: Mapping[str, Any], invalid: Collection[Key]) -> dict[str, Any]:
    """Return tables without some of them, and without entries of others."""
    valid: dict[str, Any] = {}
    for name, table in tree.items():
        if (name,) not in invalid:
            valid[name] = table
            if isinstance(table, dict):
                valid[name] = {key: table[key] for key in table if (name, key) not in invalid}
    return valid


def _validate_components(
    tables: Mapping[str, Any], foreign: Collection[str], problems: list[Problem]
) -> dict[str, Kind]:
    """Return the components' tables that are right, by name.

    Where a key is misspelt, the table is taken as it was probably meant: what is connected to the
    component is then checked, too. ``foreign`` are kinds beside the shipped ones that are known to
    be those of packages.
    """
    specs: dict[str, Kind] = {}
    for name, table in tables.items():
        key: Key = ("components", name)
        kind = _kind(table, foreign)
        if isinstance(kind, str):
            problems.append(((*key, "kind") if "kind" in table else key, kind))
            continue
        spec = _validated(kind, table, key, problems)
        if spec is None:
            spec = _validated(kind, _as_meant(kind, table), key, [])
        if spec is not None:
            specs[name] = spec
    return specs


def _as_meant(kind: type[Kind], table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a component's table with the keys that were probably meant for unknown ones."""
    known = [field.alias or name for name, field in kind.model_fields.items()]
    meant = dict(table)
    for key in table:
        if key not in known:
            missing = [name for name in known if name not in meant]
            for close in get_close_matches(key, missing, n=1):
                meant[close] = meant.pop(key)
    return meant


def _kind(table: Mapping[str, Any], foreign: Collection[str]) -> type[Kind] | str:
    """Return the kind of a component's table; a text: why there is none."""
    kind = table.get("kind")
    if isinstance(kind, str) and kind in KINDS:
        return KINDS[kind]
    from cosim.scenario.kinds.user_component import InstalledKind, installed_classes

    if isinstance(kind, str) and (kind in foreign or kind in installed_classes()):
        return InstalledKind
    names = list(dict.fromkeys([*KINDS, *installed_classes()]))
    if "kind" not in table:
        return f"'kind' is missing; available: {', '.join(names)}"
    if not isinstance(kind, str):
        return f"expected a string, got {quoted(kind)}"
    return f"unknown kind {quoted(kind)}; {nearest(kind, names)}"


def _add_implied(
    specs: Mapping[str, Kind], connections: dict[Port, Connection], problems: list[Problem]
) -> dict[Port, Port | None]:
    """Add the connections that kinds imply for inputs that [connections] leaves open.

    Returns
    -------
    dict of Port to Port or None
        The origin of each such input, also where the one that it follows has no connection either.
    """
    given = {port.whole: port for port in connections}
    written = dict(connections)
    origins: dict[Port, Port | None] = {}
    twice: dict[Port, str] = {}  # what drives it is in its component's table
    for name, spec in specs.items():
        for to, implied in spec.implied_connections(name, written, specs).items():
            if to.whole not in given:
                origins[to] = implied.origin
                if implied.connection is not None:
                    connections[to] = implied.connection
            elif implied.origin is None:
                twice[given[to.whole]] = name
    for port, name in twice.items():
        text = f"'{port.whole}' has its source from the table of {name!r}; remove this connection"
        problems.append((("connections", str(port)), text))
    return origins


def _connections(file: File, problems: list[Problem]) -> dict[Port, Connection]:
    """Return the connections by input; a wrong gain leaves the sources."""
    connections: dict[Port, Connection] = {}
    for to, value in file.connections.items():
        try:
            port = Port.parse(to)
            if port in connections:
                raise GraphError(f"'{port}' is given twice; {ONE_SOURCE}")
            if isinstance(value, ConnectionTable):
                connections[port] = Connection(value.source)
                connections[port] = Connection(value.source, value.gain, value.offset, value.unit)
            else:
                connections[port] = Connection(value)
        except CosimError as error:
            problems.append((("connections", to), str(error)))
    return connections
