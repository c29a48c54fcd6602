"""The commands that run nothing: info, list, show, identify and design."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any

import typer

import cosim
from cosim.cli.command import Given, command
from cosim.cli.options import check_plot, prints_to_stderr, shared
from cosim.errors import LogError, UsageError
from cosim.files import read_type
from cosim.options import Rule
from cosim.report.printable import print_notice, print_text, printable
from cosim.terminal import show_count

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
    type_name = read_type(given.source)
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
    match read_type(path):
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
                texts = list(map(row_texts, rows))
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


@command(
    {
        "logs LOG... : list[Path]": "Logs (.mcap) of one plant with one theta, for a joint fit.",
        "--component NAME : str": "The identifier, if the scenario has several.",
        "--validate LOG : list[Path]": "Validate theta on a log that is not used in the fit; exit "
        "1 if it does not hold. Repeatable.",
        "--offset": "Every output has an unknown constant offset.",
        "--bounds ROWS : str": "[lower, upper] of each theta, equal bounds fix it: "
        "[[-1,0],[-inf,inf]]; default: those of the scenario.",
        "--irregular D : float": "Guaranteed intervals for an irregular part of the disturbance "
        "|delta_0| <= D, by linear programming.",
        "--plot FILE : Path": "Plot the residual, its spectrum, the smoothed disturbance and theta "
        "(.png, .svg, .pdf).",
        **shared("json"),
    }
)
def identify(given: Given) -> bool:
    """Identify theta from logs by output error.

    The method of the recorded runs does not matter. Shows standard errors, 95 % intervals, a
    verdict on every parameter and tests of the residual.
    """
    from cosim.report.tables.identification import show_identification
    from cosim.scenario.document.document import parse_value
    from cosim.scenario.recordings.verdicts import irregular_part
    from cosim.scenario.running.identifying import identifier_record

    irregular = given.irregular
    if irregular is not None and not 0.0 < irregular < float("inf"):
        raise UsageError(f"--irregular: expected a positive number, got {irregular:g}")
    check_plot(given.plot)
    others = [identifier_record(log, given.component) for log in given.validate]
    bounds = None if given.bounds is None else parse_value(given.bounds)
    identification = cosim.identify(
        given.logs, identifier=given.component, offset=given.offset, bounds=bounds
    )
    if irregular is not None and not given.json:
        print_notice(
            "note: the guaranteed interval rests on linear programs, which take seconds to minutes"
        )
    validations = {other.log.label: identification.validate(other) for other in others}
    part = None
    began = perf_counter()
    if irregular is not None:
        with show_count(given.json, "linear programs solved") as watch:
            part = irregular_part(irregular, identification.guaranteed_interval(irregular, watch))
    seconds = perf_counter() - began
    if given.plot is not None:
        from cosim.report.plots.identification import plot_identification

        plot_identification(identification, given.plot)
    given.print_shown(show_identification(identification, validations, part, seconds))
    return any(one.verdict == "FAILS" for one in validations.values())


@command(
    {
        **shared("scenario"),
        "--noise D : deviations": "Standard deviation of the noise of y, or [d0,d1] for several "
        "outputs; default: as given for the identifier, the observer or a sensor.",
        "--theta [...] : deviations": "True theta, in the order of the regressor's terms; default: "
        "that of the disturbance.",
        "--longest T : float": "Longest delay to try [s]; default: a quarter of the run, or that "
        "of the scenario.",
        "--input": "Also rank other input amplitudes.",
        **shared("set json"),
    }
)
def design(given: Given) -> None:
    """Rank experiment designs by the predicted error of theta.

    Ranks delays, filters, steps and windows relative to the Cramer-Rao bound of y, which the
    output-error method attains.
    """
    from cosim.report.tables.preparation import show_design

    with prints_to_stderr():
        result = cosim.design(given.scenario, **given.only("noise theta longest input set"))
    given.print_shown(show_design(result))
