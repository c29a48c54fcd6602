"""The command line: a thin shell over :mod:`cosim.scenario` and :mod:`cosim.report`.

Data goes to stdout, messages to stderr.
Exit codes: 0 fine, 1 a check or the run failed, 2 wrong use; 130, 143, 129 interrupted by Ctrl-C,
a request to terminate, a closed terminal.
Imports of a command are in its function: ``cosim --help`` imports neither numpy nor fmpy.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Annotated

import typer

from cosim.cli.checking import check
from cosim.cli.collecting import start_collecting
from cosim.cli.comparing import compare, diff
from cosim.cli.contents import info, list_, plot, show
from cosim.cli.designing import design
from cosim.cli.fmus import cache, export, linearize
from cosim.cli.identifying import identify
from cosim.cli.running import replay, run
from cosim.errors import CosimError, shell_language
from cosim.report.printable import printable
from cosim.terminal import (
    ended_by_signals,
    keep_stdout,
    open_standard_streams,
    outlive_terminal,
)
from cosim.unanswered import ended_if_unanswered
from cosim.version import __version__

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cosim {__version__}")
        raise typer.Exit


@app.callback()
def cosim(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Co-simulation of descriptor plants, FMUs, observers and disturbance identifiers.

    Logs replay bit for bit.
    """
    if context.invoked_subcommand not in ("run", "replay"):  # these start it themselves
        start_collecting()


# In the order of the help.
app.command()(run)
app.command()(replay)
app.command()(diff)
app.command()(compare)
app.command()(identify)
app.command()(design)
app.command()(info)
app.command()(check)
app.command()(cache)
app.command()(plot)
app.command(name="list")(list_)
app.command()(show)
app.command()(export)
app.command()(linearize)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; every deliberate error becomes one message and an exit code."""
    open_standard_streams()
    outlive_terminal()
    stdout = keep_stdout()
    try:
        with ended_if_unanswered(), shell_language(), ended_by_signals():
            app(args=arguments, prog_name="cosim")
    except CosimError as error:
        lines = printable(str(error)).splitlines() or [type(error).__name__]
        for note in getattr(error, "__notes__", ()):
            lines.append(printable(note))
        sys.stderr.write("\n".join(f"cosim: {line}" for line in lines) + "\n")
        sys.exit(error.exit_code)
    except OSError as error:  # stdout on a full disk, a folder that is gone
        place = printable(str(error.filename or "output"))
        sys.stderr.write(f"cosim: {place}: {error.strerror or error}\n")
        if stdout is not None:  # the rest of its buffer cannot be written either
            with suppress(OSError):
                stdout.close()
        sys.exit(1)
