"""The text of a scenario, the edits made to it from outside, and where in it a key stands."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import ScenarioError, nearest
from cosim.files import read_bounded
from cosim.scenario.problems import Key, Problem
from cosim.scenario.swap import MAP, PortNames, owner_of, replace_components, swapped_components

SUFFIX = ".toml"
LARGEST = 2**26  # bytes of a scenario
SET = "--set"  # first part of the key of a problem with a --set option, which stands in no file
FLAT = ("connections", "truth")  # tables whose keys are the names of ports
TABLES = ("scenario", "models", *FLAT)  # what a dotted key may begin with, beside a component


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
        Ports that have other names in the swapped component; see :mod:`cosim.scenario.swap`.
    changes : mapping of dotted key to value
        Values set after that, such as ``observer.filter_rate``.
    swapped : bool
        False: nothing is swapped, not even by the file.
    """

    text: str
    source: str
    folder: Path
    swaps: Mapping[str, str] = field(default_factory=dict)
    maps: Mapping[str, PortNames] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)
    swapped: bool = True

    def with_swaps(
        self, swaps: Mapping[str, str | Path], maps: Mapping[str, PortNames] | None = None
    ) -> Document:
        """Replace components; paths are taken from the working directory.

        A component that is replaced again loses the map given before.
        """
        paths = dict(self.swaps)
        for name, path in swaps.items():
            paths[name] = str(Path(path).absolute())
        kept = dict(self.maps)
        if kept:
            tree, _ = self.tree()
            for port in self.maps:
                if owner_of(tree, port) in swaps:
                    del kept[port]
        if maps is not None:
            kept |= maps
        return replace(self, swaps=paths, maps=kept)

    def with_changes(self, changes: Mapping[str, Any]) -> Document:
        """Set values; ``components.observer.L`` and ``observer.L`` are the same key."""
        values = dict(self.changes)
        for key, value in changes.items():
            values[short(key)] = plain(value)
        return replace(self, changes=values)

    def unswapped(self) -> Document:
        """Return the document without the swaps and without what was set for them."""
        prefixes: list[str] = []
        for name in self.swapped_components():
            prefixes += [f"{name}.", f"connections.{name}."]
        changes = {}
        for key, value in self.changes.items():
            if not key.startswith(tuple(prefixes)):
                changes[key] = value
        # a map without its swap would be a problem, which keeps the scenario from being initialized
        return replace(self, swaps={}, maps={}, changes=changes, swapped=False)

    def swapped_components(self) -> list[str]:
        """Return the names of the swapped components."""
        return swapped_components(self.tree()[0]) if self.swapped else []

    def edits(self) -> str:
        """Return swaps, maps and changes as JSON, for the log."""
        edits = {"swaps": self.swaps, "maps": self.maps, "changes": self.changes}
        return json.dumps({"source": self.source, **edits})

    @staticmethod
    def recorded(text: str, edits: Mapping[str, Any], folder: Path) -> Document:
        """Rebuild a document from a log; ``edits`` as :meth:`edits` returns them."""
        return Document(
            text,
            edits["source"],
            folder,
            swaps=edits["swaps"],
            maps=edits["maps"],
            changes=edits["changes"],
        )

    # --- tables ---

    def tree(self) -> tuple[dict[str, Any], list[Problem]]:
        """Return the tables with swaps and changes applied, and the problems of these.

        Raises
        ------
        ScenarioError
            If the text is no TOML.
        """
        tree = self._parsed()
        problems = _flatten_tables(tree)
        if self.swapped:
            problems += replace_components(tree, self.swaps)
        else:
            tree.pop("swap", None)
        for key, value in self.changes.items():
            text = _change(tree, key, value)
            if text is not None:
                problems.append(((SET, key), text))
        problems += _flatten_tables(tree)  # again, for the tables that were set
        return tree, problems

    def _parsed(self) -> dict[str, Any]:
        try:
            return deepcopy(_parse(self.text))
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(self._syntax(error)) from error
        except RecursionError as error:
            raise ScenarioError(f"{self.source}: its tables are nested too deeply") from error

    def _syntax(self, error: tomllib.TOMLDecodeError) -> str:
        message = str(error)
        position = re.search(r"\(at line (\d+), column (\d+)\)", message)
        if position is None:
            return f"{self.source}: not TOML: {message}"
        place = f"{self.source}:{position[1]}"
        if "overwrite" not in message and "twice" not in message:
            return f"{place}: not TOML: {message}"
        number = int(position[1])
        line = self.text.splitlines()[number - 1]
        key = line.split("=")[0].strip()
        return f"{place}: {key} is given twice; keep one (an input is driven by one source)"

    # --- where a key stands ---

    def report(self, problems: Iterable[Problem]) -> ScenarioError:
        """Return one error with every problem at its place; repeated texts at the first alone."""
        keys: dict[str, Key] = {}
        for key, text in problems:
            keys.setdefault(text, key)
        lines = []
        for text, key in keys.items():
            label = self.label(key)
            lines += [f"{label}: {line}" for line in text.splitlines()]
        return ScenarioError("\n".join(lines))

    def label(self, key: Key) -> str:
        """Return where a key stands and its name: what a message begins with."""
        if key[:1] in ((SET,), (MAP,)):
            return f"{key[0]} {key[1]}"
        place = self.place(key)
        dotted = ".".join(map(str, key))
        if key[:1] == ("swap",) and place.startswith("--"):  # the option has the name
            return place
        return f"{place}: {dotted}" if dotted else place

    def place(self, key: Key) -> str:
        """Return where a key stands: file and line, or the option that set it."""
        names = [str(part) for part in key]
        dotted = short(".".join(names))
        for change in self.changes:
            if f"{dotted}.".startswith(f"{change}."):
                return f"--set {change}"
        match names:
            case ["components", name, *_] if name in self.swapped_components():
                return self.place(("swap", name))
            case ["swap", _, _, port, *_] if port in self.maps:
                return f"--map {port}"
            case ["swap", name, *_] if name in self.swaps:
                return f"--swap {name}"
        return self._place_in_text(names, dotted)

    def _place_in_text(self, names: list[str], dotted: str) -> str:
        """Return the line of a key, with the options that set values inside it."""
        line = find_line(self.text, names)
        place = self.source if line is None else f"{self.source}:{line}"
        inside = [f"--set {change}" for change in self.changes if change.startswith(f"{dotted}.")]
        return f"{place} (with {', '.join(inside)})" if inside else place


