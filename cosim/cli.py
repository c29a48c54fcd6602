"""The command line: a thin shell over :mod:`cosim.scenario` and :mod:`cosim.report`.

Data goes to stdout, messages to stderr.
Exit codes: 0 fine, 1 a check or the run failed, 2 wrong use; 130, 143, 129 interrupted by Ctrl-C,
a request to terminate, a closed terminal.
Imports of a command are in its function: ``cosim --help`` imports neither numpy nor fmpy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from cosim import completion
from cosim.errors import CosimError, UsageError, option, quoted, shell_language
from cosim.files import file_type
from cosim.report.printable import printable
from cosim.terminal import (
    ended_by_signals,
    keep_stdout,
    open_standard_streams,
    outlive_terminal,
    show_progress,
)
from cosim.unanswered import ended_if_unanswered
from cosim.version import __version__

if TYPE_CHECKING:
    from cosim.scenario.parsing import Scenario

BEGAN = perf_counter()

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A shipped scenario by name, or a path to a .toml file.",
        autocompletion=completion.complete_scenario,
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
        autocompletion=completion.complete_setting,
        help="Set a value, such as observer.filter_rate=500. Repeatable.",
    ),
]
SwapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--swap",
        metavar="COMPONENT=PATH",
        autocompletion=completion.complete_swap,
        help="Replace a component by an FMU (x.fmu, x.fmu#me, x.fmu#cs), a recorded component "
        "(.mcap) or samples with their times (.csv, .parquet). Repeatable.",
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar="PORT=NAME",
        autocompletion=completion.complete_map,
        help="Ports of the replacing component: observer.y=out1, plant.x=[s1,s2]. Repeatable.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
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
        help="Plot the estimates with truth and errors, or the outputs, to a file "
        "(.png, .svg, .pdf).",
    ),
]
RunOutOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="PATH",
        help="Log to write (.mcap); default: logs/<scenario>.mcap, -2, -3, ...",
    ),
]
StepOption = Annotated[
    float | None,
    typer.Option(help="Communication step [s]; the same as --set scenario.step=..."),
]
ProfileOption = Annotated[
    bool, typer.Option("--profile", help="Show the wall time of each component.")
]
DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Check the scenario and compare swapped components with the replaced; do not run. "
        "FMUs are loaded and initialized, which runs their code, in a process of its own.",
    ),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cosim {__version__}")
        raise typer.Exit


@app.callback()
def cosim(
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


@app.command()
def run(
    scenario: ScenarioArgument,
    out: RunOutOption = None,
    force: ForceOption = False,
    changes: SetOption = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    step: StepOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    profile: ProfileOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Run a scenario and record every signal to an MCAP log."""
    from cosim.processes import COMMAND_VARIABLE, end_with_parent
    from cosim.report.tables.run import print_summary
    from cosim.scenario.execution import load
    from cosim.scenario.execution import run as run_scenario

    if dry_run and COMMAND_VARIABLE not in os.environ:
        options = {"--set": changes, "--swap": swaps, "--map": maps}
        _dry_run_in_child(scenario, options, {"--stop": stop, "--step": step}, as_json=as_json)
    end_with_parent()
    imported = perf_counter()
    edits = _edits(changes, {"scenario.stop": stop, "scenario.step": step})
    loaded = load(scenario)
    edited = loaded.edit(swap=_once(swaps, "swap"), map=_once(maps, "map"), set=edits)
    if dry_run:
        _dry_run(edited, as_json=as_json)
        return
    if force and out is None:
        raise UsageError("--force replaces the log at --out; needed both, or neither")
    path = out or Path("logs") / f"{edited.name}.mcap"
    _need_plot(plot, out)
    seconds: dict[str, float] | None = {} if profile else None
    with show_progress(quiet or as_json) as progress:
        log = run_scenario(
            edited,
            out=path,
            force=force,
            numbered=out is None,
            progress=progress,
            notice=None if quiet else _notice,
            profile=seconds,
        )
    wall = {"imports": imported - BEGAN, "run": perf_counter() - imported}
    if plot is not None:
        from cosim.report.plots import plot_run

        plot_run(log, plot)
    print_summary(log, wall=wall, profile=seconds, as_json=as_json, quiet=quiet)


