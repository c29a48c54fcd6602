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
from typing import Annotated

import typer

from cosim.cli.collecting import start_collecting
from cosim.cli.once import OnceCommand
from cosim.errors import CosimError, shell_language
from cosim.lazy import LazyMapping
from cosim.report.printable import printable
from cosim.terminal import ended_by_signals, keep_stdout, open_standard_streams, outlive_terminal
from cosim.unanswered import ended_if_unanswered
from cosim.version import __version__

COMMANDS = LazyMapping[Callable[..., None] | typer.Typer](
    "cosim.cli",
    {  # in the order of the help
        "run": "running.run",
        "replay": "replaying.replay",
        "diff": "comparing.diff",
        "hash": "hashing.hash_",
        "study": "studying.study",
        "metrics": "measuring.metrics",
        "compare": "comparing.compare",
        "tune": "tuning.tune",
        "identify": "identifying.identify",
        "design": "designing.design",
        "info": "contents.info",
        "check": "checking.check",
        "cache": "fmus.cache",
        "plot": "contents.plot",
        "play": "playing.play",
        "cat": "converting.cat",
        "convert": "converting.convert",
        "cut": "editing.cut",
        "merge": "editing.merge",
        "recover": "editing.recover",
        "list": "contents.list_",
        "show": "contents.show",
        "compile": "fmus.compile_",
        "export": "fmus.export",
        "linearize": "fmus.linearize",
    },
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
        lines = printable(str(error)).splitlines() or [type(error).__name__]
        for note in getattr(error, "__notes__", ()):
            lines.append(printable(note))
        lines += _lost_folder()
        sys.stderr.write("\n".join(f"cosim: {line}" for line in lines) + "\n")
        sys.exit(error.exit_code)
    except OSError as error:  # stdout on a full disk, a folder that is gone
        place = printable(str(error.filename or "output"))
        lines = _lost_folder() or [f"{place}: {error.strerror or error}"]
        sys.stderr.write("\n".join(f"cosim: {line}" for line in lines) + "\n")
        if stdout is not None:  # the rest of its buffer cannot be written either
            with suppress(OSError):
                stdout.close()
        sys.exit(2)  # 1 says that a check or the run failed


def _lost_folder() -> list[str]:
    """Return what to say where relative paths lead nowhere, as their folder was removed."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return ["the working folder is gone: it was removed; change to another one"]
    return []
