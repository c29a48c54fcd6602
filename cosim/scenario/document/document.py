"""The text of a scenario, and the edits made to it from outside.

An edit sets a value at a dotted key. ``components.NAME.PARAMETER`` always is a component's.
``NAME.PARAMETER`` is the same, unless NAME is that of a table of the file: then it is in that
table. ``terms[0].theta`` is in the first entry of a list, ``A[0][1]`` in a row of a matrix. A swap
is an edit, too: of the whole table of a component, before all others.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, replace
from datetime import date, time
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arguments import path_argument
from cosim.core.connections import ONE_SOURCE
from cosim.documents import document, understood
from cosim.errors import GraphError, ScenarioError, UsageError, command, nearest, option, quoted
from cosim.files import file_type, read_bounded
from cosim.scenario.document.places import PORTS, Key, Problem, report, written
from cosim.scenario.document.schema import ACTIONS, COMPONENTS, RESERVED, TABLES
from cosim.scenario.document.swaps import (
    MAP,
    PortNames,
    Tables,
    WrittenPorts,
    is_port_names,
    marked_path,
    replace_components,
    table_of,
)

SUFFIX: Final = ".toml"
LARGEST: Final = 2**26  # bytes of a scenario
MOST_LEVELS: Final = 50  # of tables and lists inside each other
_SET: Final = "(set)"  # first part of the key of a problem with an edit, which stands in no file
_TOO_DEEP: Final = f"expected tables and lists nested at most {MOST_LEVELS} levels deep, got more"
_CLOSING: Final = {"[": "]", "{": "}", "(": ")", "'": "'", '"': '"'}
_PART: Final = re.compile(r"([^\[\]]+)((?:\[[^\[\]]*\])+)")
_INDEX: Final = re.compile(r"0|[1-9][0-9]{0,8}")
# a key with so many dots that tomllib, which looks at each pair of its parts, would take minutes
_LONG_KEY: Final = re.compile(rf"^[ \t]*\[*(?:[\w-]+[ \t]*\.[ \t]*){{{MOST_LEVELS}}}", re.M)


# --- keys ---


def parts_of(key: str) -> list[str]:
    """Return the parts of a dotted key, indices among them: ``terms[0].theta`` has three."""
    parts: list[str] = []
    for part in key.split("."):
        match = _PART.fullmatch(part)
        parts += [part] if match is None else [match[1], *match[2][1:-1].split("][")]
    return parts


def short(key: str) -> str:
    """Return the form of a dotted key that is the same however it was written.

    That of a component is without ``components.``, unless its name is that of a table. An action is
    ``actions.0``, also where it was written ``actions[0]``.
    """
    first, dot, rest = key.partition(".")
    if first == COMPONENTS and rest.partition(".")[0] not in RESERVED:
        return rest or key
    if first.startswith(f"{ACTIONS}["):
        first = ".".join(parts_of(first))
    return f"{first}{dot}{rest}"


def shown(key: str) -> str:
    """Return the short form of a key as messages have it: ``actions[0].at`` of ``actions.0.at``."""
    return re.sub(rf"^{ACTIONS}\.([^.]+)", rf"{ACTIONS}[\1]", short(key))


def component_in(key: str) -> str | None:
    """Return the component that a dotted key is about; None: it is in another table."""
    first, _, rest = key.partition(".")
    if first == COMPONENTS and rest:
        return rest.partition(".")[0]
    return None if first in RESERVED else first


# --- values ---


def parse_value(text: str) -> Any:
    """Read a value from the command line: TOML where it is TOML, else a string.

    Raises
    ------
    UsageError
        If it is TOML, but nested too deep, or a number has too many digits.
    """
    try:
        table = plain(_read_toml(f"value = {text}"), -1, dates=True)
    except UsageError as error:
        raise UsageError(f"{quoted(text)}: {error}") from error
    except tomllib.TOMLDecodeError:
        return text
    return table["value"] if len(table) == 1 else text


def parse_values(text: str) -> list[Any]:
    """Read values with commas between them: ``1e3,1e6``, ``[0,2],[0,4]``, ``sine,step``.

    Each is TOML where it can be, else a string; a comma in brackets or quotes is part of a value.

    Raises
    ------
    UsageError
        If one is empty, or cannot be read.
    """
    parts = [""]
    closing = ""  # of the brackets and the quote that are open, the innermost first
    for character in text:
        if character == "," and not closing:
            parts.append("")
            continue
        parts[-1] += character
        if closing.startswith(character):
            closing = closing[1:]
        elif closing[:1] not in ("'", '"'):
            closing = _CLOSING.get(character, "") + closing
    if not all(part.strip() for part in parts):
        raise UsageError(f"expected values separated by commas, got an empty one in {quoted(text)}")
    return [parse_value(part.strip()) for part in parts]


def plain(value: Any, level: int = 0, *, dates: bool = False) -> Any:
    """Return a copy of a value as TOML could have it: arrays and tuples as lists.

    Parameters
    ----------
    value : object
    level : int
        Of tables and lists around it.
    dates : bool
        Whether dates and times stay, which a schema refuses at their places.

    Raises
    ------
    UsageError
        If it is nested too deep, or TOML cannot have it.
    """
    if level > MOST_LEVELS:
        raise UsageError(_TOO_DEEP)
    match value:
        case bool() | int() | float() | str() if not isinstance(value, np.generic):
            return value
        case list() | tuple():
            return [plain(item, level + 1, dates=dates) for item in value]
        case Mapping():
            wrong = [key for key in value if not isinstance(key, str)]
            if wrong:
                raise UsageError(f"expected a string as key of a table, got {quoted(wrong[0])}")
            return {key: plain(item, level + 1, dates=dates) for key, item in value.items()}
        case np.ndarray() | np.generic():
            return plain(value.tolist(), level + 1, dates=dates)
        case complex():
            return str(value)  # as TOML can have it
        case date() | time() if dates:
            return value
    raise UsageError(
        f"expected a number, true or false, a string, a list or a table, got {quoted(value)}"
    )


def _read_toml(text: str) -> Tables:
    """Return the tables of a text.

    Raises
    ------
    UsageError
        If they are nested too deep, or a number has too many digits.
    TOMLDecodeError
        If it is no TOML.
    """
    if _LONG_KEY.search(text):
        raise UsageError(_TOO_DEEP)
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise UsageError(_TOO_DEEP) from error
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # of Python's int
        raise UsageError("an integer has too many digits; expected at most 64 bits") from error


_parsed = lru_cache(maxsize=8)(_read_toml)  # a document and its edits share one text


# --- edits ---


def _set(tree: Tables, key: str, value: Any) -> Key:
    """Set a value in the tables of a scenario, by its dotted key; return where it stands now.

    Tables are made where there are none, lists are not.

    Raises
    ------
    UsageError
        If there is no such place.
    """
    place: Key = ()
    holder: Any = tree
    parts = _parts_in(tree, key, value)
    while True:
        part = parts.pop(0)
        name, *indices = parts_of(part)
        at: str | int = part
        if part.startswith("["):
            at = _index(holder, part[1:-1], place)
        elif not isinstance(holder, dict):
            raise UsageError(f"{written(place)}: expected a table, got {quoted(holder)}")
        elif indices and "." not in part and part not in holder:
            # the tables inside a component's have names such as ``start = { "x[0]" = 1.0 }``
            is_inside = len(place) == 3 and place[0] == COMPONENTS
            if name in holder or not is_inside:
                parts[:0] = [f"[{index}]" for index in indices]
                at = name
        place = (*place, at)
        if not parts:
            holder[at] = deepcopy(value)  # a later edit may reach into it
            return place
        inner = holder.get(at) if isinstance(at, str) else holder[at]
        is_table = isinstance(at, str) and not parts[0].startswith("[")
        # one value for all, such as a unit, gives way to a table; a wrong outermost table does not
        if is_table and not isinstance(inner, dict) and (inner is None or len(place) > 1):
            inner = holder[at] = {}
        holder = inner


def _parts_in(tree: Tables, key: str, value: Any) -> list[str]:
    """Return the parts of the key of an edit, from the outermost table; an index is ``[0]``.

    Raises
    ------
    UsageError
        If there is no such table or component.
    """
    component = component_in(key)
    first, *parts = key.removeprefix("" if component is None else f"{COMPONENTS}.").split(".")
    components = table_of(tree, COMPONENTS)
    if not parts and first != ACTIONS and (component is None or not isinstance(value, dict)):
        example = option("set", "observer.filter_rate", "500")
        raise UsageError(f"expected COMPONENT.PARAMETER, such as {example}, got no dot")
    if component is not None or first not in TABLES:
        if parts and first not in components:
            suggestion = nearest(first, [*components, *TABLES])
            raise UsageError(f"unknown component {first!r}; {suggestion}")
        return [COMPONENTS, first, *parts]
    if first in PORTS:
        return [first, ".".join(parts)]
    if first == ACTIONS and parts:
        tree.setdefault(ACTIONS, [])
        parts[0] = f"[{parts[0]}]"
        if parts[1:2] == ["set"] and len(parts) > 2:
            parts[2:] = [_setting(".".join(parts[2:]))]
    return [first, *parts]


def _setting(key: str) -> str:
    """Return a key that an action sets, which is always that of a component, in its short form."""
    rest = key.removeprefix(f"{COMPONENTS}.")
    return rest if "." in rest else key


def _index(items: Any, index: str, place: Key) -> int:
    """Return the number of an element of a list, which stands at ``place``."""
    name = written(place)
    if items is None:
        raise UsageError(
            f"{name} is not given, so element {index} cannot be set; set it as a whole"
        )
    if not isinstance(items, list):
        raise UsageError(f"{name}: expected a list, got {quoted(items)}")
    if _INDEX.fullmatch(index) is None or int(index) >= len(items):
        available = f"available: 0 to {len(items) - 1}" if items else "none is available"
        raise UsageError(f"{name} has no element {quoted(index)}; {available}")
    return int(index)


def _flatten(tree: Tables) -> list[Problem]:
    """Write the ports of a scenario's tables as one dotted key each.

    ``plant.u = ...`` and ``"plant.u" = ...`` mean the same.
    """
    holders: list[tuple[Any, Key]] = [(tree, (name,)) for name in PORTS]
    for name, entry in table_of(tree, "swap").items():
        holders.append((entry, ("swap", name, "map")))
    actions = tree.get(ACTIONS)
    for number, action in enumerate(actions if isinstance(actions, list) else ()):
        holders.append((action, (ACTIONS, number, "set")))
    problems: list[Problem] = []
    for holder, place in holders:
        name = str(place[-1])
        if not (isinstance(holder, dict) and isinstance(holder.get(name), dict)):
            continue
        flat: Tables = {}
        for key, value in holder[name].items():
            pairs = {key: value}
            if isinstance(value, dict) and "." not in key:
                pairs = {f"{key}.{inner}": item for inner, item in value.items()}
            for dotted, item in pairs.items():
                port = _setting(dotted) if place[0] == ACTIONS else dotted
                if port in flat:
                    way_out = ONE_SOURCE if name == "connections" else "remove one"
                    problems.append(((*place, port), f"'{port}' is given twice; {way_out}"))
                flat[port] = item
        holder[name] = flat
    return problems


# --- the text ---


@document
class _Edits:
    """What a log has of the edits of its scenario."""

    source: str
    swaps: dict[str, str]
    changes: dict[str, Any]
    maps: dict[str, str | list[str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EditedTables:
    """The tables of a scenario with all edits.

    Parameters
    ----------
    tree : dict
    problems : list of Problem
        Of the edits.
    edits : dict of str to str
        By what keys were edited from outside.
    replaced : dict of component name to dict
        The tables in whose place those of swaps are.
    """

    tree: Tables
    problems: list[Problem]
    edits: dict[str, str]
    replaced: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Document:
    """A scenario's TOML text with edits applied after it.

    Parameters
    ----------
    text : str
        As written.
    source : str
        The file, or the name of a shipped scenario.
    folder : Path
        What relative paths in the text start from.
    swaps : mapping of component name to path
        Components whose whole table is replaced.
    maps : mapping of port to names
        Ports that have other names in the swapped component; see
        :mod:`cosim.scenario.document.swaps`.
    changes : mapping of dotted key to value
        Values set after that, such as ``observer.filter_rate``.
    swapped : bool
        False: nothing is swapped, not even by the file.
    foreign_kinds : frozenset of str
        Of a log: the component kinds of its run that were those of installed packages.
    """

    text: str
    source: str
    folder: Path
    swaps: Mapping[str, str] = field(default_factory=dict)
    maps: Mapping[str, PortNames] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)
    swapped: bool = True
    foreign_kinds: frozenset[str] = frozenset()

    def with_swaps(
        self, swaps: Mapping[str, str | Path], maps: Mapping[str, PortNames] | None = None
    ) -> Document:
        """Replace components; paths are taken from the working directory.

        They are kept as paths from the folder: a log, which has them, is sent to others.
        A component that is replaced again loses the map given before.

        Raises
        ------
        UsageError
            If a path is none, or what a port is mapped to is no name and no list of names.
        """
        paths = dict(self.swaps)
        for name, path in swaps.items():
            try:
                given = Path(marked_path(str(path_argument("path", path))))
            except UsageError as error:
                raise UsageError(f"{option('swap', name)}: {error}") from error
            place = given.parent.resolve() / given.name
            paths[name] = os.path.relpath(place, self.folder.resolve())
        kept = dict(self.maps)
        if kept and swaps:
            tables = self.tables()
            ports = WrittenPorts(tables.tree)
            for port in self.maps:
                with suppress(GraphError):
                    if ports.meant(port, list(tables.replaced)).component in swaps:
                        del kept[port]
        for port, names in (maps or {}).items():
            if not is_port_names(names):
                expected = "expected a name or a list of names"
                raise UsageError(f"{option('map', port)}: {expected}, got {quoted(names)}")
            kept[port] = names
        return replace(self, swaps=paths, maps=kept)

    def with_changes(self, changes: Mapping[str, Any]) -> Document:
        """Set values; ``components.observer.L`` and ``observer.L`` are the same key.

        Raises
        ------
        UsageError
            If a value is none that TOML can have.
        """
        values = dict(self.changes)
        for key, value in changes.items():
            values.pop(short(key), None)  # the later one wins over all that it reaches into
            try:
                values[short(key)] = plain(value)
            except UsageError as error:
                raise UsageError(f"{option('set', key)}: {error}") from error
        return replace(self, changes=values)

    def unswapped(self) -> Document:
        """Return the document without the swaps and without what was set for them."""
        swapped = self.tables().replaced
        inputs = tuple(f"connections.{name}." for name in swapped)
        changes = {}
        for key, value in self.changes.items():
            if component_in(key) not in swapped and not key.startswith(inputs):
                changes[key] = value
        # a map without its swap would be a problem, which keeps the scenario from being initialized
        return replace(self, swaps={}, maps={}, changes=changes, swapped=False)

    def edits(self) -> str:
        """Return swaps, maps and changes as JSON, for the log."""
        edits = {"swaps": self.swaps, "maps": self.maps, "changes": self.changes}
        return json.dumps({"source": self.source and os.path.relpath(self.source), **edits})

    @staticmethod
    def recorded(text: str, edits: str, folder: Path, what: str) -> Document:
        """Rebuild a document from a log.

        Parameters
        ----------
        text : str
        edits : str
            As :meth:`edits` returned them.
        folder : Path
        what : str
            The document in words, for messages.

        Raises
        ------
        LogError
            If the edits are something else.
        """
        recorded = understood(_Edits, edits, what)
        return Document(
            text, recorded.source, folder, recorded.swaps, recorded.maps, recorded.changes
        )

    def tables(self) -> EditedTables:
        """Return the tables with swaps and changes applied, and what was edited.

        Raises
        ------
        ScenarioError
            If the text is no TOML.
        """
        try:
            tree = plain(_parsed(self.text), -1, dates=True)
        except UsageError as error:
            raise ScenarioError(f"{self.source}: {error}") from error
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(self._syntax(str(error))) from error
        problems = _flatten(tree)
        edits = {written(("swap", name)): option("swap", name) for name in self.swaps}
        edits |= {written((MAP, port)): option("map", port) for port in self.maps}
        replaced = {}
        if self.swapped:
            replaced = replace_components(tree, self.swaps, problems)
        else:
            tree.pop("swap", None)
        for key, value in self.changes.items():
            label = option("set", shown(key))
            try:
                edits[written(_set(tree, key, value))] = label
            except UsageError as error:
                problems.append(((_SET, key), str(error)))
                edits[written((_SET, key))] = label
        problems += _flatten(tree)  # again, for the tables that were set
        return EditedTables(tree, problems, edits, replaced)

    def report(self, problems: Iterable[Problem]) -> ScenarioError:
        """Return one error with every problem at its place."""
        tables = self.tables()
        text = report(problems, self.source, self.text, tables.edits, tables.replaced)
        return ScenarioError(text)

    def _syntax(self, message: str) -> str:
        """Return where a text is no TOML, and the way out."""
        position = re.search(r"\(at line (\d+), column \d+\)", message)
        if position is None:
            return f"{self.source}: not TOML: {message}"
        number = int(position[1])
        line = self.text.split("\n")[number - 1]
        key = re.split("[=#]", line)[0].strip()
        if "overwrite" in message or "twice" in message:
            way_out = "put its keys below one heading" if line.startswith("[") else "remove one"
            return f"{self.source}:{number}: {key} is given twice; {way_out}"
        if not (key.isascii() or '"' in key or "'" in key):
            message += "; keys with non-ASCII letters must be quoted"
        if re.search(r'"[^"]*\\', line):
            message += (
                "; in double quotes a backslash begins an escape: write a path in single quotes"
            )
        return f"{self.source}:{number}: not TOML: {message}"


# --- files ---


def find(name: str | Path) -> Document:
    """Find a scenario: a path to a TOML file, or the name of a shipped one.

    Raises
    ------
    UsageError
        If it is no path, or that of a log or an FMU.
    ScenarioError
        If there is neither.
    """
    path = path_argument("scenario", name)
    text = str(name)
    way_out = {
        "log": f"{command('replay')} replays a log, 'cosim info' shows it",
        "FMU": "'cosim info' shows an FMU, 'cosim check' tests it; a scenario uses it as a "
        f'component of kind "fmu", or in place of another: {option("swap", "NAME", "PATH")}',
    }.get(file_type(path) or "")
    if file_type(path) == "scenario" or (path.is_file() and not way_out):
        return Document(_read_text(path), str(path), path.absolute().parent)
    if text in shipped():
        content = (_library() / f"{text}{SUFFIX}").read_text(encoding="utf-8")
        return Document(content, text, Path.cwd())
    if way_out:
        raise UsageError(f"{path}: expected a scenario (.toml); {way_out}")
    if path.is_dir():
        raise ScenarioError(f"{path}: expected a scenario (.toml) or a shipped one, got a folder")
    raise ScenarioError(
        f"unknown scenario {quoted(text)}; {nearest(text, shipped())}, or a path to a .toml file"
    )


def _read_text(path: Path) -> str:
    try:
        return read_bounded(path, LARGEST).decode("utf-8-sig").replace("\r\n", "\n")
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        expected = f"a scenario file, or one of: {', '.join(shipped())}"
        raise ScenarioError(f"{path}: {problem}; expected {expected}") from error
    except UnicodeDecodeError as error:
        problem = f"is not UTF-8 text (byte {error.start})"
        raise ScenarioError(f"{path}: {problem}; expected a scenario in TOML") from error


def shipped() -> list[str]:
    """Return the names of the shipped scenarios."""
    names = [file.name for file in _library().iterdir()]
    return sorted(name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX))


def _library() -> Traversable:
    """Return the folder of the shipped scenarios."""
    return resources.files("cosim.scenario") / "library"
