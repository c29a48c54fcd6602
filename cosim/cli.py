"""The command line: a thin shell over :mod:`cosim.scenario` and :mod:`cosim.log`.

Data goes to stdout, messages to stderr. Exit codes: 0 fine, 1 a check or the run failed, 2 wrong use, 130 interrupted.
What a command needs is imported when it runs: ``cosim --help`` needs neither numpy nor fmpy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from cosim.errors import CosimError, UsageError

if TYPE_CHECKING:
    from cosim.scenario.execution import Progress

BEGAN = perf_counter()

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Co-simulation of descriptor plants, FMUs, observers and disturbance identifiers, with logs that replay bit for bit.",
)

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A shipped scenario by name, or a path to a .toml file."
    ),
]
LogArgument = Annotated[
    Path, typer.Argument(metavar="LOG", help="A log that 'cosim run' wrote (.mcap).")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="COMPONENT.PARAMETER=VALUE",
        help="Set a value, such as observer.filter_rate=500. Repeatable.",
    ),
]
SwapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--swap",
        metavar="COMPONENT=PATH",
        help="Put an FMU (x.fmu, x.fmu#me, x.fmu#cs) or a recorded component (.mcap) in its place. Repeatable.",
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar="PORT=NAME",
        help="What a swapped component calls a port, such as observer.y=out1. Repeatable.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace a log that exists.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="PATH", help="Log to write (.mcap).")
]
StopOption = Annotated[
    float | None, typer.Option(help="End of the run [s]; the same as --set scenario.stop=...")
]
PlotOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Draw the estimates and their truth.")
]


@app.command()
def run(
    scenario: ScenarioArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="Log to write (.mcap); else logs/<scenario>.mcap, -2, -3, ...",
        ),
    ] = None,
    force: ForceOption = False,
    changes: SetOption = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    step: Annotated[
        float | None,
        typer.Option(help="Communication step [s]; the same as --set scenario.step=..."),
    ] = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    profile: Annotated[
        bool, typer.Option("--profile", help="Show where the time went, by component.")
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Check and compare the ports of swapped components; run nothing."
        ),
    ] = False,
) -> None:
    """Run a scenario and record every signal to an MCAP log."""
    from cosim.report import tables
    from cosim.scenario.execution import default_log, load
    from cosim.scenario.execution import run as run_scenario

    imported = perf_counter()
    edits = _edits(changes) | {
        f"scenario.{key}": value
        for key, value in (("stop", stop), ("step", step))
        if value is not None
    }
    loaded = load(scenario)
    edited = loaded.edit(swap=_once(swaps, "--swap"), map=_once(maps, "--map"), set=edits)
    if dry_run:
        tables.comparison(edited, as_json=as_json)
        return
    path = out or default_log(edited.name)
    _need_plot(plot, edited.file.truth)
    seconds: dict[str, float] | None = {} if profile else None
    with _progress(quiet or as_json) as progress:
        log = run_scenario(edited, out=path, force=force, progress=progress, profile=seconds)
    wall = {"imports": imported - BEGAN, "run and log": perf_counter() - imported}
    if plot is not None:
        from cosim.report.plots import plot_run

        plot_run(log, plot)
    tables.summary(log, path=path, wall=wall, profile=seconds, as_json=as_json, quiet=quiet)


@app.command()
def replay(
    log: LogArgument,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Compare every signal bit for bit with the log; exit 1 at a difference.",
        ),
    ] = False,
    out: OutOption = None,
    force: ForceOption = False,
    changes: SetOption = None,
    stop: StopOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run a log's scenario again on its recorded plant.

    Nothing is needed but the log.
    """
    from cosim.report import tables
    from cosim.log import open_log
    from cosim.report.plots import plot_run
    from cosim.report.summary import truth_of
    from cosim.scenario.execution import replay as replay_log

    imported = perf_counter()
    source = open_log(log)
    if verify and stop is not None:
        raise UsageError("--verify compares the whole log; leave out --stop")
    edits = _edits(changes) | ({} if stop is None else {"scenario.stop": stop})
    _need_plot(plot, truth_of(source))
    with _progress(quiet or as_json) as progress:
        again = replay_log(source, out=out, force=force, set=edits, progress=progress)
    if plot is not None:
        plot_run(again, plot)
    if verify:
        tables.verification(source, again, path=log, as_json=as_json, quiet=quiet)
    else:
        wall = {"imports": imported - BEGAN, "replay": perf_counter() - imported}
        tables.summary(again, path=out, wall=wall, profile=None, as_json=as_json, quiet=quiet)


