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
    """Copy a time span of a log to a new log.

    The new log is marked as partial; 'cosim merge' joins such parts.
    """
    from cosim.log.editing.cutting import cut as cut_log

    if start is None and stop is None:
        raise UsageError("expected --from, --to or both")
    _print_log(cut_log(log, start, stop, out, names=("--from", "--to"), force=force))


def merge(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs of consecutive parts of one run, in any order"),
    ],
    out: NewLogOption,
    force: ForceOption = False,
) -> None:
    """Join logs of consecutive parts of one run.

    Logs of other runs, overlaps and gaps are refused.
    """
    from cosim.log.editing.merging import merge as merge_logs

    _print_log(merge_logs(logs, out, force=force))


def recover(
    log: Annotated[Path, typer.Argument(metavar="BROKEN", help="A damaged or truncated log.")],
    out: NewLogOption,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Copy the intact parts of a damaged log to a new log.

    Keeps every chunk whose CRC matches, also after the damage, and shows which rows are lost.
    """
    from cosim.log.editing.recovering import recover as recover_log
    from cosim.report.tables.logs import print_recovery

    print_recovery(recover_log(log, out, force=force), as_json=as_json)


def _print_log(log: Log) -> None:
    """Print where a log is, and how far it goes."""
    reason = f", {log.reason}" if log.reason else ""
    typer.echo(printable(f"{log.path}: {log.status}{reason}"))