def _given(values: Mapping[str, float | None]) -> dict[str, float]:
    """Return the values of the options that were given."""
    return {key: value for key, value in values.items() if value is not None}


def _dry_run_in_child(
    scenario: str,
    options: Mapping[str, Sequence[str] | None],
    numbers: Mapping[str, float | None],
    *,
    as_json: bool,
) -> NoReturn:
    """Do a dry run in a child process, as it runs the code of FMUs; exit as that does."""
    from cosim.processes import run_command
    from cosim.report.tables.console import terminal_width

    arguments = ["run", scenario, "--dry-run"]
    for name, values in options.items():
        for value in values or ():
            arguments += [name, value]
    for name, number in _given(numbers).items():
        arguments += [name, repr(number)]
    if as_json:
        arguments.append("--json")
    result = run_command(arguments, columns=terminal_width())
    typer.echo(result.output, nl=False)
    typer.echo(result.messages, nl=False, err=True)
    raise typer.Exit(result.exit_code)


def _dry_run(scenario: Scenario, *, as_json: bool) -> None:
    """Compare swapped components with those they replace.

    Raises
    ------
    UsageError
        If the scenario cannot run with them.
    """
    from cosim.report.tables.comparison import print_dry_run
    from cosim.scenario.swap_comparison import compare_swaps

    reports = compare_swaps(scenario)
    print_dry_run(reports, as_json=as_json)
    if reports.refusals:
        raise UsageError("\n".join([*reports.refusals, *reports.hints]))


@app.command()
def replay(
    log: LogArgument,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Check the log's content hash, and compare with the log what is computed again: "
            "every signal, bit for bit, and what the log says of its run (truth, connections, "
            "schedule, times, component tables, warnings, last row); exit 1 if one differs. A log "
            "is not signed: one of another run, put in its place as a whole, passes.",
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

    The log is all that is needed.
    """
    from cosim.log import open_log
    from cosim.report.tables.run import print_summary, print_verification
    from cosim.report.verification import verify as verify_replay
    from cosim.scenario.execution import replay as replay_log

    imported = perf_counter()
    source = open_log(log)
    if verify and stop is not None:
        raise UsageError("--verify compares the whole log; leave out --stop")
    edits = _edits(changes, {"scenario.stop": stop})
    _need_plot(plot, out)
    with show_progress(quiet or as_json) as progress:
        notice = None if quiet else _notice
        again = replay_log(
            source, out=out, force=force, set=edits, progress=progress, notice=notice
        )
    if plot is not None:
        from cosim.report.plots import plot_run

        plot_run(again, plot)
    if verify:
        verification = verify_replay(source, again)
        print_verification(verification, source, path=log, as_json=as_json, quiet=quiet)
        if not verification.passed:
            raise typer.Exit(1)
    else:
        wall = {"imports": imported - BEGAN, "replay": perf_counter() - imported}
        print_summary(again, wall=wall, profile=None, as_json=as_json, quiet=quiet)


@app.command()
def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help="A log.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another log.")],
    signals: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SIGNAL]...",
            help="Signals to compare, or elements: plant.y plant.x_a[0:2]. All by default.",
        ),
    ] = None,
    atol: Annotated[float, typer.Option(min=0.0, help="Absolute tolerance.")] = 0.0,
    rtol: Annotated[
        float, typer.Option(min=0.0, help="Tolerance relative to each signal's largest value.")
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Compare two logs signal by signal, or only the SIGNALs given.

    Exit 1 outside the tolerance.
    """
    from cosim.log import open_log
    from cosim.log.diff import diff as compare_logs
    from cosim.report.tables.comparison import print_difference

    logs = open_log(a), open_log(b)
    difference = compare_logs(*logs, atol=atol, rtol=rtol, signals=signals or ())
    print_difference(difference, as_json=as_json)
    if not difference.within:
        raise typer.Exit(1)


AlternativesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--swap",
        metavar="COMPONENT=PATH",
        autocompletion=completion.complete_swap,
        help="An alternative for a component: x.fmu, x.fmu#me, x.fmu#cs, a recorded log (.mcap) "
        "or samples with their times (.csv, .parquet). Once for each.",
    ),
]
EstimatorsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--estimators",
        metavar="all|METHOD,...",
        autocompletion=completion.complete_estimators,
        help="Methods of the identifier, each on the same recorded data. Repeatable.",
    ),
]
BaseOption = Annotated[
    bool,
    typer.Option(
        "--base/--no-base", help="Run the scenario's own component too, as the reference."
    ),
]
ComparisonPlotOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Plot the estimates of all runs, and their differences."),
]
FolderOption = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder to write the logs to.")
]


