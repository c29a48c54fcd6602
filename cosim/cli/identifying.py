"""The command that identifies from logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.options import JsonOption, check_plot
from cosim.errors import UsageError
from cosim.terminal import show_count

if TYPE_CHECKING:
    from cosim.scenario.running.identifying import IdentifierRecord

LogsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", help="Logs (.mcap) of one plant with one theta, for a joint fit."
    ),
]

IdentifierOption = Annotated[
    str | None,
    typer.Option(
        "--component", metavar="NAME", help="The identifier, if the scenario has several."
    ),
]

ValidateOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="LOG",
        help="Validate theta on a log that is not used in the fit; exit 1 if it does not "
        "hold. Repeatable.",
    ),
]

OffsetOption = Annotated[
    bool, typer.Option("--offset", help="Every output has an unknown constant offset.")
]

BoundsOption = Annotated[
    str | None,
    typer.Option(
        metavar="ROWS",
        help="[lower, upper] of each theta, equal bounds fix it: [[-1,0],[-inf,inf]]; "
        "default: those of the scenario.",
    ),
]

IrregularOption = Annotated[
    float | None,
    typer.Option(
        metavar="D",
        help="Guaranteed intervals for an irregular part of the disturbance |delta_0| <= D, "
        "by linear programming.",
    ),
]

IdentificationPlotOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Plot the residual, its spectrum, the smoothed disturbance and theta (.png, "
        ".svg, .pdf).",
    ),
]


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

    The method of the recorded runs does not matter. Shows standard errors, 95 % intervals, a
    verdict on every parameter and tests of the residual.
    """
    from cosim.log import open_log
    from cosim.report.tables.console import print_line
    from cosim.report.tables.identification import print_identification, report_identification
    from cosim.scenario.running.identifying import identifier_record, identify_records

    if irregular is not None and not 0.0 < irregular < float("inf"):
        raise UsageError(f"--irregular: expected a positive number, got {irregular:g}")
    check_plot(plot, None)
    records = [identifier_record(open_log(log), component) for log in logs]
    others = [identifier_record(open_log(log), component) for log in validate or ()]
    identification = identify_records(records, offset=offset, bounds=_bounds(bounds, records[0]))
    if irregular is not None and not as_json:
        print_line(
            "note: the guaranteed interval rests on linear programs, which take seconds to minutes",
            error=True,
        )
    with show_count(as_json or irregular is None, "linear programs solved") as watch:
        report = report_identification(
            identification, others=others, irregular=irregular, watch=watch
        )
    if plot is not None:
        from cosim.report.plots.identification import plot_identification

        plot_identification(identification, plot)
    print_identification(report, as_json=as_json)
    if report.failed:
        raise typer.Exit(1)


def _bounds(text: str | None, record: IdentifierRecord) -> dict[int, tuple[float, float]] | None:
    """Read --bounds, a row for each parameter of the identifier; None: those of the scenario."""
    if text is None:
        return None
    from cosim.scenario.document.document import parse_value
    from cosim.scenario.kinds.identified_plant import bounds_of

    return bounds_of(parse_value(text), record.identified.parameters)
