"""Tables and JSON on stdout."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from textwrap import TextWrapper
from typing import Any, Final, TypeAlias

import typer
from rich.console import Console
from rich.measure import measure_renderables
from rich.table import Table

from cosim.processes import COMMAND_VARIABLE
from cosim.report.printable import print_text, printable, printable_line

_WIDTH: Final = 80  # columns of a terminal that does not say
_GAP: Final = 2  # blanks between columns
_FOLDED: Final = 40  # characters of a word in the last column, such as a path, that may be broken
_NO_NUMBERS: Final = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}  # in JSON
Section: TypeAlias = dict[str, Any]  # what is said of something, as JSON has it
Shown: TypeAlias = Iterator[Any]  # first what JSON has; then lines, tables and lists of tables


def print_shown(shown: Shown, *, as_json: bool) -> None:
    """Print what JSON has, or the lines and tables behind it.

    Between the tables of a list there is a blank line in a terminal.
    """
    content = next(shown)
    if as_json:
        print_json(content)
        return
    for one in shown:
        if isinstance(one, str):
            print_text(one)
        else:
            print_tables(one if isinstance(one, list) else [one])


def new_table(title: str, columns: Sequence[str], rows: Iterable[Iterable[str]] = ()) -> Table:
    """Return a table of the rows given."""
    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*row)
    return table


def print_table(table: Table) -> None:
    """Print a table.

    In a terminal its columns are aligned; texts wrap between words. Where the words of a row do not
    fit side by side, its cells stand below each other; columns without any text are omitted. In a
    file or a pipe every row is one line, with a tab between its cells; a header that says nothing
    is left out.
    """
    title = printable(str(table.title or ""))
    columns = []
    for column in table.columns:
        columns.append([printable(str(cell)) for cell in (column.header, *column.cells)])
    width = terminal_width()
    if width is None:
        lines = [(title,), *zip(*columns, strict=True)]
        for i, line in enumerate(lines):
            if i > 1 or any(line):
                typer.echo("\t".join(map(printable_line, line)).rstrip("\t"))
        return
    console = Console(highlight=False, markup=False, emoji=False, width=width)
    if title:
        console.print(title, style="bold", soft_wrap=True)
    columns = [cells for cells in columns if any(cells[1:])] or columns
    header, *rows = zip(*columns, strict=True)
    widths = _column_widths(columns, console)
    if not widths:
        _print_records(header, rows, width)
        return
    aligned = Table(header_style="", box=None, padding=(0, _GAP, 0, 0), pad_edge=False)
    aligned.show_header = any(header)
    for name, column_width in zip(header, widths, strict=True):
        aligned.add_column(name, width=column_width, overflow="fold")
    for row in rows:
        aligned.add_row(*row)
    console.print(aligned)


def _print_records(header: Sequence[str], rows: Iterable[Sequence[str]], width: int) -> None:
    """Print the cells of every row below each other, wrapped between words."""
    wrapper = TextWrapper(width, break_long_words=False, break_on_hyphens=False)
    wrapper.initial_indent = "  "
    wrapper.subsequent_indent = "    "
    for row in rows:
        typer.echo(row[0])
        for name, cell in zip(header[1:], row[1:], strict=True):
            if cell:
                text = f"{name}: {cell}" if name else cell
                typer.echo(wrapper.fill(text))


def print_tables(tables: Iterable[Table]) -> None:
    """Print tables one below the other, in a terminal with a blank line between them."""
    for i, table in enumerate(tables):
        if i and terminal_width() is not None:
            typer.echo()
        print_table(table)


def terminal_width() -> int | None:
    """Return the number of columns of the terminal; None: stdout is a file or a pipe."""
    of_parent = os.environ.get(COMMAND_VARIABLE)
    if of_parent is not None:
        return int(of_parent) or None
    if not sys.stdout.isatty():
        return None
    chosen = os.environ.get("COLUMNS", "")
    if chosen.isdecimal() and int(chosen):
        return int(chosen)
    # of what stands for stdout, which need not be the first one of the process
    return os.get_terminal_size(sys.stdout.fileno()).columns or _WIDTH


def _column_widths(columns: Sequence[Sequence[str]], console: Console) -> list[int]:
    """Return the widths of columns that break no word; none: they do not fit side by side."""
    sizes = [measure_renderables(console, console.options, cells) for cells in columns]
    widths = [size.maximum for size in sizes]
    least = [size.minimum for size in sizes]
    least[-1] = min(least[-1], _FOLDED)
    room = console.width - _GAP * (len(columns) - 1)
    if sum(least) > room:
        return []
    while sum(widths) > room:
        _, widest = max((widths[i], i) for i in range(len(columns)) if widths[i] > least[i])
        widths[widest] -= 1
    return widths


def section_tables(sections: Iterable[tuple[str, Any]]) -> list[Table]:
    """Return a table for each title with rows: mappings with the same keys, or one mapping."""
    tables = []
    for title, content in sections:
        if not content:
            continue
        columns = ["", ""]
        if isinstance(content, Mapping):
            rows = [[key, value] for key, value in content.items() if value is not None]
        else:
            columns = list(content[0])
            rows = [[row.get(column) for column in columns] for row in content]
        tables.append(new_table(title, columns, [map(_cell, row) for row in rows]))
    return tables


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return json.dumps(value) if isinstance(value, list | dict) else str(value)


def print_json(content: Any) -> None:
    """Print JSON; numbers that it has no word for are the texts "nan", "inf" and "-inf"."""
    text = json.dumps(content, default=_plain)
    typer.echo(json.dumps(json.loads(text, parse_constant=_NO_NUMBERS.get), indent=2))


def _plain(value: object) -> object:
    return dict(value) if isinstance(value, Mapping) else str(value)
