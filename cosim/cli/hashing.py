"""The command hash: whether the rows of a log are those that its run recorded."""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.cli.options import JsonOption, LogArgument, print_notice


def hash_(
    log: LogArgument,
    signals: Annotated[
        bool,
        typer.Option("--signals", help="Also print a hash of times and values for each signal."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print the content hash of a log.

    It covers the declaration of every signal (name, unit, role, ...), its times and values;
    compression and chunking do not change it. Exit 1 if the log records another hash.
    """
    from cosim.log import open_log
    from cosim.report.tables.console import print_json, print_line

    opened = open_log(log)
    lines = opened.signal_hashes() if signals else {}
    found = opened.content_hash()
    recorded = opened.metadata.get("cosim.result", {}).get("content_hash")
    if as_json:
        content = {"content_hash": found, "recorded": recorded, "equal": found == recorded}
        print_json({**content, "signals": lines} if signals else content)
    else:
        print_line(f"{found}  {opened.path}")
        for name, digest in lines.items():
            print_line(f"{digest}  {name}")
    if recorded is None:
        print_notice(f"{opened.path}: no content hash was recorded")
    elif found != recorded:
        print_notice(
            f"{opened.path}: the content hash differs from the recorded {recorded}: its signals "
            "were changed after recording"
        )
        raise typer.Exit(1)
