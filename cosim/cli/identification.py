"""The commands identify and design."""

from __future__ import annotations

from time import perf_counter

import cosim
from cosim.cli.command import Given, command
from cosim.cli.options import check_plot, prints_to_stderr, shared
from cosim.errors import UsageError
from cosim.report.printable import print_notice
from cosim.terminal import show_count


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
    from cosim.scenario.kinds.identified_plant import bounds_of, irregular_part
    from cosim.scenario.running.identifying import identifier_record, identify_records

    irregular = given.irregular
    if irregular is not None and not 0.0 < irregular < float("inf"):
        raise UsageError(f"--irregular: expected a positive number, got {irregular:g}")
    check_plot(given.plot)
    records = [identifier_record(cosim.open_log(log), given.component) for log in given.logs]
    others = [identifier_record(cosim.open_log(log), given.component) for log in given.validate]
    bounds = None
    if given.bounds is not None:
        bounds = bounds_of(parse_value(given.bounds), records[0].identified.parameters)
    identification = identify_records(records, offset=given.offset, bounds=bounds)
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
