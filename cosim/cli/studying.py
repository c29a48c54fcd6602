"""The command study: many runs of one scenario, and what they came to."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from cosim import completion
from cosim.cli.contents import SizeOption, TitleOption, read_size
from cosim.cli.failing import (
    OF_VERDICTS,
    AssertOption,
    FailOnOption,
    fail_if_members,
    read_assertions,
    read_fail_on,
)
from cosim.cli.once import OnceCommand
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

if TYPE_CHECKING:
    from cosim.studies.show import ShownParts


class StudyCommands(TyperGroup):
    """The commands of ``cosim study``; what is none of them is a study to run."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put ``run`` before a study."""
        if args and args[0] not in self.commands and args[0] not in ("--help",):
            args = ["run", *args]
        return super().parse_args(ctx, args)


study = typer.Typer(
    cls=StudyCommands,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Run a scenario many times with varied values.\n\n"
    "Also shows, verifies and plots the results. 'cosim study STUDY' is 'cosim study run STUDY'.",
)

DatasetArgument = Annotated[
    str, typer.Argument(metavar="DIR", help="The dataset of a study: a folder, or a URL.")
]

VariationsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--vary",
        metavar="COMPONENT.PARAMETER=VALUES",
        autocompletion=completion.complete_setting,
        help="Vary a key over a grid, such as observer.filter_rate=log:10:1e4:25, "
        "linear:0:1:11 or 1,2,3, a distribution, such as uniform:0:1, normal:0:0.1 or "
        "tolerance:0.05, or over plants, plant=[a.fmu,b.fmu]. Repeatable: grids are "
        "combined, distributions sampled jointly.",
    ),
]

MetricOption = Annotated[
    list[str] | None,
    typer.Option(
        "--metric",
        metavar="NAME=EXPRESSION",
        help="Metric of every member, such as error='rms(observer.delta - delta.y)'; "
        "default: the results of the run. Repeatable.",
    ),
]


