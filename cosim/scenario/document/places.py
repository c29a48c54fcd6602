"""Where the keys of a scenario stand: a line of its file, or an edit from outside.

A key is written as ``components.delta.terms[0].theta``, whatever parts it has in the file: the port
in ``"plant.u" = ...`` and in ``plant.u = ...`` is the same. What is not there itself stands where
the nearest of the keys around it does.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, TypeAlias

from cosim.errors import listing, shortened

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
def key_lines(text: str) -> dict[str, int]:
    """Return the lines of the tables and keys of a text, from 1, by the keys as they are written.

    What is inside a value has the line of its key.
    """
    lines: dict[str, int] = {}
    counts: dict[Key, int] = {}  # of the tables in arrays of them
    table: Key = ()
    depth = 0  # of the brackets that are open
    bare = _LITERALS.sub(lambda match: re.sub(r"[^\n]", "_", match[0]), text)
    pairs = zip(text.split("\n"), bare.split("\n"), strict=True)
    for number, (line, outside) in enumerate(pairs, start=1):
        content = outside.strip()
        if depth == 0 and content.startswith("["):
            table = _path(line)
            lines.setdefault(written(table), number)
            if content.startswith("[["):
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
                lines[written(table)] = number
            continue
        if depth == 0 and "=" in outside:
            key = (*table, *_path(f"{line[: outside.index('=')]}= 0"))
            lines[written(key)] = number  # of a key that is given twice, in two spellings, the last
        depth += sum(map(outside.count, "[{")) - sum(map(outside.count, "]}"))
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


def report(
    problems: Iterable[Problem],
    source: str,
    text: str,
    edits: Mapping[str, str] | None = None,
    swapped: Collection[str] = (),
) -> str:
    """Return every problem at its place, each once.

    Parameters
    ----------
    problems : iterable of Problem
    source, text : str
        The file, and what is in it.
    edits : mapping of str to str, optional
        By what keys were edited from outside.
    swapped : collection of str
        The components that stand where another one is swapped in.
    """
    lines: dict[str, None] = {}
    for key, problem in problems:
        in_file = key
        if key[:1] == ("components",) and key[1:2] and key[1] in swapped:
            in_file = ("swap", *key[1:])
        label = _label(written(key), written(in_file), edits or {}, source, key_lines(text))
        for line in problem.splitlines():
            lines[shortened(f"{label}: {line}", MOST_LINE)] = None
    return "\n".join(lines)


def _label(
    key: str, in_file: str, edits: Mapping[str, str], source: str, lines: Mapping[str, int]
) -> str:
    """Return where a key stands and its name: what a message begins with."""
    name = shortened(key)
    for outer in _outwards(key):
        if outer in edits:
            return edits[outer] if outer == key else f"{edits[outer]}: {name}"
    beginnings = (f"{key}.", f"{key}[")
    numbers = [lines[outer] for outer in _outwards(in_file) if outer in lines]
    numbers = numbers or [lines[inner] for inner in lines if inner.startswith(beginnings)]
    place = f"{source}:{numbers[0]}" if numbers else source
    inside = sorted({edit for at, edit in edits.items() if at.startswith(beginnings)})
    if inside:
        place += f" (with {listing(inside, _MOST_EDITS)})"
    return f"{place}: {name}" if name else place


def _outwards(key: str) -> Iterator[str]:
    """Yield a key and those around it, the innermost first."""
    while key:
        yield key
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