@app.command()
def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help="A log.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another log.")],
    atol: Annotated[float, typer.Option(min=0.0, help="Absolute tolerance.")] = 0.0,
    rtol: Annotated[
        float, typer.Option(min=0.0, help="Tolerance relative to each signal's largest value.")
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Compare two logs signal by signal.

    Exit 1 outside the tolerance.
    """
    from cosim.report import tables
    from cosim.log import open_log
    from cosim.log.diff import diff as compare

    difference = compare(open_log(a), open_log(b), atol=atol, rtol=rtol)
    tables.difference(difference, as_json=as_json)
    if not difference.within:
        raise typer.Exit(1)


@app.command()
def compare(
    scenario: ScenarioArgument,
    swaps: Annotated[
        list[str],
        typer.Option(
            "--swap",
            metavar="COMPONENT=PATH",
            help="An alternative for a component: x.fmu, x.fmu#me, x.fmu#cs or a recorded log (.mcap). Once for each.",
        ),
    ],
    maps: MapOption = None,
    changes: SetOption = None,
    base: Annotated[
        bool,
        typer.Option(
            "--base/--no-base", help="Run the scenario's own component too, as the first."
        ),
    ] = True,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the estimates of all, and their differences."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder to write the logs to.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario on several plants and compare the estimates.

    Exit 1 where one of them fails.
    """
    from cosim.report import tables
    from cosim.report.comparing import compare as compare_plants
    from cosim.scenario.execution import load

    alternatives: dict[str, list[str]] = {}
    for text in swaps:
        ((name, path),) = _pairs([text], "--swap").items()
        alternatives.setdefault(name, []).append(path)
    loaded = load(scenario)
    _need_plot(plot, loaded.file.truth)
    edits = _edits(changes)
    found = compare_plants(
        loaded,
        swap=alternatives,
        map=_once(maps, "--map"),
        set=edits,
        base=base,
        out=out,
        force=force,
    )
    if plot is not None and found.recordings:
        from cosim.report.plots import plot_comparison

        plot_comparison(found, plot)
    tables.plants(found, as_json=as_json)
    if any(outcome.error for outcome in found.outcomes):
        raise typer.Exit(1)


@app.command()
def info(
    what: Annotated[
        str,
        typer.Argument(
            metavar="LOG|FMU|SCENARIO", help="A log (.mcap), an FMU (.fmu) or a scenario."
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Show what a log, an FMU or a scenario contains."""
    from cosim.report import tables

    tables.info(what, as_json=as_json)


@app.command()
def check(
    fmu: Annotated[Path, typer.Argument(metavar="FMU", help="An FMU (.fmu).")],
    as_json: JsonOption = False,
) -> None:
    """Find everything that is wrong with an FMU.

    Archive, schema, structure, binaries and trial runs; exit 1 at an error.
    """
    from cosim.report import tables

    tables.check(str(fmu), as_json=as_json)


@app.command()
def plot(
    log: LogArgument,
    signals: Annotated[
        list[str], typer.Argument(metavar="SIGNAL...", help="Signals, such as observer.delta.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="Picture to write (.png, .svg, .pdf)."),
    ],
) -> None:
    """Draw signals of a log over time."""
    from cosim.log import open_log
    from cosim.report.plots import plot_signals

    plot_signals(open_log(log), signals, out)
    typer.echo(str(out))


@app.command(name="list")
def list_(as_json: JsonOption = False) -> None:
    """List the shipped scenarios and the component kinds.

    Each kind with its parameters.
    """
    from cosim.report import tables

    tables.catalogue(as_json=as_json)


@app.command()
def show(scenario: ScenarioArgument) -> None:
    """Print a scenario's text: the start of one of your own."""
    from cosim.scenario.document import find

    typer.echo(find(scenario).text, nl=False)


@app.command()
def export(
    scenario: ScenarioArgument,
    component: Annotated[str, typer.Option(metavar="NAME", help="The component to export.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="PATH", help="The .fmu to write.")],
    fmi: Annotated[str, typer.Option(metavar="2|3", help="FMI version: 2 (2.0) or 3 (3.0).")] = "2",
    platform: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Cross-compile: x86_64-linux, aarch64-linux, x86_64-windows, x86_64-darwin, aarch64-darwin.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    dae: Annotated[
        bool,
        typer.Option(
            "--dae",
            help="Of a descriptor plant, with FMI 3: its algebraic equations too (FMI-LS-DAE, a draft).",
        ),
    ] = False,
    changes: SetOption = None,
) -> None:
    """Export a component as an FMU, C source and binary.

    For model exchange and co-simulation; what is discrete, for co-simulation only.
    """
    from cosim.scenario.exporting import export_component

    platforms = [] if platform is None else [name.strip() for name in platform.split(",")]
    edits = _edits(changes)
    for line in export_component(
        scenario, component, out, fmi=fmi, platforms=platforms, force=force, dae=dae, set=edits
    ):
        typer.echo(line)


@app.command()
def linearize(
    fmu: Annotated[Path, typer.Argument(metavar="FMU", help="An FMU for model exchange (.fmu).")],
    at: Annotated[
        float,
        typer.Option(
            metavar="T", help="Linearize where it arrives at this time with constant inputs [s]."
        ),
    ] = 0.0,
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Start value of an input, a parameter or a state. Repeatable.",
        ),
    ] = None,
    inputs: Annotated[
        list[str] | None,
        typer.Option("--input", metavar="NAME", help="Only these, in this order. Repeatable."),
    ] = None,
    outputs: Annotated[
        list[str] | None,
        typer.Option("--output", metavar="NAME", help="Only these, in this order. Repeatable."),
    ] = None,
    disturbances: Annotated[
        list[str] | None,
        typer.Option(
            "--disturbance",
            metavar="NAME",
            help="With --toml: an input that is unknown. Repeatable.",
        ),
    ] = None,
    differences: Annotated[
        bool, typer.Option("--differences", help="Central differences, whatever the FMU has.")
    ] = False,
    as_toml: Annotated[
        bool, typer.Option("--toml", help="Print a table for [models] of a scenario.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Linearize an FMU at an operating point.

    Print A, B, C and D, the poles and the static gain.
    """
    from cosim.report import tables
    from cosim.scenario.linearizing import linearize_file, model_table

    if as_toml and as_json:
        raise UsageError("--toml and --json: give one of them")
    if bool(disturbances) != as_toml:
        raise UsageError(
            "--toml and --disturbance NAME go together: a table of [models] tells known inputs from unknown ones"
        )
    found = linearize_file(
        fmu, at=at, start=_edits(values), inputs=inputs, outputs=outputs, differences=differences
    )
    if disturbances:
        for note in found.notes:
            typer.echo(f"note: {note}", err=True)
        typer.echo(model_table(found, disturbances), nl=False)
    else:
        tables.linearization(found, as_json=as_json)


def _need_plot(out: Path | None, truth: Collection[str]) -> None:
    from cosim.report.plots import need_plot

    if out is not None:
        need_plot(out, truth)


def _pairs(options: list[str] | None, option: str) -> dict[str, str]:
    pairs = {}
    for text in options or []:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise UsageError(f"{option} {text!r}: found no '=', needed NAME=VALUE")
        pairs[name.strip()] = value.strip()
    return pairs


def _once(options: list[str] | None, option: str) -> dict[str, str]:
    """Read pairs of which each name may be given once."""
    found = _pairs(options, option)
    if len(found) < len(options or []):
        names = [text.partition("=")[0].strip() for text in options or []]
        twice = next(name for name in names if names.count(name) > 1)
        way = "; 'cosim compare' runs several plants" if option == "--swap" else ""
        raise UsageError(f"{option} {twice}: given {names.count(twice)} times, needed once{way}")
    return found


def _edits(options: list[str] | None) -> dict[str, Any]:
    from cosim.scenario.document import parse_value

    return {key: parse_value(value) for key, value in _pairs(options, "--set").items()}


@contextmanager
def _progress(hidden: bool) -> Iterator[Progress | None]:
    """Show simulated time, speed relative to real time and time left on stderr, where that is a terminal."""
    if hidden or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[clock]}"),
        BarColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, clock="", speed="")
        began = perf_counter()

        def reached(time: float, end: float) -> None:
            speed = time / max(perf_counter() - began, 1e-9)
            bar.update(
                task,
                completed=time,
                total=end,
                clock=f"t = {time:.2f} of {end:g} s",
                speed=f"{speed:.3g} x real time",
            )

        yield reached


def _keep_stdout() -> TextIO | None:
    """Keep stdout for data: what C code prints to descriptor 1, also at its end, goes to stderr from here on.

    Gives the stream that is stdout now; None where Python's stdout is not descriptor 1, or stdout or stderr is closed.
    """
    try:
        if sys.stdout.fileno() != 1:
            return None
        sys.stdout.flush()
        data = os.dup(1)
        os.dup2(sys.stderr.fileno(), 1)
    except (AttributeError, OSError, ValueError):  # no stream, no descriptor, none that is open
        return None
    sys.stdout = open(
        data, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors, closefd=False
    )
    return sys.stdout


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; every deliberate error becomes one message and an exit code."""
    stdout = _keep_stdout()
    try:
        app(args=arguments)
    except CosimError as error:
        lines = str(error).splitlines() or [type(error).__name__]
        sys.stderr.write("\n".join(f"cosim: {line}" for line in lines) + "\n")
        sys.exit(error.exit_code)
    except OSError as error:  # stdout on a full disk, a folder that is gone
        sys.stderr.write(f"cosim: {error.filename or 'output'}: {error.strerror or error}\n")
        if stdout is not None:  # what is left in its buffer has nowhere to go
            with suppress(OSError):
                stdout.close()
        sys.exit(1)
