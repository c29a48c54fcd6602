"""Texts from logs and FMUs as a terminal may show them, and how they are printed."""

from __future__ import annotations

import unicodedata
from typing import Final

import typer

_KEPT: Final = frozenset("\n\t")
_HARMFUL: Final = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})  # categories of Unicode


def printable(text: str) -> str:
    r"""Return a text without what a terminal obeys instead of showing it.

    Control characters, such as those of escape sequences, characters that change the direction of
    the text, and lone surrogates are shown as Python writes them: ``\x1b``. Line feeds and tabs
    stay.
    """
    if text.isprintable():
        return text
    return "".join(map(_shown, text))


def printable_line(text: str) -> str:
    """Return a text as :func:`printable` does, in one line and without tabs."""
    return " ".join(printable(text).split("\n")).replace("\t", " ")


def print_text(text: object) -> None:
    """Print a line of data, to stdout."""
    typer.echo(printable(str(text)))


def print_notice(text: str) -> None:
    """Print a message, to stderr."""
    typer.echo(printable(text), err=True)


def _shown(character: str) -> str:
    if character in _KEPT or unicodedata.category(character) not in _HARMFUL:
        return character
    return character.encode("unicode_escape").decode("ascii")
