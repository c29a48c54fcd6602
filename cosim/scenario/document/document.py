"""The text of a scenario, the edits made to it from outside, and where in it a key stands."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from cosim.arguments import path_argument
from cosim.errors import ScenarioError, UsageError, command, nearest, option, quoted
from cosim.files import file_type, read_bounded
from cosim.log.contents.metadata import json_table
from cosim.scenario.document.edits import (
    SET,
    TOO_MANY_DIGITS,
    change,
    component_in,
    flatten_tables,
    given_twice,
    plain,
    short,
)
from cosim.scenario.document.lines import key_lines
from cosim.scenario.document.places import Places
from cosim.scenario.document.problems import Problem
from cosim.scenario.document.swap import (
    PortNames,
    is_port_names,
    marked_path,
    owner_of,
    replace_components,
    swapped_components,
)

SUFFIX = ".toml"
LARGEST = 2**26  # bytes of a scenario


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
        :mod:`cosim.scenario.document.swap`.
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
        if kept:
            tree, _ = self.tree()
            for port in self.maps:
                if owner_of(tree, port) in swaps:
                    del kept[port]
        return replace(self, swaps=paths, maps=kept | _checked_maps(maps or {}))

    def with_changes(self, changes: Mapping[str, Any]) -> Document:
        """Set values; ``components.observer.L`` and ``observer.L`` are the same key.

        A key may reach into lists: ``delta.terms[0].theta``.

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
        swapped = self.swapped_components()
        inputs = tuple(f"connections.{name}." for name in swapped)
        changes = {}
        for key, value in self.changes.items():
            if component_in(key) not in swapped and not key.startswith(inputs):
                changes[key] = value
        # a map without its swap would be a problem, which keeps the scenario from being initialized
        return replace(self, swaps={}, maps={}, changes=changes, swapped=False)

    def swapped_components(self) -> list[str]:
        """Return the names of the swapped components."""
        return swapped_components(self.tree()[0]) if self.swapped else []

    def edits(self) -> str:
        """Return swaps, maps and changes as JSON, for the log."""
        edits = {"swaps": self.swaps, "maps": self.maps, "changes": self.changes}
        return json.dumps({"source": self.source and os.path.relpath(self.source), **edits})

    @staticmethod
    def recorded(text: str, edits: str, folder: Path) -> Document:
        """Rebuild a document from a log.

        Parameters
        ----------
        text : str
        edits : str
            As :meth:`edits` returned them.
        folder : Path

        Raises
        ------
        ValueError
            If the edits are something else.
        """
        recorded = _read_edits(edits)
        return Document(
            text,
            recorded["source"],
            folder,
            swaps=recorded["swaps"],
            maps=recorded["maps"],
            changes=recorded["changes"],
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
        problems = flatten_tables(tree)
        if self.swapped:
            problems += replace_components(tree, self.swaps)
        else:
            tree.pop("swap", None)
        for key, value in self.changes.items():
            text = change(tree, key, value)
            if text is not None:
                problems.append(((SET, key), text))
        problems += flatten_tables(tree)  # again, for the tables that were set
        return tree, problems

    def _parsed(self) -> dict[str, Any]:
        lines = key_lines(self.text)
        try:
            lines.check_depth()
            return _copied(_parse(self.text))
        except UsageError as error:
            raise ScenarioError(f"{self.source}:{lines.deepest}: {error}") from error
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(self._syntax(error)) from error
        except ValueError as error:  # of Python's int
            raise ScenarioError(f"{self.source}: {TOO_MANY_DIGITS}") from error

    def _syntax(self, error: tomllib.TOMLDecodeError) -> str:
        message = str(error)
        position = re.search(r"\(at line (\d+), column (\d+)\)", message)
        if position is None:
            return f"{self.source}: not TOML: {message}"
        place = f"{self.source}:{position[1]}"
        number = int(position[1])
        line = self.text.split("\n")[number - 1]
        key = line.split("=")[0].strip()
        if "overwrite" not in message and "twice" not in message:
            return f"{place}: not TOML: {message}{_quotes_missing(key)}{_escaped(line)}"
        return f"{place}: {given_twice(key, key_lines(self.text).table(number))}"

    def report(self, problems: Iterable[Problem]) -> ScenarioError:
        """Return one error with every problem at its place."""
        places = Places(
            self.source,
            key_lines(self.text),
            changes=self.changes,
            swaps=self.swaps,
            maps=self.maps,
            swapped=self.swapped_components(),
        )
        return ScenarioError(places.report(problems))


def _read_edits(text: str) -> dict[str, Any]:
    """Read the edits of a document from JSON.

    Raises
    ------
    ValueError
        If they are not what :meth:`Document.edits` writes.
    """
    edits = json_table(text)
    for key, kind in (("source", str), ("swaps", dict), ("changes", dict)):
        if not isinstance(edits.get(key), kind):
            raise ValueError(f"{key}: got {quoted(edits.get(key))}")
    maps = edits.setdefault("maps", {})
    if not isinstance(maps, dict):
        raise ValueError(f"maps: got {quoted(maps)}")
    for name, path in edits["swaps"].items():
        if not isinstance(path, str):
            raise ValueError(f"{name!r}: expected a path, got {quoted(path)}")
    for port, names in maps.items():
        if not is_port_names(names):
            raise ValueError(f"{port!r}: expected port names, got {quoted(names)}")
    return edits


def _checked_maps(maps: Mapping[str, PortNames]) -> dict[str, PortNames]:
    """Return a copy of names by port, after a check of each.

    Raises
    ------
    UsageError
        If what a port is mapped to is no name and no list of names.
    """
    for port, names in maps.items():
        if not is_port_names(names):
            raise UsageError(
                f"{option('map', port)}: expected a name or a list of names, got {quoted(names)}"
            )
    return dict(maps)


def _quotes_missing(key: str) -> str:
    """Return the way out where a key has letters that need quotes."""
    if key.isascii() or '"' in key or "'" in key:
        return ""
    return "; keys with non-ASCII letters must be quoted"


def _escaped(line: str) -> str:
    """Return the way out where a text in double quotes may be a path of Windows."""
    if not re.search(r'"[^"]*\\', line):
        return ""
    return "; in double quotes a backslash begins an escape: write a path in single quotes"


def _copied(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of tables: far quicker than ``deepcopy``, as TOML has lists and tables only."""
    return {key: _copied_value(value) for key, value in table.items()}


def _copied_value(value: Any) -> Any:
    if isinstance(value, dict):
        return _copied(value)
    if isinstance(value, list):
        return [_copied_value(entry) for entry in value]
    return value


@lru_cache(maxsize=8)  # a document and its edits share one text
def _parse(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


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
    way_out = _way_out(path)
    if file_type(path) == "scenario" or (path.is_file() and not way_out):
        folder = path.absolute().parent
        return Document(_read_text(path), str(path), folder)
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


def _way_out(path: Path) -> str:
    """Return what to do with a log or an FMU instead; empty for another file."""
    match file_type(path):
        case "log":
            return f"{command('replay')} replays a log, 'cosim info' shows it"
        case "FMU":
            return (
                "'cosim info' shows an FMU, 'cosim check' tests it; a scenario uses it as a "
                f'component of kind "fmu", or in place of another: {option("swap", "NAME", "PATH")}'
            )
        case _:
            return ""


def _read_text(path: Path) -> str:
    try:
        text = read_bounded(path, LARGEST).decode("utf-8-sig")
        return text.replace("\r\n", "\n")
    except OSError as error:
        names = ", ".join(shipped())
        raise ScenarioError(
            f"{path}: cannot be read ({error.strerror}); expected a scenario file, or one of: "
            f"{names}"
        ) from error
    except UnicodeDecodeError as error:
        raise ScenarioError(
            f"{path}: is not UTF-8 text (byte {error.start}); expected a scenario in TOML"
        ) from error


def shipped() -> list[str]:
    """Return the names of the shipped scenarios."""
    names = [file.name for file in _library().iterdir()]
    return sorted(name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX))


def _library() -> Traversable:
    """Return the folder of the shipped scenarios."""
    return resources.files("cosim.scenario") / "library"
