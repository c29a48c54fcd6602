"""Edits of a scenario's tables from outside: keys with dots, and values as TOML has them.

``components.NAME.PARAMETER`` always is a component's. ``NAME.PARAMETER`` is the same, unless NAME
is that of a table of the file: then it is in that table.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping
from copy import deepcopy
from typing import Any

import numpy as np

from cosim.core.connections import ONE_SOURCE
from cosim.errors import UsageError, nearest, option, quoted
from cosim.scenario.document.elements import element_at, numbered, split_elements, written
from cosim.scenario.document.lines import MOST_LEVELS, key_lines
from cosim.scenario.document.problems import Key, Problem
from cosim.scenario.document.schema import RecordTable, Settings

SET = "(set)"  # first part of the key of a problem with a change, which stands in no file
FLAT = ("connections", "truth")  # tables whose keys are the names of ports
ACTIONS = "actions"  # a list of tables
# what a dotted key may begin with, beside a component
TABLES = ("scenario", "models", *FLAT, ACTIONS, "record")
COMPONENTS = "components"
_NOT_COMPONENTS = (*TABLES, "swap", COMPONENTS)  # none that a short key could begin with


def short(key: str) -> str:
    """Return the form of a dotted key that is the same however it was written.

    That of a component is without ``components.``, unless its name is that of a table. An action is
    ``actions.0``, also where it was written ``actions[0]``.
    """
    first, dot, rest = key.partition(".")
    if first == COMPONENTS and split_elements(rest.partition(".")[0])[0] not in _NOT_COMPONENTS:
        return rest or key
    if first.startswith(f"{ACTIONS}["):
        name, indices = split_elements(first)
        first = ".".join([name, *indices])
    return f"{first}{dot}{rest}"


def component_in(key: str) -> str | None:
    """Return the component that a dotted key is about; None: it is in another table."""
    first, _, rest = key.partition(".")
    if first == COMPONENTS and rest:
        return rest.partition(".")[0]
    return None if first in _NOT_COMPONENTS else first


# --- values ---


def parse_value(text: str) -> Any:
    """Read a value from the command line: TOML where it is TOML, else a string.

    Raises
    ------
    UsageError
        If it is TOML, but nested too deep, or a number has too many digits.
    """
    written = f"value = {text}"
    try:
        key_lines(written).check_depth()
        table = tomllib.loads(written)
    except UsageError as error:
        raise UsageError(f"{quoted(text)}: {error}") from error
    except tomllib.TOMLDecodeError:
        return text
    except ValueError as error:  # of Python's int
        raise UsageError(f"{quoted(text)}: {TOO_MANY_DIGITS}") from error
    return table["value"] if len(table) == 1 else text


TOO_MANY_DIGITS = "an integer has too many digits; expected at most 64 bits"


def plain(value: Any, level: int = 0) -> Any:
    """Return arrays and tuples as the lists that TOML would have.

    Raises
    ------
    UsageError
        If it is nested too deep, or TOML cannot have it.
    """
    if level > MOST_LEVELS:
        raise UsageError(
            f"expected tables and lists nested at most {MOST_LEVELS} levels deep, got more"
        )
    match value:
        case np.ndarray() | np.generic():
            return plain(value.tolist(), level + 1)
        case Mapping():
            return _plain_table(value, level + 1)
        case list() | tuple():
            return [plain(item, level + 1) for item in value]
        case bool() | int() | float() | str():
            return value
        case complex():
            return str(value)  # as TOML can have it
    raise UsageError(
        f"expected a number, true or false, a string, a list or a table, got {quoted(value)}"
    )


def _plain_table(table: Mapping[Any, Any], level: int) -> dict[str, Any]:
    values = {}
    for key, item in table.items():
        if not isinstance(key, str):
            raise UsageError(f"expected a string as key of a table, got {quoted(key)}")
        values[key] = plain(item, level)
    return values


# --- tables ---


def flatten_tables(tree: dict[str, Any]) -> list[Problem]:
    """Write the ports of a scenario's tables as one dotted key each."""
    problems: list[Problem] = []
    for name in FLAT:
        if isinstance(tree.get(name), dict):
            tree[name], repeated = _flatten(tree[name], (name,))
            problems += repeated
    swaps = tree.get("swap")
    for name, table in swaps.items() if isinstance(swaps, dict) else ():
        if isinstance(table, dict) and isinstance(table.get("map"), dict):
            table["map"], repeated = _flatten(table["map"], ("swap", name, "map"))
            problems += repeated
    actions = tree.get(ACTIONS)
    for number, table in enumerate(actions if isinstance(actions, list) else ()):
        if isinstance(table, dict) and isinstance(table.get("set"), dict):
            table["set"], repeated = _flatten(table["set"], (ACTIONS, number, "set"))
            problems += repeated
    return problems


def _without_table(key: str) -> str:
    """Return a key that an action sets, which is always that of a component, in its short form."""
    rest = key.removeprefix(f"{COMPONENTS}.")
    return rest if "." in rest else key


def given_twice(key: str, table: str) -> str:
    """Return what to say of a key that a table of the scenario has twice, or of a table."""
    if key.startswith("["):
        return f"the table {key} is given twice; put its keys below one heading"
    match table:
        case "connections":
            reason = ONE_SOURCE
        case "truth":
            reason = "an estimate has one true value"
        case _:
            reason = "remove one"
    return f"{key} is given twice; {reason}"


