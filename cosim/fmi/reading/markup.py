"""XML from outside: parsed without document types and entities, its attributes read by type."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Final, TypeVar, final
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from cosim.errors import quoted

DEEPEST: Final = 64  # elements in elements
CHUNK: Final = 2**16  # bytes: entities of a document type cannot grow large before it is refused

Value = TypeVar("Value")


@final
class _PlainTree(TreeBuilder):
    """Builds the tree of a document that has no document type."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("it has a document type (<!DOCTYPE ...>), which FMI does not use")


def parse(raw: bytes) -> Element:
    """Parse a document.

    Raises
    ------
    ValueError
        If it is not well-formed, in an encoding that is not known, has a document type, or is too
        deep.
    """
    parser = XMLParser(target=_PlainTree())
    try:
        for start in range(0, len(raw), CHUNK):
            parser.feed(raw[start : start + CHUNK])
        root: Element = parser.close()
    except (ParseError, LookupError) as error:  # the second: an unknown encoding
        raise ValueError(str(error)) from error
    _check_depth(root)
    return root


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause the garbage collector: it looks again and again at all that is read, and keeps it."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _check_depth(root: Element) -> None:
    level = [root]
    for _ in range(DEEPEST):
        level = list(chain.from_iterable(level))
    if level:
        raise ValueError(f"elements stand more than {DEEPEST} deep in each other")


@final
class Attributes:
    """Reads attributes by type; one that is not of its type goes to ``problems``, and is None.

    Attributes
    ----------
    problems : list of str
        Why the file is refused.
    warnings : list of str
        What is against the standard, and does not keep an FMU from running as it is meant.
    """

    def __init__(self) -> None:
        self.problems: list[str] = []
        self.warnings: list[str] = []

    def report(self, where: str, found: object, expected: str) -> None:
        """Add a problem: what was found at a place, and what was expected."""
        self.problems.append(f"{where}: expected {expected}, got {found}")

    def text(self, element: Element, name: str, where: str) -> str:
        """Read an attribute that must be there."""
        value = element.get(name)
        if value is None:
            self.problems.append(f"{where}: the attribute {name} is missing")
        return value or ""

    def number(self, element: Element, name: str, where: str) -> float | None:
        """Read an xs:double."""
        return self._convert(element.get(name), real, f"{where}: {name}", "a number")

    def optional_number(self, element: Element, name: str, where: str) -> float | None:
        """Read an xs:double that no run needs: what is none is a warning."""
        text = element.get(name)
        if text is None:
            return None
        try:
            return real(text)
        except ValueError:
            self.warnings.append(f"{where}: {name}: expected a number, got {quoted(text)}")
            return None

    def integer(self, element: Element, name: str, where: str) -> int | None:
        """Read an integer."""
        return self._convert(element.get(name), whole, f"{where}: {name}", "an integer")

    def reference(self, element: Element, name: str, where: str) -> int:
        """Read a value reference, which must be there."""
        text = element.get(name)
        if text is not None and text.isdecimal() and len(text) < 10:
            return int(text)
        reference = (
            self._convert(
                self.text(element, name, where) or None, whole, f"{where}: {name}", "an integer"
            )
            or 0
        )
        if not 0 <= reference < 2**32:
            self.report(f"{where}: {name}", reference, f"0 to {2**32 - 1}")
            return 0
        return reference

    def integers(self, element: Element, name: str, where: str) -> tuple[int, ...] | None:
        """Read a list of integers."""
        return self._convert(element.get(name), integers, f"{where}: {name}", "integers")

    def numbers(self, text: str | None, where: str) -> tuple[float, ...] | None:
        """Read a list of numbers or Booleans."""
        return self._convert(text, reals, where, "numbers")

    def _convert(
        self, text: str | None, convert: Callable[[str], Value], where: str, expected: str
    ) -> Value | None:
        if text is None:
            return None
        try:
            return convert(text)
        except ValueError:
            self.report(where, quoted(text), expected)
            return None


def flag(element: Element, name: str) -> bool:
    """Read an xs:boolean; false where it is missing."""
    return element.get(name, "").strip() in ("true", "1")


def whole(text: str) -> int:
    """Read an integer; Python's underscores are none of XML's, and no integer of FMI is long."""
    if "_" in text or len(text) > 100:
        raise ValueError
    return int(text)


def real(text: str) -> float:
    """Read an xs:double, or an xs:boolean as 0 or 1."""
    if "_" in text:
        raise ValueError
    word = text.strip()
    if word == "true":
        return 1.0
    if word == "false":
        return 0.0
    return float(word)


def integers(text: str) -> tuple[int, ...]:
    """Read a list of integers."""
    return tuple(whole(word) for word in text.split())


def reals(text: str) -> tuple[float, ...]:
    """Read a list of numbers or Booleans."""
    try:
        return (real(text),)  # most are one number
    except ValueError:
        return tuple(map(real, text.split()))