@study.command("run", cls=OnceCommand)
def run(
    source: Annotated[
        str,
        typer.Argument(
            metavar="STUDY",
            help="A study file (.toml with [study]), a scenario (.toml or the name of a shipped "
            "one), or a log (.mcap) to replay.",
            autocompletion=completion.complete_scenario,
        ),
    ],
    out: Annotated[
        str | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="Folder of the dataset, or a URL such as s3://bucket/x; default: "
            "logs/<name>-study.",
        ),
    ] = None,
    vary: VariationsOption = None,
    metric: MetricOption = None,
    samples: Annotated[
        int | None, typer.Option(help="Number of samples of the distributions.")
    ] = None,
    sampling: Annotated[
        str | None,
        typer.Option(help="random (default), latin-hypercube, sobol, or saltelli."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of all random numbers. [default: 0]")
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(help="Number of seeds for each noise source.")
    ] = None,
    cases: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Table of members (.csv, .xlsx, ...), one column per key."
        ),
    ] = None,
    replay: Annotated[
        list[str] | None,
        typer.Option(metavar="LOG", help="Logs to replay, such as 'field-*.mcap'. Repeatable."),
    ] = None,
    allow_code: Annotated[
        bool | None,
        typer.Option(
            "--allow-code",
            help="Run user code in replays: recompute components of kind python, as 'cosim "
            "replay --allow-code' does.",
        ),
    ] = None,
    changes: SetOption = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    results: Annotated[
        bool | None,
        typer.Option(
            "--results/--no-results",
            help="Also keep the results of the run: estimates, errors, verdicts.",
        ),
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(
            metavar="MEMBERS",
            help="Keep the logs of these members: failed, all, 'worst 5 of METRIC', 'best 5 of "
            "METRIC', or numbers, such as 3,14.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Parallel processes. [default: one per processor]")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run members on a dask.distributed cluster, such as tcp://host:8786.",
        ),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Wall time limit of a member [s]. [default: 10 times the longest of the first "
            "members, at least 60 s]",
        ),
    ] = None,
    new: Annotated[
        bool, typer.Option("--new", help="Delete the existing dataset and start again.")
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Check everything, time a few members and estimate the duration; record nothing.",
        ),
    ] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    fail_on: FailOnOption = None,
    asserted: AssertOption = None,
) -> None:
    """Run a study, or its missing members.

    Members run in separate processes: a crash or hang affects only that member. The same command
    resumes a stopped study and runs new members of one that was extended. Exit 1 if a member
    failed. A metric of --assert that has no name is kept as one of the study.
    """
    from cosim.studies.show import ShownParts
    from cosim.studies.study_file import StudyOptions, read_study
    from cosim.studies.studying import default_place
    from cosim.studies.studying import study as run_study

    check_out(out)
    failures = read_fail_on(fail_on)
    if dry_run and (failures or asserted):
        name = "--fail-on" if failures else "--assert"
        raise UsageError(f"--dry-run completes no member that could fail; omit it or {name}")
    with prints_to_stderr():
        options = StudyOptions(
            vary=_variations(vary),
            metrics=read_unique_pairs(metric, "metric"),
            set=read_edits(changes, {"scenario.stop": stop}),
            swap=read_unique_pairs(swaps, "swap"),
            map=read_unique_pairs(maps, "map"),
            replay=replay,
            allow_code=allow_code,
            cases=cases,
            sampling=sampling,
            samples=samples,
            seed=seed,
            seeds=seeds,
            timeout=timeout,
            keep=_kept(keep),
            results=results,
        )
        file = read_study(source).with_options(options)
        assertions = read_assertions(asserted, file.metrics)
        if assertions is not None:
            with_results = file.subject.with_results
            kept = StudyOptions(metrics=assertions.metrics, results=with_results)
            file = file.with_options(kept)
    if not (OF_VERDICTS.isdisjoint(failures) or file.subject.with_results):
        raise UsageError(f"--fail-on {','.join(sorted(OF_VERDICTS & failures))} needs --results")
    place = str(default_place(file)) if out is None else out
    if dry_run:
        if scheduler is not None:
            raise UsageError(
                "--dry-run and --scheduler: --dry-run measures workers on this machine; omit "
                "--scheduler"
            )
        _dry_run(file, workers, None if new else place, as_json=as_json)
        return
    with prints_to_stderr(), show_members(quiet or as_json) as progress:
        try:
            done = run_study(
                file,
                out=place,
                workers=workers,
                scheduler=scheduler,
                new=new,
                progress=progress,
                keep_progress=None if progress is None else partial(progress, what="logs"),
                notice=None if quiet else print_notice,
            )
        except KeyboardInterrupt:
            typer.echo(printable(stopped_text(place, new=new)), err=True)
            raise
    if not quiet:
        _show(place, ShownParts(as_json=as_json))
    if failures or assertions is not None:
        fail_if_members(done, failures, assertions)
    if done.failures:
        raise typer.Exit(1)


def _variations(texts: list[str] | None) -> dict[str, Any]:
    """Return what is varied, by key."""
    from cosim.studies.variations import read_vary_option

    variations = {}
    for key, text in read_unique_pairs(texts, "vary").items():
        try:
            variations[key] = read_vary_option(text)
        except UsageError as error:
            raise UsageError(f"{option('vary', key)}: {error}") from error
    return variations


def _kept(text: str | None) -> str | list[int] | None:
    """Return which logs are kept: numbers, or a text."""
    if text is None or not text.replace(",", "").replace(" ", "").isdigit():
        return text
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise UsageError(
            f"{option('keep')}: expected comma-separated numbers, got {quoted(text)}"
        ) from error


def _dry_run(file: Any, workers: int | None, place: str | None, *, as_json: bool) -> None:
    """Print what a study will take; ``place``: where it would go on."""
    from cosim.studies.plan import plan_study
    from cosim.studies.show import print_estimate
    from cosim.studies.studying import check_place, estimate_study, worker_count

    with prints_to_stderr():
        plan = plan_study(file)
        for text in plan.notices:
            print_notice(text)
        check_place(plan, place)
        estimate = estimate_study(plan, worker_count(workers))
    print_estimate(file.name, estimate, as_json=as_json)


