"""XML from outside: parsed without document types and entities, its attributes read as what they should be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar, final
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

DEEPEST: Final = 64  # elements in elements
CHUNK: Final = 2**16  # bytes: entities of a document type cannot grow large before it is refused

Value = TypeVar("Value")


@final
class _Tree(TreeBuilder):
    """Builds the tree of a document that has no document type and is not deep."""

    depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        self.depth += 1
        if self.depth > DEEPEST:
            raise ValueError(f"elements stand more than {DEEPEST} deep in each other")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("it has a document type (<!DOCTYPE ...>), which FMI does not use")


def parse(raw: bytes) -> Element:
    """Parse a document.

    Raises
    ------
    ValueError
        If it is not well-formed, in an encoding that is not known, has a document type, or is too deep.
    """
    parser = XMLParser(target=_Tree())
    try:
        for start in range(0, len(raw), CHUNK):
            parser.feed(raw[start : start + CHUNK])
        root: Element = parser.close()
    except (ParseError, LookupError) as error:  # the second: an unknown encoding
        raise ValueError(str(error)) from error
    return root


@final
class Attributes:
    """Reads attributes; what is not what it should be goes to ``problems``, and is None.

    Parameters
    ----------
    problems : list of str
        Is appended to.
    """

    def __init__(self, problems: list[str]) -> None:
        self.problems = problems

    def text(self, element: Element, name: str, where: str) -> str:
        """Give an attribute that must be there."""
        found = element.get(name)
        if found is None:
            self.problems.append(f"{where}: the attribute {name} is missing")
        return found or ""

    def number(self, element: Element, name: str, where: str) -> float | None:
        """Give an xs:double."""
        return self._converted(element.get(name), real, f"{where}: {name}", "a number")

    def integer(self, element: Element, name: str, where: str) -> int | None:
        """Give an integer."""
        return self._converted(element.get(name), whole, f"{where}: {name}", "an integer")

    def reference(self, element: Element, name: str, where: str) -> int:
        """Give a value reference, which must be there."""
        found = (
            self._converted(
                self.text(element, name, where) or None, whole, f"{where}: {name}", "an integer"
            )
            or 0
        )
        if not 0 <= found < 2**32:
            self.problems.append(f"{where}: {name}: found {found}, needed 0 to {2**32 - 1}")
            return 0
        return found

    def integers(self, element: Element, name: str, where: str) -> tuple[int, ...] | None:
        """Give a list of integers."""
        return self._converted(element.get(name), integers, f"{where}: {name}", "integers")

    def numbers(self, text: str | None, where: str) -> tuple[float, ...] | None:
        """Give a list of numbers or Booleans."""
        return self._converted(text, reals, where, "numbers")

    def _converted(
        self, text: str | None, convert: Callable[[str], Value], where: str, needed: str
    ) -> Value | None:
        if text is None:
            return None
        try:
            return convert(text)
        except ValueError:
            self.problems.append(f"{where}: found {text[:100]!r}, needed {needed}")
            return None


def flag(element: Element, name: str) -> bool:
    """Give an xs:boolean; false where it is missing."""
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
    return {"true": 1.0, "false": 0.0}.get(word) if word in ("true", "false") else float(word)  # type: ignore[return-value]


def integers(text: str) -> tuple[int, ...]:
    """Read a list of integers."""
    return tuple(whole(word) for word in text.split())


def reals(text: str) -> tuple[float, ...]:
    """Read a list of numbers or Booleans."""
    return tuple(real(word) for word in text.split())
