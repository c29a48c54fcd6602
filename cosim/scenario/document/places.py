"""Where the keys of a scenario stand: a line of its file, or an edit from outside."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, TypeAlias

from cosim.errors import shortened

Key: TypeAlias = tuple[str | int, ...]  # where a value stands in the tables of a scenario
Problem: TypeAlias = tuple[Key, str]

PORTS: Final = ("connections", "truth")  # tables whose keys are the names of ports
MOST_LINE: Final = 1000  # characters, of a report
_MOST_EDITS: Final = 3  # that the place of a table names
_LITERALS: Final = re.compile(
    r'"{3}(?:\\.|[^\\])*?"{3,5}(?!")'
    r"|'{3}.*?'{3,5}(?!')"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'|\#[^\n]*",
    re.DOTALL,
)


def written(key: Key) -> str:
    """Return a key as it is written: ``("terms", 0, "theta")`` as ``terms[0].theta``."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


@lru_cache(maxsize=8)  # a document and its edits share one text
def key_lines(text: str) -> dict[Key, int]:
    """Return the lines of the tables and keys of a text, from 1.

    Elements of a list over several lines have the lines that they begin in; what else is inside a
    value has the line of its key.
    """
    lines: dict[Key, int] = {}
    counts: dict[Key, int] = {}  # of the tables in arrays of them
    table: Key = ()
    value: Key = ()  # the key whose value is read
    depth = 0  # of the brackets that are open
    element = 0  # of the outermost list
    bare = _LITERALS.sub(lambda match: re.sub(r"[^\n]", "_", match[0]), text)
    pairs = zip(text.split("\n"), bare.split("\n"), strict=True)
    for number, (line, outside) in enumerate(pairs, start=1):
        content = outside.strip()
        if depth == 0 and content.startswith("["):
            table = _path(line)
            lines.setdefault(_with_port(table), number)
            if content.startswith("[["):
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
                lines[table] = number
            continue
        if depth == 0 and "=" in outside:
            value = _with_port((*table, *_path(f"{line[: outside.index('=')]}= 0")))
            lines.setdefault(value, number)
            element = 0
        elif depth == 1 and content and content[0] != "]":
            lines.setdefault((*value, element), number)
        for mark in re.findall(r"[\[\]{},]", outside):
            element += mark == "," and depth == 1
            depth += (mark in "[{") - (mark in "]}")
    return lines


def _path(line: str) -> Key:
    """Return the key that a line of TOML has."""
    path: list[str] = []
    with suppress(tomllib.TOMLDecodeError):  # for the parser to report
        inner: Any = tomllib.loads(line)
        while inner:
            name, inner = next(iter(inner.items()))
            path.append(name)
            inner = inner[0] if isinstance(inner, list) else inner
    return tuple(path)


def _with_port(key: Key) -> Key:
    """Return a key with the port that an entry is for as one part, as it may be two in a file."""
    at = {"connections": 1, "truth": 1, "swap": 3, "actions": 3}.get(str(key[0]), 0) if key else 0
    if at == 3 and key[2:3] not in (("map",), ("set",)):
        return key
    if not at or len(key) < at + 2 or "." in str(key[at]):
        return key
    return (*key[:at], ".".join(map(str, key[at : at + 2])), *key[at + 2 :])


def report(
    problems: Iterable[Problem],
    source: str,
    text: str,
    edits: Mapping[Key, str] | None = None,
    swapped: Collection[str] = (),
) -> str:
    """Return every problem at its place, each once.

    Parameters
    ----------
    problems : iterable of Problem
    source, text : str
        The file, and what is in it.
    edits : mapping of Key to str, optional
        What was edited from outside, and by what.
    swapped : collection of str
        The components that stand where another one is swapped in.
    """
    lines: dict[str, None] = {}
    for key, problem in problems:
        label = _label(key, source, key_lines(text), edits or {}, swapped)
        for line in problem.splitlines():
            lines[shortened(f"{label}: {line}", MOST_LINE)] = None
    return "\n".join(lines)


def _label(
    key: Key,
    source: str,
    lines: Mapping[Key, int],
    edits: Mapping[Key, str],
    swapped: Collection[str],
) -> str:
    """Return where a key stands and its name: what a message begins with."""
    name = shortened(written(key))
    outer = [key[:length] for length in range(len(key), 0, -1)]
    if key[:1] == ("components",) and key[1:2] and key[1] in swapped:
        outer[-1:-1] = [("swap", str(key[1]))]
    for one in outer:
        if one in edits:
            return edits[one] if one == key else f"{edits[one]}: {name}"
        if one[:1] == ("swap",) and one in lines:
            return f"{source}:{lines[one]}: {name}"
    place = next((f"{source}:{lines[one]}" for one in outer if one in lines), source)
    inside = sorted({edit for one, edit in edits.items() if key and one[: len(key)] == key})
    if len(inside) > _MOST_EDITS:
        inside[_MOST_EDITS:] = [f"{len(inside) - _MOST_EDITS} more"]
    if inside:
        place += f" (with {', '.join(inside)})"
    return f"{place}: {name}" if name else place
