"""Tables and JSON on stdout."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from textwrap import TextWrapper
from typing import Any, Final

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cosim.processes import COMMAND_VARIABLE
from cosim.report.printable import printable, printable_line

_WIDTH: Final = 80  # columns of a terminal that does not say
_GAP: Final = 2  # blanks between columns
_FOLDED: Final = 40  # characters of a word in the last column, such as a path, that may be broken


def new_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]] = ()) -> Table:
    """Return a table without lines, with some rows."""
    table = Table(title=title, header_style="", box=None, padding=(0, _GAP, 0, 0))
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*row)
    return table


def print_table(table: Table) -> None:
    """Print a table.

    In a terminal its columns are aligned; texts wrap between words. Where the words of a row do not
    fit side by side, its cells stand below each other; columns without any text are omitted. In a
    file or a pipe every row is one line, with a tab between its cells.
    """
    width = terminal_width()
    title = "" if table.title is None else str(table.title)
    rows = _rows_of(table)
    if width is None:
        _print_lines(title, rows)
        return
    rows = _without_empty_columns(rows)
    console = Console(highlight=False, markup=False, emoji=False, width=width)
    if title:
        console.print(printable(title), style="bold", soft_wrap=True)
    widths = _column_widths(rows, width)
    if widths is None:
        _print_records(rows, width)
    else:
        console.print(_aligned(table, rows, widths))


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
    return os.get_terminal_size(sys.stdout.fileno()).columns or _WIDTH


def print_line(text: str, *, error: bool = False) -> None:
    """Print a text that may come from a log or an FMU to stdout, or to stderr."""
    typer.echo(printable(text), err=error)


def _rows_of(table: Table) -> list[list[str]]:
    """Return the header and the rows of a table as texts that a terminal may show."""
    columns = []
    for column in table.columns:
        cells = [str(cell) for cell in (column.header, *column.cells)]
        columns.append([printable(cell) for cell in cells])
    return [list(row) for row in zip(*columns, strict=True)]


def _without_empty_columns(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return rows without the columns in which no row below the header has a text."""
    columns = list(zip(*rows, strict=True))
    kept = [cells for cells in columns if any(cells[1:])]
    return [list(row) for row in zip(*kept, strict=True)] if kept else [[*row] for row in rows]


def _aligned(table: Table, rows: Sequence[Sequence[str]], widths: Sequence[int]) -> Table:
    """Return a table of the rows whose columns have the widths given."""
    aligned = Table(
        header_style="",
        box=None,
        padding=(0, _GAP, 0, 0),
        pad_edge=False,
        show_header=any(rows[0]),
    )
    for title, width in zip(rows[0], widths, strict=True):
        aligned.add_column(Text(title), width=width, overflow="fold")
    for row, original in zip(rows[1:], table.rows, strict=True):
        aligned.add_row(*map(Text, row), end_section=original.end_section)
    return aligned


def _column_widths(rows: Sequence[Sequence[str]], width: int) -> list[int] | None:
    """Return the widths of columns that break no word; None: they do not fit into ``width``."""
    columns = list(zip(*rows, strict=True))
    widths = [max(map(_longest_line, cells)) for cells in columns]
    least = [max(map(_longest_word, cells)) for cells in columns]
    least[-1] = min(least[-1], _FOLDED)
    room = width - _GAP * (len(columns) - 1)
    if sum(least) > room:
        return None
    for _ in range(sum(widths) - room):
        _, widest = max((widths[i], i) for i in range(len(columns)) if widths[i] > least[i])
        widths[widest] -= 1
    return widths


def _longest_line(text: str) -> int:
    return max(map(cell_len, text.split("\n")))


def _longest_word(text: str) -> int:
    return max(map(cell_len, text.split()), default=0)


def _print_lines(title: str, rows: Sequence[Sequence[str]]) -> None:
    """Print every row as a line; a header that says nothing is left out."""
    if title:
        typer.echo(printable_line(title))
    for i, row in enumerate(rows):
        if i or any(row):
            typer.echo("\t".join(map(printable_line, row)).rstrip("\t"))


def _print_records(rows: Sequence[Sequence[str]], width: int) -> None:
    """Print the cells of every row below each other, wrapped between words."""
    wrapper = TextWrapper(
        width,
        initial_indent="  ",
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    header = rows[0]
    for first, *others in rows[1:]:
        cells = zip(header[1:], others, strict=True)
        labelled = [f"{name}: {cell}" if name else cell for name, cell in cells if cell]
        typer.echo(first)
        for text in labelled:
            typer.echo(wrapper.fill(text))


def print_section(title: str, content: Any) -> None:
    """Print rows, a list of mappings with the same keys, or one mapping; nothing if it is empty."""
    print_sections([(title, content)])


def print_sections(sections: Iterable[tuple[str, Any]]) -> None:
    """Print several sections, each a title and its content, as :func:`print_section` does."""
    print_tables([_section_table(title, content) for title, content in sections if content])


def _section_table(title: str, content: Any) -> Table:
    if isinstance(content, Mapping):
        table = new_table(title, ("", ""))
        for key, value in content.items():
            if value is not None:
                table.add_row(key, _cell(value))
        return table
    columns = list(content[0])
    table = new_table(title, columns)
    for row in content:
        cells = [_cell(row.get(column)) for column in columns]
        table.add_row(*cells)
    return table


def print_json(content: Any) -> None:
    """Print JSON; numbers that it has no word for are the texts "nan", "inf" and "-inf"."""
    typer.echo(json.dumps(_strict(content), indent=2, allow_nan=False, default=str))


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