@app.command()
def compare(
    scenario: ScenarioArgument,
    swaps: AlternativesOption = None,
    estimators: EstimatorsOption = None,
    maps: MapOption = None,
    changes: SetOption = None,
    base: BaseOption = True,
    plot: ComparisonPlotOption = None,
    out: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario on several plants, or with several estimators.

    With --swap once for each plant; with --estimators every method takes the same recorded data.
    Exit 1 where one of them fails.
    """
    from cosim.report.comparing import compare as compare_plants
    from cosim.report.tables.comparison import print_plants
    from cosim.scenario.execution import load

    if estimators:
        if not base:
            raise UsageError("--no-base is about plants; leave it out with --estimators")
        options = {"map": _once(maps, "map"), "set": _edits(changes)}
        swap = _one_plant(swaps)
        _compare_estimators(
            scenario, estimators, swap, options, plot=plot, out=out, force=force, as_json=as_json
        )
        return
    if not swaps:
        raise UsageError("found neither --swap nor --estimators; needed what is compared")
    alternatives: dict[str, list[str]] = {}
    for text in swaps:
        ((name, path),) = _pairs([text], "swap").items()
        alternatives.setdefault(name, []).append(path)
    loaded = load(scenario)
    _need_plot(plot, out)
    if plot is not None and not loaded.file.truth:
        raise UsageError("the scenario has no [truth], so there are no estimates to plot")
    comparison = compare_plants(
        loaded,
        swap=alternatives,
        map=_once(maps, "map"),
        set=_edits(changes),
        base=base,
        out=out,
        force=force,
    )
    if plot is not None and comparison.recordings:
        from cosim.report.plots import plot_comparison

        plot_comparison(comparison, plot)
    print_plants(comparison, as_json=as_json)
    if any(outcome.error for outcome in comparison.outcomes):
        raise typer.Exit(1)


def _one_plant(swaps: list[str] | None) -> dict[str, str]:
    """Read --swap beside --estimators, where a component has one alternative at most."""
    components = [text.partition("=")[0].strip() for text in swaps or []]
    for component in components:
        if components.count(component) > 1:
            raise UsageError(
                f"found --estimators and several plants in --swap {component}; needed one plant: "
                "compare plants and estimators one after the other"
            )
    return _pairs(swaps, "swap")


def _compare_estimators(
    scenario: str,
    estimators: list[str],
    swap: dict[str, str],
    options: dict[str, dict[str, Any]],
    *,
    plot: Path | None,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    from cosim.report.estimator_comparison import ALL, compare_estimators
    from cosim.report.tables.comparison import print_estimators
    from cosim.scenario.execution import load

    names = [name.strip() for text in estimators for name in text.split(",")]
    loaded = load(scenario)
    _need_plot(plot, out)
    comparison = compare_estimators(
        loaded,
        estimators=ALL if names == [ALL] else names,
        swap=swap,
        map=options["map"],
        set=options["set"],
        out=out,
        force=force,
    )
    if plot is not None and comparison.recordings:
        from cosim.report.plots import plot_comparison

        plot_comparison(comparison, plot)
    print_estimators(comparison, as_json=as_json)
    if any(result.failure for result in comparison.results):
        raise typer.Exit(1)


LogsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", help="Logs (.mcap) of one plant under one theta: they make one fit."
    ),
]
IdentifierOption = Annotated[
    str | None,
    typer.Option(
        "--component", metavar="NAME", help="The identifier, where the scenario has several."
    ),
]
ValidateOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="LOG",
        help="A log that is not used in the fit: does theta hold there? Exit 1 if not. Repeatable.",
    ),
]
OffsetOption = Annotated[
    bool, typer.Option("--offset", help="An unknown constant is on every output.")
]
BoundsOption = Annotated[
    str | None,
    typer.Option(
        metavar="ROWS",
        help="[lower, upper] for every theta, equal ones fix it: [[-1,0],[-inf,inf]]; default: "
        "those of the scenario.",
    ),
]
IrregularOption = Annotated[
    float | None,
    typer.Option(
        metavar="D",
        help="Guaranteed intervals for an irregular part of the disturbance, |delta_0| <= D, by "
        "linear programs.",
    ),
]
IdentificationPlotOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Plot residual, its spectrum, the smoothed disturbance and theta (.png, .svg, .pdf).",
    ),
]


@app.command()
def identify(
    logs: LogsArgument,
    component: IdentifierOption = None,
    validate: ValidateOption = None,
    offset: OffsetOption = False,
    bounds: BoundsOption = None,
    irregular: IrregularOption = None,
    plot: IdentificationPlotOption = None,
    as_json: JsonOption = False,
) -> None:
    """Identify theta from logs by output error.

    Whatever method their runs used.

    Standard errors, 95 % intervals, a verdict on every parameter, tests of the residual.
    """
    from cosim.log import open_log
    from cosim.report.identification import report_identification
    from cosim.report.tables.console import print_line
    from cosim.report.tables.identification import print_identification
    from cosim.scenario.edits import parse_value
    from cosim.scenario.identification.from_logs import identifier_record, identify_records
    from cosim.scenario.identification.model import bounds_of

    if irregular is not None and not 0.0 < irregular < float("inf"):
        raise UsageError(f"--irregular: found {irregular:g}, needed a positive number")
    _need_plot(plot, None)
    records = [identifier_record(open_log(log), component) for log in logs]
    others = [identifier_record(open_log(log), component) for log in validate or ()]
    limits = None
    if bounds is not None:
        limits = bounds_of(parse_value(bounds), records[0].identified.parameters)
    found = identify_records(records, offset=offset, bounds=limits)
    if irregular is not None and not as_json:
        print_line(
            "note: the guaranteed interval rests on linear programs, which take seconds to minutes",
            error=True,
        )
    report = report_identification(found, others=others, irregular=irregular)
    if plot is not None:
        from cosim.report.plots import plot_identification

        plot_identification(found, plot)
    print_identification(report, as_json=as_json)
    if report.failed:
        raise typer.Exit(1)


@app.command()
def info(
    source: Annotated[
        str,
        typer.Argument(
            metavar="LOG|FMU|SCENARIO",
            help="A log (.mcap), an FMU (.fmu), samples (.csv, .parquet) or a scenario.",
            autocompletion=completion.complete_source,
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Show what a log, an FMU or a scenario contains."""
    from cosim.report.tables.contents import print_contents

    print_contents(source, as_json=as_json)


@app.command()
def check(
    fmu: Annotated[Path, typer.Argument(metavar="FMU", help="An FMU (.fmu).")],
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Exit 1 also for a warning: what is against the standard, but runs here.",
        ),
    ] = False,
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="Start value for the trial runs. Repeatable."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Report every problem of an FMU.

    Archive, schema, structure, binaries and trial runs; exit 1 if there is an error.
    """
    from cosim.arguments import fmu_argument
    from cosim.fmi.checking.check import check as check_fmu
    from cosim.report.tables.fmu import print_check

    findings = check_fmu(fmu_argument(fmu), start=_edits(values))
    print_check(str(fmu), findings, as_json=as_json)
    refused = {"error", "warning"} if strict else {"error"}
    if any(finding.level in refused for finding in findings):
        raise typer.Exit(1)


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove everything in it.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show or clear the cache of what trials of FMUs found.

    By the content of their files.

    It is in the user's cache folder, or in the one that the environment variable COSIM_CACHE names
    (empty: no cache).
    """
    from cosim.report.tables.fmu import print_cache

    print_cache(clear=clear, as_json=as_json)


