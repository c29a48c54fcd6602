"""The text of a scenario, the changes made to it from outside, and where in it a key stands."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import ScenarioError, nearest
from cosim.scenario.swap import MAP, Swapped, apply

Key = tuple[str | int, ...]
Problem = tuple[Key, str]
SUFFIX = ".toml"
SET = "--set"  # what the key of a problem begins with that is an option's, and stands in no file
FLAT = ("connections", "truth")  # tables whose keys are dotted names of signals
TABLES = ("scenario", "models", *FLAT)  # what a dotted key may begin with, beside a component


@dataclass(frozen=True, slots=True)
class Document:
    """A scenario's TOML text with changes applied after it.

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
    maps : mapping of port to name
        Ports that have another name in the swapped component; see :mod:`cosim.scenario.swap`.
    changes : mapping of dotted key to value
        Values set after that, such as ``observer.filter_rate``.
    swapped : bool
        False: nothing is swapped, not even by the file.
    """

    text: str
    source: str
    folder: Path
    swaps: Mapping[str, str] = field(default_factory=dict)
    maps: Mapping[str, str] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)
    swapped: bool = True

    def with_swaps(
        self, swaps: Mapping[str, str], maps: Mapping[str, str] | None = None
    ) -> Document:
        """Replace components; paths are taken from the working directory. Who is replaced again loses its map given before."""
        absolute = {name: str(Path(path).absolute()) for name, path in swaps.items()}
        again = (
            [swap for name, swap in self._swapped().swaps.items() if name in swaps]
            if self.maps
            else []
        )
        before = {
            port: name
            for port, name in self.maps.items()
            if not any(port in swap.map for swap in again)
        }
        return replace(self, swaps={**self.swaps, **absolute}, maps={**before, **(maps or {})})

    def with_changes(self, changes: Mapping[str, Any]) -> Document:
        """Set values; ``components.observer.L`` and ``observer.L`` are the same key."""
        return replace(
            self,
            changes={
                **self.changes,
                **{short(key): plain(value) for key, value in changes.items()},
            },
        )

    def unswapped(self) -> tuple[list[str], Document]:
        """Give the names of the swapped components, and the document as it was without the swaps and what was set for them."""
        names = list(self._swapped().swaps)
        of_them = [*(f"{name}." for name in names), *(f"connections.{name}." for name in names)]
        kept = {
            key: value for key, value in self.changes.items() if not key.startswith(tuple(of_them))
        }
        return names, replace(self, changes=kept, swapped=False)

    def edits(self) -> str:
        """Give swaps, maps and changes as JSON, for the log."""
        made = {"swaps": dict(self.swaps), "maps": dict(self.maps), "changes": dict(self.changes)}
        return json.dumps({"source": self.source, **made})

    @staticmethod
    def recorded(text: str, edits: str, folder: Path) -> Document:
        """Rebuild a document from a log."""
        found = json.loads(edits)
        maps = found.get("maps", {})
        return Document(
            text, found["source"], folder, swaps=found["swaps"], maps=maps, changes=found["changes"]
        )

    def tree(self) -> tuple[dict[str, Any], list[Problem]]:
        """Parse the text, make the swaps and apply the changes; give the tables, and what is wrong with swaps and changes.

        Raises
        ------
        ScenarioError
            If the text is no TOML.
        """
        tree, problems = self._flat()
        if self.swapped:
            problems += apply(tree, self.swaps, self.maps).problems
        else:
            tree.pop("swap", None)
        changed = {key: _change(tree, key, value) for key, value in self.changes.items()}
        return tree, [*problems, *(((SET, key), text) for key, text in changed.items() if text)]

    def _flat(self) -> tuple[dict[str, Any], list[Problem]]:
        """Parse the text; ports are written as one dotted key."""
        try:
            tree = tomllib.loads(self.text)
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(self._syntax(error)) from error
        problems: list[Problem] = []
        swaps = tree["swap"].items() if isinstance(tree.get("swap"), dict) else ()
        maps = {("swap", name): table for name, table in swaps if isinstance(table, dict)}
        for prefix, table, key in [((), tree, name) for name in FLAT] + [
            (prefix, table, "map") for prefix, table in maps.items()
        ]:
            if isinstance(table.get(key), dict):
                table[key], more = flatten(table[key], (*prefix, key))
                problems += more
        return tree, problems

    def place(self, key: Key) -> str:
        """Say where a key stands: file and line, or the option that set it."""
        names = [str(part) for part in key]
        dotted = short(".".join(names))
        for change in self.changes:
            if dotted == change or dotted.startswith(f"{change}."):
                return f"--set {change}"
        swapped = self._swapped() if self.swapped else Swapped({}, {}, [])
        if origin := swapped.origins.get(key[:2]):
            return " and ".join(map(self.place, origin))
        if names[:1] == ["components"] and len(names) > 1 and names[1] in swapped.swaps:
            return self.place(("swap", names[1]))
        if names[:1] == ["swap"] and names[3:] and names[3] in self.maps:
            return f"--map {names[3]}"
        if names[:1] == ["swap"] and names[1:] and names[1] in self.swaps:
            return f"--swap {names[1]}"
        line = find_line(self.text, names)
        inside = [f"--set {change}" for change in self.changes if change.startswith(f"{dotted}.")]
        return (f"{self.source}:{line}" if line else self.source) + (
            f" (with {', '.join(inside)})" if inside else ""
        )

    def _swapped(self) -> Swapped:
        tree, _ = self._flat()
        return apply(tree, self.swaps, self.maps)

    def label(self, key: Key) -> str:
        """Say where a key stands and how it is called: what a message begins with."""
        if key[:1] in ((SET,), (MAP,)):
            return f"{key[0]} {key[1]}"
        place, dotted = self.place(key), ".".join(map(str, key))
        if key[:1] == ("swap",) and place.startswith("--"):  # the option says it all
            return place
        return f"{place}: {dotted}" if dotted else place

    def _syntax(self, error: tomllib.TOMLDecodeError) -> str:
        message = str(error)
        found = re.search(r"\(at line (\d+), column (\d+)\)", message)
        place = f"{self.source}:{found[1]}" if found else self.source
        if found and ("overwrite" in message or "twice" in message):
            line = self.text.splitlines()[int(found[1]) - 1].strip()
            return f"{place}: {line.split('=')[0].strip()} is given twice; keep one (an input is driven by one source)"
        return f"{place}: not TOML: {message}"


def find(name: str) -> Document:
    """Find a scenario: a path to a TOML file, or the name of a shipped one.

    Raises
    ------
    ScenarioError
        If there is neither.
    """
    path = Path(name)
    if path.suffix == SUFFIX or path.is_file():
        try:
            return Document(path.read_text(encoding="utf-8"), str(path), path.absolute().parent)
        except OSError as error:
            raise ScenarioError(
                f"{name}: cannot be read ({error.strerror}); needed a scenario file, or one of: {', '.join(shipped())}"
            ) from error
        except UnicodeDecodeError as error:
            raise ScenarioError(
                f"{name}: is no text in UTF-8 ({error}); needed a scenario in TOML"
            ) from error
    if name in shipped():
        text = (resources.files("cosim.scenario") / "library" / f"{name}{SUFFIX}").read_text(
            encoding="utf-8"
        )
        return Document(text, name, Path.cwd())
    raise ScenarioError(
        f"there is no scenario {name!r}; give a path to a .toml file, or a shipped one. {nearest(name, shipped())}"
    )


def shipped() -> list[str]:
    """List the names of the shipped scenarios."""
    folder = resources.files("cosim.scenario") / "library"
    return sorted(
        entry.name.removesuffix(SUFFIX) for entry in folder.iterdir() if entry.name.endswith(SUFFIX)
    )


def flatten(tree: Mapping[str, Any], prefix: Key) -> tuple[dict[str, Any], list[Problem]]:
    """Give a table with every signal as one dotted key; ``plant.u = ...`` and ``"plant.u" = ...`` mean the same."""
    flat: dict[str, Any] = {}
    problems: list[Problem] = []
    for key, value in tree.items():
        nested = isinstance(value, dict) and "." not in key
        pairs = {f"{key}.{name}": one for name, one in value.items()} if nested else {key: value}
        for to, one in pairs.items():
            if to in flat:
                text = f"'{to}' is given twice; an input has one source (add signals with a 'sum')"
                problems.append(((*prefix, to), text))
            flat[to] = one
    return flat, problems


def plain(value: Any) -> Any:
    """Give arrays and tuples as the lists that TOML would have."""
    match value:
        case np.ndarray() | np.generic():
            return value.tolist()
        case Mapping():
            return {key: plain(one) for key, one in value.items()}
        case list() | tuple():
            return [plain(one) for one in value]
        case _:
            return value


def short(key: str) -> str:
    """Give the short form of a dotted key: that of a component's parameter begins with the component."""
    return key.removeprefix("components.")


