"""Options that several commands have, and what commands do for them."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO

import typer

from cosim.cli.command import Given, OptionTable
from cosim.errors import RunError, UsageError, option
from cosim.files import file_type
from cosim.report.printable import print_notice
from cosim.unanswered import limit_calls

if TYPE_CHECKING:
    from cosim.live import LiveServer
    from cosim.studies.measuring import Assertions

SHARED: Final[Mapping[str, OptionTable]] = {
    "scenario": {
        "scenario SCENARIO : scenario": "A shipped scenario by name, or a path to a .toml file."
    },
    "log": {"log LOG : Path": "A log written by 'cosim run' (.mcap)."},
    "recording": {
        "log LOG : Path": "A log, a table with times (.csv, .parquet, .xlsx, .mat, ...) or an MCAP "
        "of another tool.",
    },
    "out": {"--out -o PATH : Path": "Log to write (.mcap)."},
    "new-log": {"--out -o PATH : Path = ...": "Log to write (.mcap)."},
    "force": {"--force": "Replace an existing log."},
    "force-file": {"--force": "Replace an existing file."},
    "json": {"--json": "Print JSON instead of a table."},
    "quiet": {
        "--quiet -q": "Print errors only, and what times and units are taken for.",
    },
    "set": {
        "--set COMPONENT.PARAMETER=VALUE : edits": "Set a value, such as observer.filter_rate=500 "
        "or, in a list, delta.terms[0].theta=-0.2. Repeatable.",
    },
    "swap": {
        "--swap COMPONENT=PATH : swaps": "Replace a component by an FMU (x.fmu, x.fmu#me, "
        "x.fmu#cs), a recorded component (.mcap) or time-stamped samples (.csv, .xlsx, ..., .mcap "
        "of other tools). Repeatable.",
    },
    "map": {
        "--map PORT=NAME : maps": "Map ports to those of the replacing component: "
        "observer.y=out1, plant.x=[s1,s2]. Repeatable.",
    },
    "stop": {"--stop : float": "End of the run [s]; the same as --set scenario.stop=..."},
    "plot": {
        "--plot FILE : Path": "Plot estimates with truth and errors, or outputs, to a file (.png, "
        ".svg, .pdf).",
    },
    "picture": {"--out -o FILE : Path = ...": "Picture to write (.png, .svg, .pdf)."},
    "size": {"--size WIDTHxHEIGHT : size": "Size of the picture [cm], such as 16x9."},
    "title": {"--title TEXT : str": "Title of the picture."},
    "signals": {
        "--signals NAMES : list[str]": "Signals, elements or patterns: "
        "'plant.*,observer.x_a[0]'. All by default. Repeatable.",
    },
    "span": {"--from T : seconds": "First time [s].", "--to T : seconds": "Last time [s]."},
    "viewers": {
        "--host ADDRESS : str": "Address for viewers; default: 127.0.0.1, this machine only.",
        "--port NUMBER : int": "Port for viewers; default: 8765. 0: any free port.",
        "--allow-host NAME : list[str]": "Further host whose pages may connect as viewers, or "
        "further name of this machine. Repeatable; default: programs, pages of this machine, "
        "app.foxglove.dev.",
    },
    "failing": {
        "--fail-on WHAT,... : failures": "Exit 1 if an estimate is inconsistent with the data "
        "(inconsistent), has no value (no-estimate), or the run warns of something (warning). "
        "Repeatable.",
        "--assert CONDITION : list[str]": "Exit 1 unless this holds, such as 'rms(plant.y) < "
        "0.1': metrics as of 'cosim metrics', compared and joined by 'and'. Repeatable.",
    },
    "no-verdicts": {
        "--no-verdicts": "Do not judge estimates by a fit at the end; the same as --set "
        "scenario.verdicts=false.",
    },
    "dataset": {"place DIR : str": "The dataset of a study: a folder, or a URL."},
    "new": {"--new": "Delete the existing dataset and start again."},
    "workers": {"--workers : int": "Parallel processes. [default: one per processor]"},
}
# what fails a verdict of a study, by the words in it
BAD_VERDICTS: Final = {
    "inconsistent": ("INCONSISTENT", "no verdict"),
    "no-estimate": ("NO_ESTIMATE", "NOT_IDENTIFIABLE", "no verdict"),
}


def shared(names: str) -> dict[str, str]:
    """Return the table of some options that several commands have, in this order."""
    table: dict[str, str] = {}
    for name in names.split():
        table |= SHARED[name]
    return table


def prints_to_stderr() -> redirect_stdout[TextIO]:
    """Redirect what the code of users prints to stderr: stdout is for data."""
    return redirect_stdout(sys.stderr)


def run_in_child(arguments: Sequence[str]) -> None:
    """Run a command line in a child process, as it runs the code of FMUs, and exit as that does.

    In the child itself return, to do it; there it ends where a call of an FMU hangs, after as long
    as a trial of an FMU may take.

    Raises
    ------
    RunError
        If the child crashes, or code that it runs ends it.
    """
    from cosim import processes
    from cosim.fmi.child_process import TIMEOUT
    from cosim.report.tables.console import terminal_width

    if processes.COMMAND_VARIABLE in os.environ:
        processes.end_with_parent()
        processes.note_own_end()
        limit_calls(processes.call_limit())
        return
    result = processes.run_command(arguments, columns=terminal_width(), limit=TIMEOUT)
    typer.echo(result.messages, nl=False, err=True)
    if result.failure:
        raise RunError(f"the process that loaded FMUs and classes {result.failure}")
    typer.echo(result.output, nl=False)
    raise typer.Exit(result.exit_code)


def check_plot(plot: Path | None, out: Path | None = None) -> None:
    """Refuse a picture that could not be drawn, before the run whose logs go to ``out``."""
    if plot is None:
        return
    from cosim.report.plots.picture import need_plot

    need_plot(plot)
    if out is None:
        return
    picture = Path(os.path.realpath(plot))
    target = Path(os.path.realpath(out))
    if target == picture or (file_type(target) == "log" and target in picture.parents):
        raise UsageError(f"--plot {plot}: is the path of the log, --out {out}; choose another")


def live_server(
    given: Given, signals: Sequence[str] | None, notice: Callable[[str], None] | None = None
) -> LiveServer:
    """Return the server that shows a run to viewers."""
    from cosim.live import LiveServer

    address = given.only("host port allow_host")
    chosen = {name: value for name, value in address.items() if value is not None}
    return LiveServer(signals=signals or (), notice=notice, **chosen)


# --- what makes a command that ran fail ---


def check_verdicts(fail_on: Collection[str], made: bool, remedy: str) -> None:
    """Refuse to fail on verdicts where none are made."""
    asked = sorted(BAD_VERDICTS.keys() & fail_on)
    if asked and not made:
        raise UsageError(f"{option('fail-on', ','.join(asked))} needs {remedy}")


def read_assertions(
    texts: Iterable[str] | None, known: Mapping[str, str] | None = None
) -> Assertions | None:
    """Return what a run must fulfil; None: nothing.

    ``known``: metrics of a study by name, which may stand for their texts.

    Raises
    ------
    UsageError
        If a text is no assertion.
    """
    if not texts:
        return None
    from cosim.studies.measuring import Assertions

    return Assertions(texts, known or {})


def has_failed(lines: Iterable[str]) -> bool:
    """Print why a command fails, if it does."""
    reasons = list(lines)
    for line in reasons:
        print_notice(f"cosim: {line}")
    return bool(reasons)
