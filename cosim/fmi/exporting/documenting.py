"""The page of an exported FMU for people: documentation/index.html."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description
from cosim.native import build

STYLE = "body{font-family:sans-serif;max-width:60em;margin:2em auto}td,th{text-align:left;padding:.1em 1em .1em 0}"


def document(unit: Description, equations: str, *, text: str, main: Sequence[str]) -> str:
    """Write the page: what it is, its variables, its equations (HTML), how it is compiled."""
    kinds = " and ".join(INTERFACE_TYPE_NAMES[kind] for kind in unit.capabilities)
    rows = "".join(
        _row(
            "td",
            [
                v.name,
                v.causality,
                str(v.size),
                v.unit or "",
                "" if v.start is None else str(list(v.start)),
                v.doc,
            ],
        )
        for v in unit.variables
    )
    heading = _row("th", ["name", "causality", "elements", "unit", "start", ""])
    command = f"cc {' '.join(build.FLAGS)} {' '.join(main)} -o {unit.name}.so -lm"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{unit.name}</title><style>{STYLE}</style></head><body>\n"
        f"<h1>{unit.name}</h1>\n<p>{escape(text)}</p>\n<p>FMI {unit.version}, {kinds}; model {escape(unit.token)}.</p>\n"
        f"<h2>Variables</h2>\n<table>{heading}{rows}</table>\n<h2>Equations</h2>\n{equations}\n"
        f"<h2>Sources</h2>\n<p>They need a C11 compiler and nothing else; in sources/:</p>\n<pre>{command}</pre>\n"
        "<p>Without -ffp-contract=off the results may differ in the last bits.</p>\n</body></html>\n"
    )


def _row(tag: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>\n"
