"""The commands that show what there is: info, list and show."""

from __future__ import annotations

import typer

from cosim.cli.command import Given, command
from cosim.cli.options import check_plot, shared
from cosim.errors import UsageError
from cosim.files import file_type
from cosim.options import Rule
from cosim.report.printable import print_text, printable


@command(
    {
        "source LOG|FMU|SCENARIO : source": "A log (.mcap, also of other tools), an FMU (.fmu), "
        "samples (.csv, .xlsx, ...) or a scenario.",
        **shared("json"),
        "--graph": "Scenario: show stages, the order inside loops, sample rates and direct "
        "feedthrough.",
        "--out -o FILE : Path": "With --graph: draw it (.png, .svg, .pdf).",
    },
    Rule("out", "is for the picture of a graph", needs="graph"),
)
def info(given: Given) -> None:
    """Show what a log, an FMU or a scenario contains.

    Runs no code of FMUs or user classes.
    """
    if not given.graph:
        from cosim.report.tables.contents import print_contents

        print_contents(given.source, as_json=given.json)
        return
    from cosim.report.schedule import plot_schedule, print_schedule, schedule_of

    type_name = file_type(given.source)
    if type_name in ("log", "FMU", "table"):
        raise UsageError(f"--graph {given.source}: expected a scenario, got a {type_name}")
    check_plot(given.out)
    schedule = schedule_of(given.source)
    print_schedule(schedule, as_json=given.json)
    if given.out is not None:
        plot_schedule(schedule, given.out)
        if not given.json:
            print_text(given.out)


@command(
    {
        "kind KIND : kind = None": "Component kind whose ports and parameters to explain.",
        **shared("json"),
    }
)
def list_(given: Given) -> None:
    """List the shipped scenarios and the component kinds.

    Each kind is listed with its parameters; KIND explains those of one.
    """
    from cosim.report.tables.catalog import print_catalog, print_kind

    if given.kind is None:
        print_catalog(as_json=given.json)
    else:
        print_kind(given.kind, as_json=given.json)


@command(shared("scenario"))
def show(given: Given) -> None:
    """Print the text of a scenario, as a template for your own."""
    from cosim.scenario.document.document import find

    # a pipe ends in a terminal, too; what is escaped here is in no scenario that can be read
    typer.echo(printable(find(given.scenario).text), nl=False)