def _flatten(tree: Mapping[str, Any], prefix: Key) -> tuple[dict[str, Any], list[Problem]]:
    """Return a table with every port as one dotted key, and the problems of that.

    ``plant.u = ...`` and ``"plant.u" = ...`` mean the same.
    """
    flat: dict[str, Any] = {}
    problems: list[Problem] = []
    for key, value in tree.items():
        pairs = {key: value}
        if isinstance(value, dict) and "." not in key:
            pairs = {f"{key}.{inner}": item for inner, item in value.items()}
        for name, item in pairs.items():
            port = _without_table(name) if prefix[0] == ACTIONS else name
            if port in flat:
                text = given_twice(f"'{port}'", str(prefix[0]))
                problems.append(((*prefix, port), text))
            flat[port] = item
    return flat, problems


def change(tree: dict[str, Any], key: str, value: Any) -> str | None:
    """Set a value in the tables; return the problem of that, if there is one."""
    is_other = component_in(key) is None  # it is in a table beside [components]
    first, *rest = (key if is_other else key.removeprefix(f"{COMPONENTS}.")).split(".")
    if is_other and first in _keys(tree, COMPONENTS) and not _is_in_table(tree, first, rest):
        long = option("set", f"{COMPONENTS}.{key}")
        return f"{first!r} is a table of the scenario, and a component; of the component: {long}"
    if is_other and first == ACTIONS:
        return _set_action(tree, rest, value)
    if not rest and (is_other or not isinstance(value, dict)):
        example = option("set", "observer.filter_rate", "500")
        return f"expected COMPONENT.PARAMETER, such as {example}, got no dot"
    is_other &= first in TABLES
    table = tree.setdefault(first if is_other else COMPONENTS, {})
    if not isinstance(table, dict):  # the schema of the file names that
        return None
    if is_other and first in FLAT:
        _set_port(table, rest, value)
        return None
    if is_other:
        return _set_value(table, rest, value, (first,))
    if rest and first not in table:
        return f"unknown component {first!r}; {nearest(first, [*table, *TABLES])}"
    return _set_value(table, [first, *rest], value, (COMPONENTS,))


def _is_in_table(tree: Mapping[str, Any], name: str, path: list[str]) -> bool:
    """Return whether a table of the file may have a key, as far as its first part shows."""
    part, _ = split_elements(path[0]) if path else ("", [])
    match name:
        case "scenario":
            return part in Settings.model_fields
        case "record":
            return part in RecordTable.model_fields
        case "models":
            return part in _keys(tree, name)
        case "actions":
            return part.isdigit() or not path
    return name in FLAT and part in _keys(tree, COMPONENTS)


def _keys(tree: Mapping[str, Any], name: str) -> Collection[str]:
    table = tree.get(name)
    return table if isinstance(table, dict) else ()


def _set_action(tree: dict[str, Any], path: list[str], value: Any) -> str | None:
    """Set all actions, or a key of one; return the problem of that, if there is one."""
    if not path:
        tree[ACTIONS] = deepcopy(value)
        return None
    actions = tree.get(ACTIONS, [])
    number, *inner = path
    if not isinstance(actions, list):  # the schema of the file names that
        return None
    if number not in map(str, range(len(actions))):
        return f"unknown action {number!r}; {numbered(len(actions))}"
    table = actions[int(number)]
    if not inner or not isinstance(table, dict):
        actions[int(number)] = deepcopy(value)
        return None
    if inner[0] == "set" and len(inner) > 1 and isinstance(table.get("set"), dict):
        _set_port(table["set"], _without_table(".".join(inner[1:])).split("."), value)
        return None
    return _set_value(table, inner, value, (ACTIONS, int(number)))


def _set_value(table: dict[str, Any], path: list[str], value: Any, place: Key) -> str | None:
    """Set a value in a table or in what is inside it; return the problem of that, if there is one.

    Tables are made where there are none, lists are not. ``place`` is where the table stands.
    """
    part, *inner = path
    name, indices = split_elements(part)
    if indices and not _is_name(table, part, place):
        return _set_element(table, [name, *indices], inner, value, place)
    if not inner:
        table[part] = deepcopy(value)  # a later change may reach into it
        return None
    if not isinstance(table.setdefault(part, {}), dict):
        table[part] = {}
    return _set_value(table[part], inner, value, (*place, part))


def _is_name(table: Mapping[str, Any], part: str, place: Key) -> bool:
    """Return whether a part of a key is a name, though it looks like an element of a list.

    The tables inside a component's have names of signals, such as ``start = { "x[0]" = 1.0 }``.
    """
    if part in table:
        return True
    name, _ = split_elements(part)
    return len(place) == 3 and place[0] == "components" and name not in table


def _set_element(
    table: dict[str, Any], path: list[str], inner: list[str], value: Any, place: Key
) -> str | None:
    """Set an element of a list, or what is inside it; return the problem of that, if any.

    ``path`` is the name of the list in the table, and the indices.
    """
    name, *indices = path
    place = (*place, name)
    items: Any = table.get(name)
    for index in indices[:-1]:
        number, problem = element_at(items, place, index)
        if problem is not None:
            return problem
        items = items[number]
        place = (*place, number)
    number, problem = element_at(items, place, indices[-1])
    if problem is not None:
        return problem
    if not inner:
        items[number] = deepcopy(value)
        return None
    entry = items[number]
    place = (*place, number)
    if not isinstance(entry, dict):
        return f"{written(place)}: expected a table, got {quoted(entry)}"
    return _set_value(entry, inner, value, place)


def _set_port(table: dict[str, Any], port: list[str], value: Any) -> None:
    """Set the entry of a port, in whichever of the two spellings it was written."""
    nested = table.get(port[0])
    if isinstance(nested, dict):
        nested.pop(".".join(port[1:]), None)
    table[".".join(port)] = value
