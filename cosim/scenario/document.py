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

Key = tuple[str | int, ...]
SUFFIX = ".toml"
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
    changes : mapping of dotted key to value
        Values set after that, such as ``observer.filter_rate``.
    """

    text: str
    source: str
    folder: Path
    swaps: Mapping[str, str] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)

    def with_swaps(self, swaps: Mapping[str, str]) -> Document:
        """Replace components; paths are taken from the working directory."""
        absolute = {name: str(Path(path).absolute()) for name, path in swaps.items()}
        return replace(self, swaps={**self.swaps, **absolute})

    def with_changes(self, changes: Mapping[str, Any]) -> Document:
        """Set values; ``components.observer.L`` and ``observer.L`` are the same key."""
        return replace(self, changes={**self.changes, **{short(key): plain(value) for key, value in changes.items()}})

    def edits(self) -> str:
        """Give swaps and changes as JSON, for the log."""
        return json.dumps({"source": self.source, "swaps": dict(self.swaps), "changes": dict(self.changes)})

    @staticmethod
    def recorded(text: str, edits: str, folder: Path) -> Document:
        """Rebuild a document from a log."""
        found = json.loads(edits)
        return Document(text, found["source"], folder, found["swaps"], found["changes"])

    def tree(self) -> dict[str, Any]:
        """Parse the text and apply the changes.

        Raises
        ------
        ScenarioError
            If the text is no TOML, gives something twice, or a change names what is not there.
        """
        try:
            tree = tomllib.loads(self.text)
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(self._syntax(error)) from error
        problems = [problem for name, path in self.swaps.items() if (problem := _swap(tree, name, path))]
        problems += [problem for key, value in self.changes.items() if (problem := _change(tree, key, value))]
        if problems:
            raise ScenarioError("\n".join(problems))
        return tree

    def place(self, key: Key) -> str:
        """Say where a key stands: file and line, or the option that set it."""
        names = [str(part) for part in key]
        dotted = short(".".join(names))
        for change in self.changes:
            if dotted == change or dotted.startswith(f"{change}."):
                return f"--set {change}"
        if names[:1] == ["components"] and len(names) > 1 and names[1] in self.swaps:
            return f"--swap {names[1]}"
        line = find_line(self.text, names)
        inside = [f"--set {change}" for change in self.changes if change.startswith(f"{dotted}.")]
        return (f"{self.source}:{line}" if line else self.source) + (f" (with {', '.join(inside)})" if inside else "")

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
            raise ScenarioError(f"{name}: is no text in UTF-8 ({error}); needed a scenario in TOML") from error
    if name in shipped():
        text = (resources.files("cosim.scenario") / "library" / f"{name}{SUFFIX}").read_text(encoding="utf-8")
        return Document(text, name, Path.cwd())
    raise ScenarioError(
        f"there is no scenario {name!r}; give a path to a .toml file, or a shipped one. {nearest(name, shipped())}"
    )


def shipped() -> list[str]:
    """List the names of the shipped scenarios."""
    folder = resources.files("cosim.scenario") / "library"
    return sorted(entry.name.removesuffix(SUFFIX) for entry in folder.iterdir() if entry.name.endswith(SUFFIX))


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


def _swap(tree: dict[str, Any], name: str, path: str) -> str | None:
    components = tree.get("components", {})
    if name not in components:
        return f"--swap {name}: there is no component {name!r}; {nearest(name, components)}"
    kinds = {".fmu": {"kind": "fmu", "path": path}, ".mcap": {"kind": "recording", "log": path, "component": name}}
    suffix = Path(path).suffix.lower()
    if suffix not in kinds:
        return f"--swap {name}: found {path!r}, needed a path that ends in .fmu (an FMU) or .mcap (a recorded log)"
    components[name] = kinds[suffix]
    return None


def _change(tree: dict[str, Any], key: str, value: Any) -> str | None:
    first, *rest = key.split(".")
    if first in FLAT and rest:
        _set_flat(tree.setdefault(first, {}), rest, value)
        return None
    if not rest and (first in TABLES or not isinstance(value, dict)):
        return f"--set {key}: found no dot, needed component.parameter=value, such as observer.filter_rate=500"
    if first in TABLES:
        table, path = tree.setdefault(first, {}), rest
    else:
        table, path = tree.get("components", {}), [first, *rest]
        if first not in table and len(path) > 1:
            return f"--set {key}: there is no component {first!r}; {nearest(first, [*table, *TABLES])}"
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
