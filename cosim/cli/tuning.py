"""The command that tunes a scenario."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import typer

from cosim import completion
from cosim.cli.options import (
    JsonOption,
    MapOption,
    QuietOption,
    SetOption,
    StopOption,
    SwapOption,
    check_out,
    print_notice,
    prints_to_stderr,
    read_edits,
    read_unique_pairs,
)
from cosim.cli.stopping import stopped_text
from cosim.errors import UsageError, option, quoted
from cosim.report.printable import printable
from cosim.terminal import show_members


class SearchMethod(StrEnum):
    """How the best values are searched."""

    COBYQA = "cobyqa"
    NELDER_MEAD = "nelder-mead"
    GLOBAL = "global"
    OPTUNA = "optuna"


def tune(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="A shipped scenario by name, a .toml file, or a log (.mcap) to replay.",
            autocompletion=completion.complete_scenario,
        ),
    ],
    minimize: Annotated[
        str | None,
        typer.Option(metavar="METRIC", help="Metric to minimize: 'rms(observer.delta - delta.y)'."),
    ] = None,
    maximize: Annotated[
        str | None, typer.Option(metavar="METRIC", help="Metric to maximize instead.")
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="Parameter and its range: observer.filter_rate=log:10:1e4, plant.R=0.5:2; with "
            "optuna also lists: plant=[a.fmu,b.fmu]. Repeatable.",
        ),
    ] = None,
    members: Annotated[int, typer.Option(metavar="N", help="Largest number of runs.")] = 200,
    method: Annotated[
        SearchMethod,
        typer.Option(
            help="cobyqa and nelder-mead: local search from several starts; global: differential"
            " evolution; optuna: model-based search."
        ),
    ] = SearchMethod.COBYQA,
    starts: Annotated[
        int, typer.Option(metavar="N", help="Starting points of a local search.")
    ] = 4,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Seed of starting points and random samples.")
    ] = 1,
    standard_errors: Annotated[
        bool,
        typer.Option(
            "--standard-errors",
            help="Standard errors of the values, if the metric is the rms of a residual.",
        ),
    ] = False,
    samples: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Number of independent samples of the residual; default: all of them, or "
            "what colored noise leaves of them.",
        ),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Dataset of all runs; its runs are not repeated."
        ),
    ] = None,
    new: Annotated[
        bool, typer.Option("--new", help="Delete the existing dataset and start again.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="Parallel processes; default: one per processor."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run trials on a dask.distributed cluster, such as tcp://host:8786 (methods "
            "global and optuna, which run many at a time).",
        ),
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Wall time limit of a run [s].")
    ] = None,
    replay: Annotated[
        list[str] | None,
        typer.Option(metavar="LOG", help="Log to replay in every trial."),
    ] = None,
    allow_code: Annotated[
        bool,
        typer.Option(
            "--allow-code",
            help="Run user code in replays, as 'cosim replay --allow-code' does.",
        ),
    ] = False,
    changes: SetOption = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Search for the parameters with the best metric.

    A stopped tuning resumes when started again with the same --out.
    """
    import json

    from cosim.studies.show import tuning_lines
    from cosim.studies.tuning import tune as run_tuning

    check_out(out)
    if quiet and out is None and not as_json:
        raise UsageError("--quiet without --out would show and keep nothing; add --out or --json")
    with prints_to_stderr(), show_members(quiet or as_json) as progress:
        try:
            result = run_tuning(
                scenario,
                minimize=minimize,
                maximize=maximize,
                vary=_variations(vary or []),
                members=members,
                method=method.value,
                starts=starts,
                seed=seed,
                standard_errors=standard_errors,
                samples=samples,
                replay=replay,
                allow_code=allow_code,
                out=out,
                new=new,
                workers=workers,
                scheduler=scheduler,
                timeout=timeout,
                set=read_edits(changes, {"scenario.stop": stop}),
                swap=read_unique_pairs(swaps, "swap"),
                map=read_unique_pairs(maps, "map"),
                progress=progress,
                notice=None if quiet else print_notice,
            )
        except KeyboardInterrupt:
            if out is not None:
                typer.echo(printable(stopped_text(out, new=new)), err=True)
            raise
    if as_json:
        typer.echo(json.dumps(result.to_dict(), indent=2))
    elif not quiet:
        for line in tuning_lines(result):
            typer.echo(printable(line))
    if result.best is None:
        raise typer.Exit(1)


def _variations(texts: list[str]) -> dict[str, Any]:
    """Read KEY=LOWER:UPPER, KEY=log:LOWER:UPPER, KEY=V1,V2,... of --vary."""
    return {key: _variation(key, text) for key, text in read_unique_pairs(texts, "vary").items()}


def _variation(key: str, text: str) -> Any:
    from cosim.studies.variations import read_vary_option

    parts = [part.strip() for part in text.split(":")]
    form = parts.pop(0) if parts[0] in ("log", "linear") else "linear"
    try:
        lower, upper = (float(part) for part in parts)
        return {form: [lower, upper]}
    except ValueError:
        pass
    try:
        values = read_vary_option(text)
    except UsageError as error:
        raise UsageError(f"{option('vary', key)}: {error}") from error
    if not isinstance(values, list) or len(values) < 2:
        raise UsageError(
            f"{option('vary', key)}: expected LOWER:UPPER, log:LOWER:UPPER or comma-separated "
            f"values, got {quoted(text)}"
        )
    return values
