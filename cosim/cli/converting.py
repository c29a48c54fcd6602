"""The commands cat and convert: the signals of a log for other tools."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options import LogArgument
from cosim.report.printable import printable
from cosim.terminal import ended_by_interrupt

SignalsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--signals",
        metavar="NAMES",
        help="Signals, elements or patterns: 'plant.*,observer.x_a[0]'. All by default. "
        "Repeatable.",
    ),
]

FromOption = Annotated[float | None, typer.Option("--from", metavar="T", help="First time [s].")]

ToOption = Annotated[float | None, typer.Option("--to", metavar="T", help="Last time [s].")]


def cat(
    log: LogArgument,
    signals: SignalsOption = None,
    start: FromOption = None,
    stop: ToOption = None,
    text_format: Annotated[
        str, typer.Option("--format", metavar="csv|jsonl", help="CSV or JSON Lines.")
    ] = "csv",
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Keep printing rows as a run flushes them to the log (polled every 0.2 s), "
            "until the run ends. The log must exist.",
        ),
    ] = False,
) -> None:
    """Print the rows of a log as CSV or JSON Lines.

    Components with several rates share one table: a row for every sampling instant, with empty
    cells (JSON Lines: omitted keys) for components without a sample there.
    """
    from cosim.log.conversion.text import TextSource, table_text

    table: TextSource
    if follow:
        from cosim.log.conversion.following import FollowedLog

        table = FollowedLog(log, signals, start, stop)
    else:
        from cosim.log.conversion.choice import choose

        table = choose(log, signals, start, stop)
    lines = table_text(table, text_format)
    is_terminal = sys.stdout.isatty()
    with ended_by_interrupt(quietly=follow):
        for text in lines:
            shown = printable(text) if is_terminal else text
            sys.stdout.buffer.write(shown.encode())
            if follow:
                sys.stdout.buffer.flush()


def convert(
    log: LogArgument,
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="File to write: .csv, .parquet, .mat or .npz.")
    ],
    signals: SignalsOption = None,
    start: FromOption = None,
    stop: ToOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Convert a log to CSV, Parquet, MAT or NumPy's npz.

    CSV and Parquet contain the rows of 'cosim cat'; .mat and .npz contain one array per signal and
    one array of times per component.
    """
    from cosim.log.conversion.choice import choose
    from cosim.log.conversion.files import convert as convert_log
    from cosim.log.conversion.files import free_target

    free_target(out, force=force)  # before the log is read
    convert_log(choose(log, signals, start, stop), out, force=force)
    typer.echo(printable(str(out)))