@lru_cache(maxsize=8)  # a document and its edits share one text
def _parse(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def find(name: str) -> Document:
    """Find a scenario: a path to a TOML file, or the name of a shipped one.

    Raises
    ------
    ScenarioError
        If there is neither.
    """
    path = Path(name)
    if path.suffix == SUFFIX or _is_file(path):
        folder = path.absolute().parent
        return Document(_read_text(name), str(path), folder)
    if name in shipped():
        text = (_library() / f"{name}{SUFFIX}").read_text(encoding="utf-8")
        return Document(text, name, Path.cwd())
    raise ScenarioError(
        f"there is no scenario {name!r}; give a path to a .toml file, or a shipped one. "
        f"{nearest(name, shipped())}"
    )


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # no file can have such a name
        return False


def _read_text(name: str) -> str:
    try:
        text = read_bounded(Path(name), LARGEST).decode("utf-8-sig")
        return text.replace("\r\n", "\n")
    except OSError as error:
        names = ", ".join(shipped())
        raise ScenarioError(
            f"{name}: cannot be read ({error.strerror}); needed a scenario file, or one of: {names}"
        ) from error
    except UnicodeDecodeError as error:
        raise ScenarioError(
            f"{name}: is no text in UTF-8 (byte {error.start}); needed a scenario in TOML"
        ) from error
    except ValueError as error:
        raise ScenarioError(f"{name!r} cannot be the name of a file: {error}") from error


def shipped() -> list[str]:
    """Return the names of the shipped scenarios."""
    names = [file.name for file in _library().iterdir()]
    return sorted(name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX))


def _library() -> Traversable:
    """Return the folder of the shipped scenarios."""
    return resources.files("cosim.scenario") / "library"


