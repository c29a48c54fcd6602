"""Tables and JSON on stdout."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

WIDTH = 118  # columns, where stdout is no terminal


def new_table(title: str, columns: Sequence[str]) -> Table:
    """Return an empty table without lines."""
    table = Table(title=title, header_style="", box=None, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def print_table(table: Table) -> None:
    """Print a table, its title on a line of its own, which a narrow table would break."""
    console = _console()
    if table.title:
        console.print(table.title, style="bold", soft_wrap=True)
        table.title = None
    console.print(table)


def print_section(title: str, content: Any) -> None:
    """Print rows, a list of mappings with the same keys, or one mapping; nothing if it is empty."""
    if not content:
        return
    if isinstance(content, Mapping):
        table = new_table(title, ("", ""))
        for key, value in content.items():
            table.add_row(key, _cell(value))
    else:
        columns = list(content[0])
        table = new_table(title, columns)
        for row in content:
            cells = [_cell(row.get(column)) for column in columns]
            table.add_row(*cells)
    print_table(table)


def print_json(content: Any) -> None:
    """Print JSON; numbers that it has no word for are the texts "nan", "inf" and "-inf"."""
    typer.echo(json.dumps(_strict(content), indent=2, allow_nan=False, default=str))


def _console() -> Console:
    console = Console(highlight=False, markup=False, emoji=False)
    if console.is_terminal:
        return console
    return Console(highlight=False, markup=False, emoji=False, width=WIDTH, soft_wrap=False)


def _cell(value: Any) -> str:
    match value:
        case None:
            return ""
        case list() | dict():
            return json.dumps(value)
        case _:
            return str(value)


def _strict(content: Any) -> Any:
    match content:
        case float():
            return content if math.isfinite(content) else str(content)
        case Mapping():
            return {key: _strict(value) for key, value in content.items()}
        case list() | tuple():
            return [_strict(value) for value in content]
        case _:
            return content