@app.command()
def plot(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="LOG... [SIGNAL]...",
            help="One or several logs (.mcap), then signals or their elements, a panel each: "
            "plant.y plant.x_a[0]. With commas between they share a panel: plant.y,observer.y. "
            "Without signals: the standard picture of a log.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="Picture to write (.png, .svg, .pdf)."),
    ],
    size: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT", help="Size of the picture [cm], such as 16x9."),
    ] = None,
    start: Annotated[
        float | None, typer.Option("--from", metavar="T", help="First time shown [s].")
    ] = None,
    stop: Annotated[
        float | None, typer.Option("--to", metavar="T", help="Last time shown [s].")
    ] = None,
    title: Annotated[str | None, typer.Option(metavar="TEXT", help="Title of the picture.")] = None,
) -> None:
    """Plot signals of one or several logs over time."""
    from cosim.log import open_log
    from cosim.report.plots import PictureOptions, plot_run, plot_signals

    options = PictureOptions(_size(size), start, stop, title)
    logs = [open_log(source) for source in sources if file_type(source) == "log"]
    signals = [source for source in sources if file_type(source) != "log"]
    if not logs:
        raise UsageError(
            f"found no log among {', '.join(sources)}; needed a path that ends in .mcap"
        )
    if signals:
        plot_signals(logs, signals, out, options)
    elif len(logs) == 1:
        plot_run(logs[0], out, options)
    else:
        raise UsageError("several logs have no standard picture; name the signals to plot")
    typer.echo(printable(str(out)))