@study.command("show", cls=OnceCommand)
def show(
    place: DatasetArgument,
    member: Annotated[
        int | None,
        typer.Option(
            metavar="NUMBER",
            help="Show everything about one member, with the command that runs it.",
        ),
    ] = None,
    metrics: Annotated[
        list[str] | None,
        typer.Option(
            "--metric",
            metavar="NAME",
            help="Show all statistics of a metric, with confidence intervals. Repeatable.",
        ),
    ] = None,
    conditions: Annotated[
        list[str] | None,
        typer.Option(
            "--pass",
            metavar="CONDITION",
            help="Show the share of members that pass, such as 'error < 0.1'. Repeatable.",
        ),
    ] = None,
    by: Annotated[
        str,
        typer.Option(metavar="KEY", help="Show statistics for each value of a varied key."),
    ] = "",
    sobol: Annotated[
        bool, typer.Option("--sobol", help="Show Sobol indices (sampling saltelli).")
    ] = False,
    worst: Annotated[
        int,
        typer.Option(
            help="Number of members to list: those with the largest values; of a tuning, the best."
        ),
    ] = 3,
    as_json: JsonOption = False,
) -> None:
    """Show the results of a study, also while it runs."""
    from cosim.studies.show import ShownParts

    parts = ShownParts(
        member,
        tuple(metrics or ()),
        tuple(conditions or ()),
        by=by,
        sobol=sobol,
        worst=worst,
        as_json=as_json,
    )
    _print_warnings(_show(place, parts))


def _show(place: str, parts: ShownParts) -> tuple[str, ...]:
    """Show parts of a study; return what was not known of it when it was planned."""
    from cosim.studies.plan import RecordedStudy
    from cosim.studies.show import show_study
    from cosim.studies.study import open_study

    opened = open_study(place)
    recorded = RecordedStudy.read(opened.text)
    show_study(opened, recorded.layout, recorded.command_of(opened), parts, search=recorded.search)
    return recorded.warnings


def _print_warnings(texts: Iterable[str]) -> None:
    for text in texts:
        print_notice(f"warning: {text}")


@study.command("verify", cls=OnceCommand)
def verify(
    place: DatasetArgument,
    members: Annotated[
        list[int] | None,
        typer.Option("--member", metavar="NUMBER", help="Member to run again. Repeatable."),
    ] = None,
    sample: Annotated[
        int | None,
        typer.Option(
            help="Number of members to run again, spread evenly. [default: 10 if no --member is "
            "given]"
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Parallel processes. [default: one per processor]")
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run members again, each alone, and compare bit for bit.

    Each member runs with the parameters of its row, as with 'cosim run' or 'cosim replay'. Refused
    if the scenario, FMUs, tables or metrics have changed (SHA-256). Exit 1 if a metric, the status
    or the steps of a member differ.
    """
    from cosim.studies.show import print_verification
    from cosim.studies.studying import worker_count
    from cosim.studies.verifying import verify_study

    with prints_to_stderr(), show_members(quiet or as_json) as progress:
        found = verify_study(
            place,
            members=members or (),
            sample=sample,
            workers=worker_count(workers),
            progress=progress,
        )
    if not quiet:
        print_verification(found, as_json=as_json)
    if found.differences:
        raise typer.Exit(1)


@study.command("plot", cls=OnceCommand)
def plot(
    place: DatasetArgument,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="Picture to write (.png, .svg, .pdf)."),
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            help="histogram, distribution, convergence, line, map, scatter, sobol or search; "
            "default: by the design of the study."
        ),
    ] = None,
    metrics: Annotated[
        list[str] | None,
        typer.Option("--metric", metavar="NAME", help="Metric to draw; default: all. Repeatable."),
    ] = None,
    keys: Annotated[
        list[str] | None,
        typer.Option("--key", metavar="KEY", help="Varied key to show. Repeatable."),
    ] = None,
    size: SizeOption = None,
    title: TitleOption = None,
) -> None:
    """Plot the results of a study."""
    from cosim.report.plots.picture import PictureOptions
    from cosim.studies.layout import results_of_study
    from cosim.studies.plan import RecordedStudy
    from cosim.studies.plots import plot_study
    from cosim.studies.study import open_study

    opened = open_study(place)
    recorded = RecordedStudy.read(opened.text)
    results = results_of_study(opened, recorded.layout)
    plot_study(
        results,
        out,
        kind=kind,
        metrics=metrics or (),
        keys=keys or (),
        options=PictureOptions(read_size(size), title=title),
        search=recorded.search,
    )
    typer.echo(printable(str(out)))
