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
    """Return a table without lines, of the rows given."""
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
    file or a pipe every row is one line, with a tab between its cells; a header that says nothing
    is left out.
    """
    width = terminal_width()
    title = printable(str(table.title or ""))
    columns = []
    for column in table.columns:
        columns.append([printable(str(cell)) for cell in (column.header, *column.cells)])
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
    widths = _column_widths(columns, width)
    if widths is None:
        _print_records(columns, width)
        return
    aligned = Table(header_style="", box=None, padding=(0, _GAP, 0, 0), pad_edge=False)
    aligned.show_header = any(cells[0] for cells in columns)
    for cells, column_width in zip(columns, widths, strict=True):
        aligned.add_column(Text(cells[0]), width=column_width, overflow="fold")
    for i, original in enumerate(table.rows, start=1):
        row = [Text(cells[i]) for cells in columns]
        aligned.add_row(*row, end_section=original.end_section)
    console.print(aligned)


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


def _column_widths(columns: Sequence[Sequence[str]], width: int) -> list[int] | None:
    """Return the widths of columns that break no word; None: they do not fit into ``width``."""
    widths = []
    least = []
    for cells in columns:
        lines = "\n".join(cells).split("\n")
        widths.append(max(map(cell_len, lines)))
        least.append(max((cell_len(word) for line in lines for word in line.split()), default=0))
    least[-1] = min(least[-1], _FOLDED)
    room = width - _GAP * (len(columns) - 1)
    if sum(least) > room:
        return None
    for _ in range(sum(widths) - room):
        _, widest = max((widths[i], i) for i in range(len(columns)) if widths[i] > least[i])
        widths[widest] -= 1
    return widths


def _print_records(columns: Sequence[Sequence[str]], width: int) -> None:
    """Print the cells of every row below each other, wrapped between words."""
    wrapper = TextWrapper(
        width,
        initial_indent="  ",
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    header, *rows = zip(*columns, strict=True)
    for row in rows:
        typer.echo(row[0])
        for name, cell in zip(header[1:], row[1:], strict=True):
            if cell:
                typer.echo(wrapper.fill(f"{name}: {cell}" if name else cell))


def print_section(title: str, content: Any) -> None:
    """Print rows, a list of mappings with the same keys, or one mapping; nothing if it is empty."""
    print_sections([(title, content)])


def print_sections(sections: Iterable[tuple[str, Any]]) -> None:
    """Print several sections, each a title and its content, as :func:`print_section` does."""
    print_tables([_section_table(title, content) for title, content in sections if content])


def _section_table(title: str, content: Any) -> Table:
    if isinstance(content, Mapping):
        rows = [[key, _cell(value)] for key, value in content.items() if value is not None]
        return new_table(title, ("", ""), rows)
    columns = list(content[0])
    rows = [[_cell(row.get(column)) for column in columns] for row in content]
    return new_table(title, columns, rows)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return json.dumps(value) if isinstance(value, list | dict) else str(value)


def print_json(content: Any) -> None:
    """Print JSON; numbers that it has no word for are the texts "nan", "inf" and "-inf"."""
    typer.echo(json.dumps(_strict(content), indent=2, allow_nan=False, default=str))


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
