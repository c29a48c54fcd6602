"""The commands that compare: logs, plants, estimators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim import completion
from cosim.cli.options import (
    ForceOption,
    JsonOption,
    MapOption,
    ScenarioArgument,
    SetOption,
    check_plot,
    print_notice,
    prints_to_stderr,
    read_edits,
    read_numbers,
    read_pairs,
    read_unique_pairs,
)
from cosim.errors import UsageError
from cosim.report.printable import printable

if TYPE_CHECKING:
    from cosim.log import Log
    from cosim.log.comparison.difference import LogDifference
    from cosim.report.comparing import Comparison, EstimatorComparison

AlternativesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--swap",
        metavar="COMPONENT=PATH",
        autocompletion=completion.complete_swap,
        help="An alternative for a component: x.fmu, x.fmu#me, x.fmu#cs, a recorded log "
        "(.mcap) or time-stamped samples (.csv, .xlsx, ...). Repeatable.",
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
        "--base/--no-base", help="Also run the scenario's own component, as the reference."
    ),
]

ComparisonPlotOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Plot the estimates of all runs and their differences."),
]

FolderOption = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the logs.")
]


def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help="A log.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another log.")],
    signals: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SIGNAL]...",
            help="Signals to compare, elements or patterns: plant.y plant.x_a[0:2] '*.delta'. "
            "All by default.",
        ),
    ] = None,
    atol: Annotated[float, typer.Option(min=0.0, help="Absolute tolerance.")] = 0.0,
    rtol: Annotated[
        float, typer.Option(min=0.0, help="Tolerance relative to the largest value of each signal.")
    ] = 0.0,
    tol: Annotated[
        list[str] | None,
        typer.Option(
            "--tol",
            metavar="SIGNAL=VALUE",
            help="Absolute tolerance of the signals that match a pattern, instead of --atol and "
            "--rtol: '*.delta=1e-3'. If several patterns match, the last one counts. "
            "Repeatable.",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Plot the signal that differs most."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two logs signal by signal.

    Exit 1 if a signal is outside the tolerance.
    """
    from cosim.log import open_log
    from cosim.log.comparison.diff import diff as compare_logs
    from cosim.report.tables.comparison import print_difference

    check_plot(plot, None)
    tolerances = read_numbers(tol, "tol")
    logs = open_log(a), open_log(b)
    difference = compare_logs(*logs, atol=atol, rtol=rtol, tol=tolerances, signals=signals or ())
    print_difference(difference, as_json=as_json)
    if plot is not None:
        _draw_worst(difference, logs, plot, as_json=as_json)
    if not difference.within:
        raise typer.Exit(1)


def _draw_worst(
    difference: LogDifference, logs: tuple[Log, Log], out: Path, *, as_json: bool
) -> None:
    """Draw the signal that is farthest apart, and name the picture, unless stdout is for JSON."""
    from cosim.report.plots.runs import plot_difference

    if difference.worst is None:
        print_notice(f"{out}: not drawn, as the largest difference of two values is 0")
        return
    plot_difference(difference, logs, out)
    if not as_json:
        typer.echo(printable(str(out)))


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

    With --swap the scenario runs once for each plant; with --estimators every method gets the same
    recorded data. Exit 1 if one of them fails.
    """
    from cosim.report.comparing import compare as compare_plants
    from cosim.report.tables.comparison import print_plants
    from cosim.scenario.running.execution import load

    if estimators:
        if not base:
            raise UsageError("--no-base is for plants; omit it with --estimators")
        options = {"map": read_unique_pairs(maps, "map"), "set": read_edits(changes)}
        swap = _one_plant(swaps)
        _compare_estimators(
            scenario, estimators, swap, options, plot=plot, out=out, force=force, as_json=as_json
        )
        return
    if not swaps:
        raise UsageError("expected --swap or --estimators: what to compare")
    alternatives = _alternatives(swaps)
    loaded = load(scenario)
    check_plot(plot, out)
    if plot is not None and not loaded.file.truth:
        raise UsageError("the scenario has no [truth], so there are no estimates to plot")
    with prints_to_stderr():
        comparison = compare_plants(
            loaded,
            swap=alternatives,
            map=read_unique_pairs(maps, "map"),
            set=read_edits(changes),
            base=base,
            out=out,
            force=force,
        )
    _draw(comparison, plot)
    print_plants(comparison, as_json=as_json)
    if any(outcome.error for outcome in comparison.outcomes):
        raise typer.Exit(1)


def _alternatives(swaps: list[str]) -> dict[str, list[str]]:
    """Read --swap, given once for each alternative of a component."""
    alternatives: dict[str, list[str]] = {}
    for text in swaps:
        ((component, path),) = read_pairs([text], "swap").items()
        alternatives.setdefault(component, []).append(path)
    return alternatives


def _draw(comparison: Comparison | EstimatorComparison, plot: Path | None) -> None:
    """Draw the estimates of a comparison, where that is wanted and a run succeeded."""
    if plot is None or not comparison.recordings:
        return
    from cosim.report.plots.runs import plot_comparison

    plot_comparison(comparison, plot)


def _one_plant(swaps: list[str] | None) -> dict[str, str]:
    """Read --swap beside --estimators, where a component has one alternative at most."""
    components = [text.partition("=")[0].strip() for text in swaps or []]
    for component in components:
        if components.count(component) > 1:
            raise UsageError(
                f"--estimators: expected one plant, got several in --swap {component}; "
                "compare plants and estimators one after the other"
            )
    return read_pairs(swaps, "swap")


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
    from cosim.report.comparing import ALL, compare_estimators
    from cosim.report.tables.comparison import print_estimators
    from cosim.scenario.running.execution import load

    names = [name.strip() for name in ",".join(estimators).split(",")]
    loaded = load(scenario)
    check_plot(plot, out)
    with prints_to_stderr():
        comparison = compare_estimators(
            loaded,
            estimators=ALL if names == [ALL] else names,
            swap=swap,
            map=options["map"],
            set=options["set"],
            out=out,
            force=force,
        )
    _draw(comparison, plot)
    print_estimators(comparison, as_json=as_json)
    if any(result.failure for result in comparison.results):
        raise typer.Exit(1)
