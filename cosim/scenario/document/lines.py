"""The lines of a TOML text where its keys stand, and how deep its values are nested.

One pass over the tokens; it only looks for keys, and leaves what is no TOML to the parser.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from functools import lru_cache

from cosim.errors import UsageError
from cosim.scenario.document.problems import Key

MOST_LEVELS = 50  # of tables and arrays inside each other

_TOKENS = re.compile(
    r"""
      (?P<newline>\n)
    | (?P<comment>\#[^\n]*)
    | (?P<long>\"{3}(?:\\.|[^\\])*?\"{3,5}(?!\") | '{3}.*?'{3,5}(?!'))
    | (?P<quoted>"(?:\\.|[^"\\\n])*" | '[^'\n]*')
    | (?P<mark>[\[\]{}=,.])
    | (?P<bare>[^\s\[\]{}=,.\#"']+)
    """,
    re.VERBOSE | re.DOTALL,
)


@dataclass(slots=True)
class _Bracket:
    """An array or an inline table that is open, and the key that it is the value of."""

    is_array: bool
    key: Key
    element: int = 0


@dataclass(slots=True)
class KeyLines:
    """The lines of the keys of a text, from 1.

    Parameters
    ----------
    lines : mapping of Key to int
        Elements of arrays have their index as part of the key.
    depth : int
        Levels of tables and arrays, the most there are.
    deepest : int
        The line where these are.
    """

    lines: dict[Key, int] = field(default_factory=dict)
    depth: int = 0
    deepest: int = 1

    def find(self, key: Key) -> int | None:
        """Return the line where a key or the largest outer part of it stands."""
        for length in range(len(key), 0, -1):
            line = self.lines.get(key[:length])
            if line is not None:
                return line
        return None

    def table(self, number: int) -> str:
        """Return the name of the outermost table that a line is part of; empty: there is none."""
        above = [(line, key) for key, line in self.lines.items() if line <= number]
        _, key = max(above, key=lambda item: item[0], default=(0, ("",)))
        return str(key[0])

    def check_depth(self) -> None:
        """Check that no value is nested too deep.

        Raises
        ------
        UsageError
            If one is.
        """
        if self.depth - 1 > MOST_LEVELS:  # the last part names a value
            raise UsageError(
                f"expected tables and lists nested at most {MOST_LEVELS} levels deep, got more"
            )


@lru_cache(maxsize=8)  # a document and its edits share one text
def key_lines(text: str) -> KeyLines:
    """Find the keys of a text."""
    return _Scanner().scan(text)


class _Scanner:
    """Goes over the tokens of a text once."""

    def __init__(self) -> None:
        self._found = KeyLines()
        self._line = 1
        self._table: Key = ()
        self._brackets: list[_Bracket] = []
        self._parts: list[str] = []  # of the key that is being read
        self._key: Key = ()  # whose value is being read
        self._in_value = False
        self._in_header = False
        self._tables: dict[Key, int] = {}  # tables of each array of tables

    def scan(self, text: str) -> KeyLines:
        """Return the lines of all keys."""
        for token in _TOKENS.finditer(text):
            if (
                self._found.depth - 1 > MOST_LEVELS
            ):  # refused: keys that grow further cost time alone
                break
            content = token[0]
            match token.lastgroup:
                case "newline":
                    self._end_line()
                case "mark":
                    self._mark(content)
                case "bare" | "quoted" | "long":
                    self._word(content)
            self._line += content.count("\n")
        return self._found

    def _end_line(self) -> None:
        if not self._brackets:
            self._in_value = False
            self._in_header = False
            self._parts = []

    def _word(self, content: str) -> None:
        if self._in_value:
            self._note(self._value_key())
        elif content[0] in "\"'":
            self._parts.append(_unquoted(content))
        else:
            self._parts.append(content)

    def _mark(self, mark: str) -> None:
        match mark:
            case "[" | "{" if self._in_value:
                self._open(mark)
            case "[":
                self._in_header = True
            case "]" if self._in_header:
                self._header()
            case "]" | "}":
                self._close()
            case "=" if not self._in_value:
                self._key = (*self._outer(), *self._parts)
                self._parts = []
                self._in_value = True
                self._note(self._key)
            case ",":
                self._comma()

    def _header(self) -> None:
        """Enter a table, with the second bracket of an array of tables once more."""
        if self._parts:
            self._table = tuple(self._parts)
            self._parts = []
            self._note(self._table)
        else:  # ]]
            number = self._tables.get(self._table, 0)
            self._tables[self._table] = number + 1
            self._table = (*self._table, number)
            self._note(self._table)

    def _outer(self) -> Key:
        """Return the key of the table that is being read."""
        return self._brackets[-1].key if self._brackets else self._table

    def _value_key(self) -> Key:
        """Return the key of the value that is being read."""
        if self._brackets and self._brackets[-1].is_array:
            bracket = self._brackets[-1]
            return (*bracket.key, bracket.element)
        return self._key

    def _open(self, mark: str) -> None:
        key = self._value_key()
        self._note(key)
        self._brackets.append(_Bracket(mark == "[", key))
        self._in_value = mark == "["

    def _close(self) -> None:
        if self._brackets:
            self._brackets.pop()
        self._in_value = True

    def _comma(self) -> None:
        if not self._brackets:
            return
        bracket = self._brackets[-1]
        if bracket.is_array:
            bracket.element += 1
        else:
            self._in_value = False

    def _note(self, key: Key) -> None:
        if len(key) > self._found.depth:
            self._found.depth = len(key)
            self._found.deepest = self._line
        if self._found.lines.get(key[:-1]) != self._line:  # else that is found in its place
            self._found.lines.setdefault(key, self._line)


def _unquoted(text: str) -> str:
    """Return the key in quotes."""
    if "\\" not in text:
        return text[1:-1]
    try:
        key: str = tomllib.loads(f"key = {text}")["key"]
    except tomllib.TOMLDecodeError:  # for the parser to report
        return text
    return key
