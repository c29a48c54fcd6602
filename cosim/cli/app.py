"""The command line: a thin shell over :mod:`cosim.scenario` and :mod:`cosim.report`.

Data goes to stdout, messages to stderr.
Exit codes: 0 fine, 1 a check or the run failed, 2 wrong use; 130, 143, 129 interrupted by Ctrl-C,
a request to terminate, a closed terminal; 141 whoever reads stdout closed it.
Imports of a command are in its function: ``cosim --help`` imports neither numpy nor fmpy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Annotated, Final, NoReturn

import typer

from cosim.cli.command import OnceCommand, start_collecting
from cosim.errors import CosimError, shell_language
from cosim.lazy import LazyMapping
from cosim.report.printable import printable
from cosim.terminal import ended_by_signals, keep_stdout, open_standard_streams, outlive_terminal
from cosim.unanswered import ended_if_unanswered
from cosim.version import __version__

# file and name in the order of the help; a name that Python has itself ends with an underscore
_HOMES: Final = (
    "runs.run runs.replay logs.diff logs.hash_ studies.study logs.metrics runs.compare "
    "studies.tune analysis.identify analysis.design analysis.info fmus.check "
    "fmus.cache logs.plot logs.play logs.cat logs.convert logs.cut logs.merge logs.recover "
    "analysis.list_ analysis.show fmus.compile_ fmus.export fmus.linearize"
)
COMMANDS: Final = LazyMapping[Callable[..., None] | typer.Typer](
    "cosim.cli", {home.partition(".")[2].rstrip("_"): home for home in _HOMES.split()}
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cosim {__version__}")
        raise typer.Exit


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


def _command_line(names: Iterable[str]) -> typer.Typer:
    """Return the command line with some of its commands."""
    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(cosim)
    for name in names:
        command = COMMANDS[name]
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name=name, cls=OnceCommand)(command)
    return app


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; every deliberate error becomes one message and an exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    # The help, completion and the message for a wrong name need all of them.
    names = given[:1] if given and given[0] in COMMANDS else list(COMMANDS)
    open_standard_streams()
    outlive_terminal()
    stdout = keep_stdout()
    try:
        with ended_if_unanswered(), shell_language(), ended_by_signals():
            try:
                _command_line(names)(args=arguments, prog_name="cosim")
            finally:
                sys.stdout.flush()  # a reader that is gone is found here, or when Python ends
    except CosimError as error:
        notes = getattr(error, "__notes__", ())
        _exit(error.exit_code, str(error) or type(error).__name__, *notes, *_lost_folder())
    except OSError as error:  # stdout on a full disk, a folder that is gone
        if stdout is not None:  # the rest of its buffer cannot be written either
            with suppress(OSError):
                stdout.close()
        found = f"{error.filename or 'output'}: {error.strerror or error}"
        _exit(2, *(_lost_folder() or [found]))  # 1 says that a check or the run failed


def _exit(code: int, *texts: str) -> NoReturn:
    for text in texts:
        for line in printable(text).splitlines():
            sys.stderr.write(f"cosim: {line}\n")
    sys.exit(code)


def _lost_folder() -> list[str]:
    """Return what to say where relative paths lead nowhere, as their folder was removed."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return ["the working folder is gone: it was removed; change to another one"]
    return []