def _size(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    width, _, height = text.partition("x")
    try:
        return float(width), float(height)
    except ValueError as error:
        raise UsageError(
            f"--size: found {text!r}, needed WIDTHxHEIGHT in cm, such as 16x9"
        ) from error


@app.command(name="list")
def list_(
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="KIND",
            help="A component kind, to explain its ports and parameters.",
            autocompletion=completion.complete_kind,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the shipped scenarios and the component kinds.

    Each kind is listed with its parameters; KIND explains those of one.
    """
    from cosim.report.tables.catalog import print_catalog, print_kind

    if kind is None:
        print_catalog(as_json=as_json)
    else:
        print_kind(kind, as_json=as_json)


@app.command()
def show(scenario: ScenarioArgument) -> None:
    """Print the text of a scenario, to start your own from."""
    from cosim.scenario.document import find

    text = find(scenario).text
    typer.echo(printable(text) if sys.stdout.isatty() else text, nl=False)


@app.command()
def export(
    scenario: ScenarioArgument,
    component: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="The component to export.",
            autocompletion=completion.complete_component,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="The .fmu to write; default: fmus/<scenario>-<component>.fmu",
        ),
    ] = None,
    fmi: Annotated[str, typer.Option(metavar="2|3", help="FMI version: 2 (2.0) or 3 (3.0).")] = "2",
    platform: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Cross-compile: x86_64-linux, aarch64-linux, x86_64-windows, x86_64-darwin, "
            "aarch64-darwin.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    dae: Annotated[
        bool,
        typer.Option(
            "--dae",
            help="Include the algebraic equations of a descriptor plant (FMI 3, draft FMI-LS-DAE).",
        ),
    ] = False,
    changes: SetOption = None,
) -> None:
    """Export a component as an FMU, C source and binary.

    It has both interface types; that of a discrete component is for co-simulation only.
    """
    from cosim.scenario.exporting import export_component

    platforms = [] if platform is None else [name.strip() for name in platform.split(",")]
    edits = _edits(changes)
    for line in export_component(
        scenario, component, out, fmi=fmi, platforms=platforms, force=force, dae=dae, set=edits
    ):
        typer.echo(printable(line))


TimeOption = Annotated[
    float,
    typer.Option(
        metavar="T", help="Time of the operating point, reached with constant inputs [s]."
    ),
]
StartOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Start value of an input, a parameter or a state. Repeatable.",
    ),
]
InputsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--input", metavar="NAME", help="Use these inputs only, in this order. Repeatable."
    ),
]
OutputsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--output", metavar="NAME", help="Use these outputs only, in this order. Repeatable."
    ),
]
DisturbancesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--disturbance", metavar="NAME", help="With --toml: an unknown input. Repeatable."
    ),
]
DifferencesOption = Annotated[
    bool,
    typer.Option(
        "--differences",
        help="Use central differences even where the FMU has directional derivatives.",
    ),
]
TomlOption = Annotated[
    bool, typer.Option("--toml", help="Print a table for [models] of a scenario.")
]


@app.command()
def linearize(
    fmu: Annotated[Path, typer.Argument(metavar="FMU", help="An FMU for model exchange (.fmu).")],
    at: TimeOption = 0.0,
    values: StartOption = None,
    inputs: InputsOption = None,
    outputs: OutputsOption = None,
    disturbances: DisturbancesOption = None,
    differences: DifferencesOption = False,
    as_toml: TomlOption = False,
    as_json: JsonOption = False,
) -> None:
    """Linearize an FMU at an operating point.

    Print A, B, C and D, the poles and the static gain.
    """
    from cosim.fmi.linearizing.linearize import linearize_file
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.report.tables.fmu import print_linearization
    from cosim.scenario.linearizing import model_table

    if as_toml and as_json:
        raise UsageError("--toml and --json: give one of them")
    if bool(disturbances) != as_toml:
        raise UsageError(
            "--toml and --disturbance NAME go together: "
            "a table of [models] separates known inputs from unknown ones"
        )
    request = LinearizationRequest(
        at=at,
        start=_edits(values),
        inputs=inputs,
        outputs=outputs,
        method="central differences" if differences else None,
    )
    linearization = linearize_file(fmu, request)
    if disturbances:
        for note in linearization.notes:
            typer.echo(printable(f"note: {note}"), err=True)
        typer.echo(model_table(linearization, disturbances), nl=False)
    else:
        print_linearization(linearization, as_json=as_json)


def _notice(text: str) -> None:
    typer.echo(printable(text), err=True)


def _need_plot(plot: Path | None, out: Path | None) -> None:
    """Refuse a picture that could not be drawn, before the run whose logs go to ``out``."""
    if plot is None:
        return
    from cosim.report.plots import need_plot

    need_plot(plot)
    if out is None:
        return
    picture = Path(os.path.realpath(plot))
    target = Path(os.path.realpath(out))
    if target == picture or (file_type(target) == "log" and target in picture.parents):
        raise UsageError(f"--plot {plot}: found the path of the log, --out {out}; needed another")


def _pairs(texts: list[str] | None, name: str) -> dict[str, str]:
    """Read the pairs KEY=VALUE of an option."""
    pairs = {}
    for text in texts or []:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            missing = "no name" if equals else "no '='"
            raise UsageError(f"{option(name)} {quoted(text)}: found {missing}, needed NAME=VALUE")
        pairs[key.strip()] = value.strip()
    return pairs


def _once(texts: list[str] | None, name: str) -> dict[str, str]:
    """Read pairs of which each key may be given once."""
    pairs = _pairs(texts, name)
    keys = [text.partition("=")[0].strip() for text in texts or []]
    for key in keys:
        count = keys.count(key)
        if count > 1:
            remedy = "; 'cosim compare' runs several plants" if name == "swap" else ""
            raise UsageError(f"{option(name, key)}: given {count} times, needed once{remedy}")
    return pairs


def _edits(
    texts: list[str] | None, options: Mapping[str, float | None] | None = None
) -> dict[str, Any]:
    """Read the pairs of --set, whose values are TOML where they can be, and add those of options.

    ``options`` are the values of --stop and --step, by the keys that they set.
    """
    from cosim.scenario.edits import parse_value

    edits = {}
    for key, text in _pairs(texts, "set").items():
        try:
            edits[key] = parse_value(text)
        except UsageError as error:
            raise UsageError(f"{option('set', key)}: {error}") from error
    for key, value in _given(options or {}).items():
        if key in edits:
            name = key.removeprefix("scenario.")
            raise UsageError(f"found both --{name} and --set {key}; needed one of them")
        edits[key] = value
    return edits


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
