"""The commands that show what there is: info, list and show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from cosim.cli.command import Given, command
from cosim.cli.options import check_plot, shared
from cosim.errors import LogError, UsageError
from cosim.files import file_type
from cosim.options import Rule
from cosim.report.printable import print_text, printable

if TYPE_CHECKING:
    from cosim.report.tables.console import Shown


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
    from cosim.report.schedule import describe_schedule, plot_schedule, show_schedule

    if not given.graph:
        content = _describe(given.source)
        given.print_shown(_show_contents(content))
        if "problems" in content:
            raise LogError("\n".join(content["problems"]))
        return
    type_name = file_type(given.source)
    if type_name in ("log", "FMU", "table"):
        raise UsageError(f"--graph {given.source}: expected a scenario, got a {type_name}")
    check_plot(given.out)
    schedule = describe_schedule(given.source)
    given.print_shown(show_schedule(schedule))
    if given.out is not None:
        plot_schedule(schedule, given.out)
        if not given.json:
            print_text(given.out)


def _describe(source: str) -> dict[str, Any]:
    """Return what a log, an FMU, a table of samples or a scenario contains, by titles."""
    from cosim.arguments import path_argument
    from cosim.log.foreign.topics import is_foreign
    from cosim.report import inspection
    from cosim.report.fmu import describe_fmu

    path = path_argument("source", source)
    if path.is_dir():
        raise UsageError(
            f"{source}: expected a log (.mcap), an FMU (.fmu), samples (.csv, .xlsx, ...) or a "
            "scenario, got a folder"
        )
    match file_type(path):
        case "log" if is_foreign(path):
            return inspection.describe_recording(source)
        case "log":
            return inspection.describe_log(source)
        case "FMU":
            return describe_fmu(source)
        case "table":
            return inspection.describe_samples(source)
    return inspection.describe_scenario(source)


def _show_contents(content: dict[str, Any]) -> Shown:
    """Show it; differences between swapped and replaced components by component."""
    from cosim.report.fmu import fmu_sections
    from cosim.report.tables.console import section_tables
    from cosim.scenario.recordings.swap_report import row_texts

    yield content
    sections = []
    for title, section in fmu_sections(content) if "fmu" in content else content.items():
        if title == "differences":
            for component, rows in section.items():
                texts = [row_texts(row, whole=row["port"] == component) for row in rows]
                sections.append((f"{component}: differences from the replaced component", texts))
        elif title != "problems":  # printed as an error
            sections.append((title, section))
    yield section_tables(sections)


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
    from cosim.report.tables.catalog import show_catalog, show_kind

    shown = show_catalog() if given.kind is None else show_kind(given.kind)
    given.print_shown(shown)


@command(shared("scenario"))
def show(given: Given) -> None:
    """Print the text of a scenario, as a template for your own."""
    from cosim.scenario.document.document import find

    # a pipe ends in a terminal, too; what is escaped here is in no scenario that can be read
    typer.echo(printable(find(given.scenario).text), nl=False)