def parse_value(text: str) -> Any:
    """Read a value from the command line: TOML where it is TOML, else a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def find_line(text: str, key: list[str]) -> int | None:
    """Find the line, from 1, where a key stands; where only an outer part of it is written, that part's line."""
    table: list[str] = []
    best, depth = None, 0
    for number, line in enumerate(text.splitlines(), start=1):
        if header := re.match(r"\s*\[\[?([^\]]+)\]", line):
            table = [part.strip().strip("\"'") for part in header[1].split(".")]
            here = table
        elif entry := re.match(r"\s*(\"[^\"]*\"|'[^']*'|[\w.-]+)\s*=", line):
            written = entry[1]
            parts = [written[1:-1]] if written[0] in "\"'" else written.split(".")
            here = [*table, *parts]
        else:
            continue
        if len(here) > depth and key[: len(here)] == here:
            best, depth = number, len(here)
    return best


def _change(tree: dict[str, Any], key: str, value: Any) -> str | None:
    first, *rest = key.split(".")
    if first in FLAT and rest:
        _set_flat(tree.setdefault(first, {}), rest, value)
        return None
    if not rest and (first in TABLES or not isinstance(value, dict)):
        return "found no dot, needed component.parameter=value, such as observer.filter_rate=500"
    if first in TABLES:
        table, path = tree.setdefault(first, {}), rest
    else:
        table, path = tree.get("components", {}), [first, *rest]
        if first not in table and len(path) > 1:
            return f"there is no component {first!r}; {nearest(first, [*table, *TABLES])}"
    for part in path[:-1]:
        if not isinstance(table.setdefault(part, {}), dict):
            table[part] = {}
        table = table[part]
    table[path[-1]] = deepcopy(value)  # a later change may reach into it
    return None


def _set_flat(table: dict[str, Any], signal: list[str], value: Any) -> None:
    """Set the entry of a signal, in whichever of the two spellings it was written."""
    if isinstance(nested := table.get(signal[0]), dict):
        nested.pop(".".join(signal[1:]), None)
    table[".".join(signal)] = value
