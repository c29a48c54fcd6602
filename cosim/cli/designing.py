"""The command that designs an experiment."""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.cli.options import JsonOption, ScenarioArgument, SetOption, prints_to_stderr, read_edits
from cosim.errors import UsageError, option

NoiseOption = Annotated[
    str | None,
    typer.Option(
        metavar="D",
        help="Standard deviation of the noise of y, or [d0,d1] for several outputs; default:"
        " as given for the identifier, the observer or a sensor.",
    ),
]

ThetaOption = Annotated[
    str | None,
    typer.Option(
        metavar="[...]",
        help="True theta, in the order of the regressor's terms; default: that of the disturbance.",
    ),
]

LongestOption = Annotated[
    float | None,
    typer.Option(
        metavar="T",
        help="Longest delay to try [s]; default: a quarter of the run, or that of the scenario.",
    ),
]

InputOption = Annotated[bool, typer.Option("--input", help="Also rank other input amplitudes.")]


def design(
    scenario: ScenarioArgument,
    noise: NoiseOption = None,
    theta: ThetaOption = None,
    longest: LongestOption = None,
    with_input: InputOption = False,
    changes: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Rank experiment designs by the predicted error of theta.

    Ranks delays, filters, steps and windows relative to the Cramer-Rao bound of y, which the
    output-error method attains.
    """
    from cosim.report.tables.preparation import print_design
    from cosim.scenario.experiment_design.ranking import design as ranked

    edits = read_edits(changes)
    deviations = _numbers("noise", noise)
    values = _numbers("theta", theta)
    with prints_to_stderr():
        result = ranked(
            scenario, noise=deviations, theta=values, longest=longest, input=with_input, set=edits
        )
    print_design(result, as_json=as_json)


def _numbers(name: str, text: str | None) -> list[float] | None:
    """Read a number or a list of numbers."""
    if text is None:
        return None
    from cosim.scenario.document.document import parse_value

    value = parse_value(text)
    listed = value if isinstance(value, list) else [value]
    if any(isinstance(item, bool) or not isinstance(item, int | float) for item in listed):
        raise UsageError(f"{option(name)}: expected a number, or a list of numbers, got {text}")
    return [float(item) for item in listed]
