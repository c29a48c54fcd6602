"""The command that tunes a scenario."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.options import (
    JsonOption,
    MapOption,
    QuietOption,
    ScenarioArgument,
    SetOption,
    SwapOption,
    prints_to_stderr,
    read_edits,
    read_unique_pairs,
)
from cosim.errors import UsageError, option, quoted
from cosim.report.printable import printable
from cosim.terminal import show_members

if TYPE_CHECKING:
    from cosim.studies.tuning.space import BoundedKey, ChoiceKey


class SearchMethod(StrEnum):
    """How the best values are searched."""

    COBYQA = "cobyqa"
    NELDER_MEAD = "nelder-mead"
    GLOBAL = "global"
    OPTUNA = "optuna"


def tune(
    scenario: ScenarioArgument,
    minimize: Annotated[
        str | None,
        typer.Option(metavar="METRIC", help="What to minimize: 'rms(observer.delta - delta.y)'."),
    ] = None,
    maximize: Annotated[
        str | None, typer.Option(metavar="METRIC", help="What to maximize instead.")
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="What to vary, between which values: observer.filter_rate=log:10:1e4, "
            "plant.R=0.5:2; with optuna lists too: plant=[a.fmu,b.fmu]. Repeatable.",
        ),
    ] = None,
    members: Annotated[int, typer.Option(metavar="N", help="Runs at most.")] = 200,
    method: Annotated[
        SearchMethod,
        typer.Option(
            help="cobyqa and nelder-mead search locally from several starts, global by "
            "differential evolution, optuna by models of what was good."
        ),
    ] = SearchMethod.COBYQA,
    starts: Annotated[int, typer.Option(metavar="N", help="Starts of a local search.")] = 4,
    seed: Annotated[int, typer.Option(metavar="N", help="Of starts and random points.")] = 1,
    standard_errors: Annotated[
        bool,
        typer.Option(
            "--standard-errors", help="Standard errors of values fitted by the rms of a residual."
        ),
    ] = False,
    samples: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Independent samples of the residual; all that the rms has by default.",
        ),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Dataset of all runs; what it has is not run again."
        ),
    ] = None,
    new: Annotated[bool, typer.Option("--new", help="Begin the dataset anew.")] = False,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Processes; one a processor by default.")
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Wall time that a run may take.")
    ] = None,
    set_: SetOption = None,
    swap: SwapOption = None,
    map_: MapOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Search the parameters with the best metric.

    A tuning that was stopped goes on where it was when it is started again with the same --out.
    """
    import json

    from cosim.studies.tables.tuning import tuning_lines
    from cosim.studies.tuning.searching import TuningSearch
    from cosim.studies.tuning.space import SearchSpace
    from cosim.studies.tuning.tuning import TuningTask, tune_task

    search = TuningSearch(
        space=SearchSpace(tuple(_read_keys(vary or []))),
        objective="",
        maximize=maximize is not None,
        method=method.value,
        members=members,
        starts=starts,
        seed=seed,
        with_errors=standard_errors,
        samples=samples,
    )
    task = TuningTask(
        scenario=scenario,
        expression=_expression(minimize, maximize),
        search=search,
        set=read_edits(set_),
        swap=read_unique_pairs(swap or [], "swap"),
        map=read_unique_pairs(map_ or [], "map"),
    )
    with prints_to_stderr(), show_members(quiet or as_json) as progress:
        result = tune_task(
            task, out=out, new=new, workers=workers, timeout=timeout, progress=progress
        )
    if as_json:
        typer.echo(json.dumps(result.to_dict(), indent=2))
    elif not quiet:
        for line in tuning_lines(task, result):
            typer.echo(printable(line))
    if result.best is None:
        raise typer.Exit(1)


def _expression(minimize: str | None, maximize: str | None) -> str:
    """Return the metric.

    Raises
    ------
    UsageError
        If there is none, or two.
    """
    if (minimize is None) == (maximize is None):
        found = "neither" if minimize is None else "both"
        raise UsageError(f"found {found} of --minimize and --maximize, needed one of them")
    return minimize if minimize is not None else str(maximize)


def _read_keys(texts: list[str]) -> list[BoundedKey | ChoiceKey]:
    """Read KEY=LOWER:UPPER, KEY=log:LOWER:UPPER, KEY=V1,V2,... of --vary."""
    return [_read_key(key, text) for key, text in read_unique_pairs(texts, "vary").items()]


def _read_key(key: str, text: str) -> BoundedKey | ChoiceKey:
    from cosim.studies.document.variations import SWAP
    from cosim.studies.document.vary_option import read_vary_option
    from cosim.studies.tuning.space import BoundedKey, ChoiceKey

    parts = [part.strip() for part in text.split(":")]
    form = parts.pop(0) if parts[0] in ("log", "linear") else "linear"
    try:
        lower, upper = (float(part) for part in parts)
        return BoundedKey(key, lower, upper, form == "log")
    except ValueError:
        pass
    try:
        values = read_vary_option(text)
    except UsageError as error:
        raise UsageError(f"{option('vary', key)}: {error}") from error
    if not isinstance(values, list) or len(values) < 2:
        raise UsageError(
            f"{option('vary', key)}: found {quoted(text)}; needed LOWER:UPPER, log:LOWER:UPPER or "
            "values with a comma between them"
        )
    name = key if "." in key else f"{SWAP}{key}"
    return ChoiceKey(name, tuple(values))
