"""The command metrics: what a study keeps of a run, of a run that is recorded."""

from __future__ import annotations

import re
from typing import Annotated, Final

import typer

from cosim.cli.options import JsonOption, LogArgument, print_notice
from cosim.errors import CosimError, UsageError

# NAME=EXPRESSION; an expression may have == and >= in it
_NAMED: Final = re.compile(r"\s*([^()<>=!'\",]*[^()<>=!'\",\s])\s*=(?!=)(.*)", re.DOTALL)


def metrics(
    log: LogArgument,
    expressions: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=]EXPRESSION",
            help="Expressions as in [metrics] of a study, such as 'rms(observer.delta - delta.y,"
            " t > 5)'.",
        ),
    ] = None,
    study: Annotated[
        str | None,
        typer.Option(
            "--of", metavar="DIR", help="Compute the metrics of the study with this dataset."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute metrics of a log, with all digits.

    The values are bit for bit those of a study with this run.
    """
    from cosim.log.editing.joining import open_joined
    from cosim.report.tables.console import print_json, print_section
    from cosim.studies.metrics import missing_rows, parse_metrics

    texts = {} if study is None else _metrics_of(study, str(log))
    for text in expressions or []:
        named = _NAMED.fullmatch(text)
        name, expression = (text, text) if named is None else named.groups()
        if name in texts:
            raise UsageError(f"metric '{name}': given twice")
        texts[name] = expression.strip()
    if not texts:
        raise UsageError(
            "expected an expression, such as 'rms(plant.y)', or --of, the dataset of a study "
            "with metrics"
        )
    parsed = parse_metrics(texts)
    opened = open_joined(log)
    values = parsed.of(opened)
    lacking = missing_rows(parsed, opened)
    if lacking:
        print_notice(f"{lacking}; metrics of the whole run, as in a study, may differ")
    if as_json:
        print_json(values)
        return
    shown = {name: "no value" if value is None else repr(value) for name, value in values.items()}
    print_section("", shown)


def _metrics_of(place: str, log: str) -> dict[str, str]:
    """Return the metrics of a study by its dataset; notice a log that is none of its scenario."""
    from cosim.studies.dataset.study import open_study
    from cosim.studies.design.recorded_base import check_is_of_scenario
    from cosim.studies.document.scenario_of_study import load_scenario
    from cosim.studies.running.recorded_study import RecordedStudy

    study = RecordedStudy.read(open_study(place).text).study
    texts = dict(study.metrics)
    try:
        check_is_of_scenario(log, load_scenario(study.scenario))
    except CosimError as error:
        print_notice(f"these may not be metrics of a member of {place}: {error}")
    if not texts:
        raise UsageError(
            f"--of {place}: this study has no metrics, only results of runs; see 'cosim info LOG'"
        )
    return texts