def _flatten_tables(tree: dict[str, Any]) -> list[Problem]:
    """Write the ports of a scenario's tables as one dotted key each."""
    problems: list[Problem] = []
    for name in FLAT:
        if isinstance(tree.get(name), dict):
            tree[name], found = flatten(tree[name], (name,))
            problems += found
    swaps = tree.get("swap")
    for name, table in swaps.items() if isinstance(swaps, dict) else ():
        if isinstance(table, dict) and isinstance(table.get("map"), dict):
            table["map"], found = flatten(table["map"], ("swap", name, "map"))
            problems += found
    return problems


def flatten(tree: Mapping[str, Any], prefix: Key) -> tuple[dict[str, Any], list[Problem]]:
    """Return a table with every port as one dotted key, and the problems of that.

    ``plant.u = ...`` and ``"plant.u" = ...`` mean the same.
    """
    flat: dict[str, Any] = {}
    problems: list[Problem] = []
    for key, value in tree.items():
        pairs = {key: value}
        if isinstance(value, dict) and "." not in key:
            pairs = {f"{key}.{name}": item for name, item in value.items()}
        for port, item in pairs.items():
            if port in flat:
                text = (
                    f"'{port}' is given twice; an input has one source (add signals with a 'sum')"
                )
                problems.append(((*prefix, port), text))
            flat[port] = item
    return flat, problems


def plain(value: Any) -> Any:
    """Return arrays and tuples as the lists that TOML would have."""
    match value:
        case np.ndarray() | np.generic():
            return value.tolist()
        case Mapping():
            return {key: plain(item) for key, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case _:
            return value


def short(key: str) -> str:
    """Return the short form of a dotted key: a component's parameter begins with the component."""
    return key.removeprefix("components.")


def parse_value(text: str) -> Any:
    """Read a value from the command line: TOML where it is TOML, else a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def find_line(text: str, key: list[str]) -> int | None:
    """Return the line, from 1, where a key or the largest outer part of it stands."""
    table: list[str] = []
    best: int | None = None
    depth = 0
    for number, line in enumerate(text.splitlines(), start=1):
        if header := re.match(r"\s*\[\[?([^\]]+)\]", line):
            table = [part.strip().strip("\"'") for part in header[1].split(".")]
            written = table
        elif entry := re.match(r"\s*(\"[^\"]*\"|'[^']*'|[\w.-]+)\s*=", line):
            written = [*table, *_key_parts(entry[1])]
        else:
            continue
        if len(written) > depth and key[: len(written)] == written:
            best = number
            depth = len(written)
    return best


def _key_parts(key: str) -> list[str]:
    """Return the parts of a written key; a quoted one is one part."""
    return [key[1:-1]] if key[0] in "\"'" else key.split(".")


def _change(tree: dict[str, Any], key: str, value: Any) -> str | None:
    """Set a value in the tables; return the problem of that, if there is one."""
    first, *rest = key.split(".")
    outer = first if first in TABLES else "components"
    if not isinstance(tree.setdefault(outer, {}), dict):
        return f"[{outer}] is no table"
    if first in FLAT and rest:
        _set_port(tree[first], rest, value)
        return None
    if not rest and (first in TABLES or not isinstance(value, dict)):
        return "found no dot, needed component.parameter=value, such as observer.filter_rate=500"
    if first in TABLES:
        table = tree[first]
        path = rest
    else:
        table = tree["components"]
        path = [first, *rest]
        if rest and first not in table:
            return f"there is no component {first!r}; {nearest(first, [*table, *TABLES])}"
    _set_value(table, path, value)
    return None


def _set_value(table: dict[str, Any], path: list[str], value: Any) -> None:
    """Set a value in a table or in tables inside it, which are made where there are none."""
    for part in path[:-1]:
        if not isinstance(table.setdefault(part, {}), dict):
            table[part] = {}
        table = table[part]
    table[path[-1]] = deepcopy(value)  # a later change may reach into it


def _set_port(table: dict[str, Any], port: list[str], value: Any) -> None:
    """Set the entry of a port, in whichever of the two spellings it was written."""
    nested = table.get(port[0])
    if isinstance(nested, dict):
        nested.pop(".".join(port[1:]), None)
    table[".".join(port)] = value
