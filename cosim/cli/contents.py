"""The commands that show what is there: info, plot, list and show."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim import completion
from cosim.cli.options import JsonOption, ScenarioArgument
from cosim.errors import UsageError
from cosim.files import file_type
from cosim.report.printable import printable

SizeOption = Annotated[
    str | None,
    typer.Option(metavar="WIDTHxHEIGHT", help="Size of the picture [cm], such as 16x9."),
]

TitleOption = Annotated[str | None, typer.Option(metavar="TEXT", help="Title of the picture.")]


def info(
    source: Annotated[
        str,
        typer.Argument(
            metavar="LOG|FMU|SCENARIO",
            help="A log (.mcap, also of other tools), an FMU (.fmu), samples (.csv, .xlsx, ...) or"
            " a scenario.",
            autocompletion=completion.complete_source,
        ),
    ],
    as_json: JsonOption = False,
    graph: Annotated[
        bool,
        typer.Option(
            "--graph",
            help="Scenario: show stages, the order inside loops, sample rates and direct "
            "feedthrough.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="With --graph: draw it (.png, .svg, .pdf)."
        ),
    ] = None,
) -> None:
    """Show what a log, an FMU or a scenario contains.

    Runs no code of FMUs or user classes.
    """
    if graph:
        _show_graph(source, out, as_json=as_json)
        return
    if out is not None:
        raise UsageError("--out is for the picture of --graph; give both or neither")
    from cosim.report.tables.contents import print_contents

    print_contents(source, as_json=as_json)


def _show_graph(source: str, out: Path | None, *, as_json: bool) -> None:
    """Show how the components of a scenario advance.

    Raises
    ------
    UsageError
        If it is no scenario, or there can be no picture.
    """
    from cosim.report.schedule import print_schedule, schedule_of

    type_name = file_type(source)
    if type_name in ("log", "FMU", "table"):
        raise UsageError(f"--graph {source}: expected a scenario, got a {type_name}")
    if out is not None:
        from cosim.report.plots.picture import need_plot

        need_plot(out)
    schedule = schedule_of(source)
    print_schedule(schedule, as_json=as_json)
    if out is not None:
        from cosim.report.schedule import plot_schedule

        plot_schedule(schedule, out)
        if not as_json:
            typer.echo(printable(str(out)))


def plot(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="LOG... [SIGNAL]...",
            help="Logs (.mcap), then signals or elements, one panel each: plant.y plant.x_a[0]. "
            "Joined by commas they share a panel: plant.y,observer.y. Without signals: the "
            "standard picture of a log.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="Picture to write (.png, .svg, .pdf)."),
    ],
    size: SizeOption = None,
    start: Annotated[
        float | None, typer.Option("--from", metavar="T", help="First time shown [s].")
    ] = None,
    stop: Annotated[
        float | None, typer.Option("--to", metavar="T", help="Last time shown [s].")
    ] = None,
    title: TitleOption = None,
) -> None:
    """Plot signals of one or several logs over time."""
    from cosim.log import open_log
    from cosim.report.plots.picture import PictureOptions
    from cosim.report.plots.runs import plot_run, plot_signals

    options = PictureOptions(read_size(size), start, stop, title)
    logs = [open_log(source) for source in sources if file_type(source) == "log"]
    signals = [source for source in sources if file_type(source) != "log"]
    if not logs:
        raise UsageError(f"expected a log (.mcap), got {', '.join(sources)}")
    if signals:
        plot_signals(logs, signals, out, options)
    elif len(logs) == 1:
        plot_run(logs[0], out, options)
    else:
        raise UsageError("several logs have no standard picture; name the signals to plot")
    typer.echo(printable(str(out)))


def read_size(text: str | None) -> tuple[float, float] | None:
    """Read the size of a picture [cm]; None: it is not given."""
    if text is None:
        return None
    width, _, height = text.partition("x")
    try:
        return float(width), float(height)
    except ValueError as error:
        raise UsageError(
            f"--size: expected WIDTHxHEIGHT in cm, such as 16x9, got {text!r}"
        ) from error


def list_(
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="KIND",
            help="Component kind whose ports and parameters to explain.",
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


def show(scenario: ScenarioArgument) -> None:
    """Print the text of a scenario, as a template for your own."""
    from cosim.scenario.document.document import find

    # a pipe ends in a terminal, too; what is escaped here is in no scenario that can be read
    typer.echo(printable(find(scenario).text), nl=False)
