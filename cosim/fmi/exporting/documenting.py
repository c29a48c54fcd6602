"""Write the page of an exported FMU for people: documentation/index.html."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description
from cosim.fmi.variable import Variable
from cosim.native import build

STYLE = (
    "body{font-family:sans-serif;max-width:60em;margin:2em auto}"
    "td,th{text-align:left;padding:.1em 1em .1em 0}"
)


def document(description: Description, equations: str, *, summary: str, main: Sequence[str]) -> str:
    """Write what the FMU is, its variables, its equations (HTML), and how it is compiled."""
    name = description.name
    interface_types = " and ".join(
        INTERFACE_TYPE_NAMES[interface_type] for interface_type in description.capabilities
    )
    heading = _row("th", ["name", "causality", "elements", "unit", "start", ""])
    rows = "".join(_row("td", _cells(variable)) for variable in description.variables)
    flags = " ".join(build.FLAGS)
    command = f"cc {flags} {' '.join(main)} -o {name}.so -lm"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{name}</title><style>{STYLE}</style></head><body>\n"
        f"<h1>{name}</h1>\n<p>{escape(summary)}</p>\n"
        f"<p>FMI {description.version}, {interface_types}; model {escape(description.token)}.</p>\n"
        f"<h2>Variables</h2>\n<table>{heading}{rows}</table>\n"
        f"<h2>Equations</h2>\n{equations}\n"
        "<h2>Sources</h2>\n<p>They need a C11 compiler and nothing else; in sources/:</p>\n"
        f"<pre>{command}</pre>\n"
        "<p>Without -ffp-contract=off the results may differ in the last bits.</p>\n"
        "</body></html>\n"
    )


def _cells(variable: Variable) -> list[str]:
    start = ""
    if variable.start is not None:
        start = str(list(variable.start))
    size = str(variable.size)
    return [variable.name, variable.causality, size, variable.unit or "", start, variable.doc]


def _row(tag: str, cells: Sequence[str]) -> str:
    elements = [f"<{tag}>{escape(cell)}</{tag}>" for cell in cells]
    return f"<tr>{''.join(elements)}</tr>\n"
