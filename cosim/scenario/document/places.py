"""Where the keys of a scenario stand: a line of its file, or an edit from outside."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from cosim.errors import option, shortened
from cosim.scenario.document.edits import FLAT, SET, short
from cosim.scenario.document.elements import address
from cosim.scenario.document.lines import KeyLines
from cosim.scenario.document.problems import Key, Problem
from cosim.scenario.document.swap import MAP

MOST_LINE = 1000  # characters, of a report
MOST_EDITS = 3  # that the place of a table names


class Places:
    """The places of the keys of a scenario.

    Parameters
    ----------
    source : str
        Name of the file.
    lines : KeyLines
        Of its text.
    changes : iterable of str
        Keys that were set from outside.
    swaps, maps : collection of str
        Components that were swapped from outside, ports that were mapped.
    swapped : collection of str
        All components that are swapped.
    """

    def __init__(
        self,
        source: str,
        lines: KeyLines,
        *,
        changes: Iterable[str],
        swaps: Collection[str],
        maps: Collection[str],
        swapped: Iterable[str],
    ) -> None:
        self._source = source
        self._lines = lines
        self._changes: dict[str, str] = {}  # as they were written, also by the keys of problems
        for change in changes:
            self._changes[address(change)] = change
            self._changes[change] = change
        self._swaps = swaps
        self._maps = maps
        self._swapped = set(swapped)
        self._inside: dict[str, list[str]] = {}  # changes by the tables that they are in
        for change in dict.fromkeys(self._changes.values()):
            for outer in _prefixes(address(change))[1:]:
                self._inside.setdefault(outer, []).append(change)

    def report(self, problems: Iterable[Problem]) -> str:
        """Return every problem at its place, each once."""
        lines: dict[str, None] = {}
        for key, text in problems:
            label = self._label(key)
            for line in text.splitlines():
                lines[shortened(f"{label}: {line}", MOST_LINE)] = None
        return "\n".join(lines)

    def _label(self, key: Key) -> str:
        """Return where a key stands and its name: what a message begins with."""
        match key:
            case (first, str(name)) if first == SET:
                return option("set", name)
            case (first, str(name)) if first == MAP:
                return option("map", name)
            case ("swap", *_) if self._swap_edit(key):  # that has the name
                return self._swap_edit(key)
        place = self._place(key)
        edit = self._changes.get(short(".".join(map(str, key))))
        if edit is not None and place == option("set", edit):
            return place  # which names the key
        dotted = shortened(".".join(map(str, key)))
        return f"{place}: {dotted}" if dotted else place

    def _place(self, key: Key) -> str:
        """Return where a key stands: file and line, or the edit that set it."""
        names = [str(part) for part in key]
        dotted = short(".".join(names))
        for outer in _prefixes(dotted):
            if outer in self._changes:
                return option("set", self._changes[outer])
        match names:
            case ["components", name, *_] if name in self._swapped:
                return self._place(("swap", name))
            case ["swap", *_] if self._swap_edit(key):
                return self._swap_edit(key)
        line = self._line(key)
        place = self._source if line is None else f"{self._source}:{line}"
        edits = [option("set", change) for change in sorted(self._inside.get(dotted, ()))]
        if len(edits) > MOST_EDITS:
            edits[MOST_EDITS:] = [f"{len(edits) - MOST_EDITS} more"]
        return f"{place} (with {', '.join(edits)})" if edits else place

    def _swap_edit(self, key: Key) -> str:
        """Return the edit that a key of [swap] comes from; empty if it stands in the file."""
        match key:
            case (_, _, _, str(port), *_) if port in self._maps:
                return option("map", port)
            case (_, str(name), *_) if name in self._swaps:
                return option("swap", name)
        return ""

    def _line(self, key: Key) -> int | None:
        """Return the line of a key; a port may be written as one key or as two."""
        length = _length_with_port(key)
        if not length or key[:length] in self._lines.lines:
            return self._lines.find(key)
        outer = key[: length - 1]
        port = str(key[length - 1])
        inner = key[length:]
        return self._lines.find((*outer, *port.split(".", 1), *inner))


def _length_with_port(key: Key) -> int:
    """Return how many parts of a key end with the port that an entry is for; 0: it has none."""
    match key:
        case ("swap", _, "map", _, *_):
            return 4
        case (table, _, *_) if table in FLAT:
            return 2
    return 0


def _prefixes(dotted: str) -> list[str]:
    """Return a dotted key and the keys of the tables that it is in, the innermost first."""
    prefixes = [dotted]
    while "." in dotted:
        dotted = dotted.rpartition(".")[0]
        prefixes.append(dotted)
    return prefixes
