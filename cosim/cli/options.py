"""Arguments and options that several commands have, and how their values are read."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim import completion
from cosim.errors import RunError, UsageError, name_option, option, quoted
from cosim.files import file_type
from cosim.report.printable import printable
from cosim.unanswered import limit_calls

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A shipped scenario by name, or a path to a .toml file.",
        autocompletion=completion.complete_scenario,
    ),
]

LogArgument = Annotated[
    Path, typer.Argument(metavar="LOG", help="A log written by 'cosim run' (.mcap).")
]

PAIRS = {"set": "COMPONENT.PARAMETER=VALUE", "swap": "COMPONENT=PATH", "map": "PORT=NAME"}

SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar=PAIRS["set"],
        autocompletion=completion.complete_setting,
        help="Set a value, such as observer.filter_rate=500 or, in a list, "
        "delta.terms[0].theta=-0.2. Repeatable.",
    ),
]

SwapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--swap",
        metavar=PAIRS["swap"],
        autocompletion=completion.complete_swap,
        help="Replace a component by an FMU (x.fmu, x.fmu#me, x.fmu#cs), a recorded "
        "component (.mcap) or time-stamped samples (.csv, .xlsx, ..., .mcap of other "
        "tools). Repeatable.",
    ),
]

MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar=PAIRS["map"],
        autocompletion=completion.complete_map,
        help="Map ports to those of the replacing component: observer.y=out1, "
        "plant.x=[s1,s2]. Repeatable.",
    ),
]

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]

QuietOption = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", help="Print errors only, and what times and units are taken for."
    ),
]

ForceOption = Annotated[bool, typer.Option("--force", help="Replace an existing log.")]

OutOption = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="PATH", help="Log to write (.mcap).")
]

StopOption = Annotated[
    float | None, typer.Option(help="End of the run [s]; the same as --set scenario.stop=...")
]

PlotOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Plot estimates with truth and errors, or outputs, to a file (.png, .svg, .pdf).",
    ),
]


@contextmanager
def prints_to_stderr() -> Iterator[None]:
    """Redirect what the code of users prints to stderr: stdout is for data."""
    with redirect_stdout(sys.stderr):
        yield


def run_in_child(
    command: Sequence[str], options: Mapping[str, Sequence[str] | None], *, as_json: bool
) -> None:
    """Do this command in a child process, as it runs the code of FMUs, and exit as that does.

    In the child itself return, to do it; there it ends where a call of an FMU hangs, after as long
    as a trial of an FMU may take.

    Raises
    ------
    RunError
        If the child crashes, or code that it runs ends it.
    """
    from cosim.fmi import child_process
    from cosim.processes import (
        COMMAND_VARIABLE,
        call_limit,
        end_with_parent,
        note_own_end,
        run_command,
    )
    from cosim.report.tables.console import terminal_width

    if COMMAND_VARIABLE in os.environ:
        end_with_parent()
        note_own_end()
        limit_calls(call_limit())
        return
    arguments = [*command]
    for name, values in options.items():
        for value in values or ():
            arguments += [name, value]
    if as_json:
        arguments.append("--json")
    result = run_command(arguments, columns=terminal_width(), limit=child_process.TIMEOUT)
    typer.echo(result.messages, nl=False, err=True)
    if result.failure:
        raise RunError(f"the process that loaded FMUs and classes {result.failure}")
    typer.echo(result.output, nl=False)
    raise typer.Exit(result.exit_code)


def given_values(values: Mapping[str, float | str | None]) -> dict[str, float | str]:
    """Return the values of the options that were given."""
    return {key: value for key, value in values.items() if value is not None}


def read_pairs(texts: list[str] | None, name: str) -> dict[str, str]:
    """Read the pairs KEY=VALUE of an option."""
    pairs = {}
    for text in texts or []:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            missing = "no name" if equals else "no '='"
            expected = PAIRS.get(name, "NAME=VALUE")
            raise UsageError(f"{option(name)} {quoted(text)}: expected {expected}, got {missing}")
        pairs[key.strip()] = value.strip()
    return pairs


def read_unique_pairs(texts: list[str] | None, name: str) -> dict[str, str]:
    """Read pairs of which each key may be given once."""
    pairs = read_pairs(texts, name)
    keys = [text.partition("=")[0].strip() for text in texts or []]
    for key in keys:
        count = keys.count(key)
        if count > 1:
            remedy = "; 'cosim compare' runs several plants" if name == "swap" else ""
            raise UsageError(f"{option(name, key)}: expected once, given {count} times{remedy}")
    return pairs


def read_numbers(texts: list[str] | None, name: str) -> dict[str, float] | None:
    """Read pairs of a signal and a number, each signal once; None: there are none."""
    if not texts:
        return None
    numbers = {}
    for signal, text in read_unique_pairs(texts, name).items():
        try:
            numbers[signal] = float(text)
        except ValueError as error:
            raise UsageError(
                f"{option(name, signal)}: expected a number, got {quoted(text)}"
            ) from error
    return numbers


def read_edits(
    texts: list[str] | None, options: Mapping[str, float | str | None] | None = None
) -> dict[str, Any]:
    """Read the pairs of --set, whose values are TOML where they can be, and add those of options.

    ``options`` are the values of --stop and --step, by the keys that they set.
    """
    from cosim.scenario.document.document import parse_value

    edits = {}
    for key, text in read_pairs(texts, "set").items():
        try:
            edits[key] = parse_value(text)
        except UsageError as error:
            raise UsageError(f"{option('set', key)}: {error}") from error
    for key, value in given_values(options or {}).items():
        name = f"--{key.removeprefix('scenario.').replace('verdicts', 'no-verdicts')}"
        if key in edits:
            raise UsageError(f"{name} and --set {key} set the same; omit one of them")
        name_option(key, name)
        edits[key] = value
    return edits


def check_plot(plot: Path | None, out: Path | None) -> None:
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


def check_out(place: str | None) -> None:
    """Check that a dataset is there when the command has ended.

    Raises
    ------
    UsageError
        If it is not.
    """
    if place is not None and place.startswith("memory://"):
        raise UsageError(
            f"{option('out')}: expected a folder, or a URL such as s3://bucket/x; {quoted(place)} "
            "is lost when this command ends"
        )


def print_notice(text: str) -> None:
    """Print a message, to stderr."""
    typer.echo(printable(text), err=True)
