"""The commands cut, merge and recover: they write logs from logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.converting import FromOption, ToOption
from cosim.cli.options import ForceOption, JsonOption, LogArgument
from cosim.errors import UsageError
from cosim.report.printable import printable

if TYPE_CHECKING:
    from cosim.log import Log

NewLogOption = Annotated[
    Path, typer.Option("--out", "-o", metavar="PATH", help="Log to write (.mcap).")
]


def cut(
    log: LogArgument,
    out: NewLogOption,
    start: FromOption = None,
    stop: ToOption = None,
    force: ForceOption = False,
) -> None:
    """Write a span of time of a log to a new log.

    That opens like any other and says that it is partial; 'cosim merge' joins such parts again.
    """
    from cosim.log.editing.cutting import cut as cut_log

    if start is None and stop is None:
        raise UsageError("found neither --from nor --to; needed what to cut")
    _print_log(cut_log(log, start, stop, out, names=("--from", "--to"), force=force))


def merge(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs of consecutive spans of one run, in any order"),
    ],
    out: NewLogOption,
    force: ForceOption = False,
) -> None:
    """Join logs of consecutive spans of one run.

    Logs of other runs, overlapping logs and logs with rows missing between them are refused.
    """
    from cosim.log.editing.merging import merge as merge_logs

    _print_log(merge_logs(logs, out, force=force))


def recover(
    log: Annotated[Path, typer.Argument(metavar="BROKEN", help="A damaged or truncated log.")],
    out: NewLogOption,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write what is intact in a damaged log to a new log.

    That is every chunk whose CRC matches, also after the damage. Shows which rows are lost.
    """
    from cosim.log.editing.recovering import recover as recover_log
    from cosim.report.tables.recovery import print_recovery

    print_recovery(recover_log(log, out, force=force), as_json=as_json)


def _print_log(log: Log) -> None:
    """Print where a log is, and how far it goes."""
    reason = f", {log.reason}" if log.reason else ""
    typer.echo(printable(f"{log.path}: {log.status}{reason}"))
