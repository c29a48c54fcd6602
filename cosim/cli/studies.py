"""The commands study and tune: many runs of one scenario, and what they came to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from json import dumps
from typing import TYPE_CHECKING, Any, Final

import typer
from typer.core import TyperGroup

import cosim
from cosim.cli.command import Given, OnceCommand, command
from cosim.cli.options import (
    BAD_VERDICTS,
    check_verdicts,
    has_failed,
    prints_to_stderr,
    read_assertions,
    shared,
)
from cosim.errors import DatasetError, UsageError, listing, option, quoted
from cosim.options import Rule
from cosim.report.printable import print_notice, print_text
from cosim.terminal import ShownMembers, show_members

if TYPE_CHECKING:
    from cosim.studies.measuring import Assertions
    from cosim.studies.show import ShownParts
    from cosim.studies.study import Study

OF_STUDY: Final = (
    "vary set swap map replay allow_code cases sampling samples seed seeds timeout keep results"
)
OF_TUNING: Final = (
    "minimize maximize vary members method starts seed standard_errors samples out new workers "
    "scheduler timeout replay allow_code set swap map"
)

STUDY: Final = {
    "source STUDY : scenario": "A study file (.toml with [study]), a scenario (.toml or the name "
    "of a shipped one), or a log (.mcap) to replay.",
    "--out -o DIR : str": "Folder of the dataset, or a URL such as s3://bucket/x; default: "
    "logs/<name>-study.",
    "--vary COMPONENT.PARAMETER=VALUES : variations": "Vary a key over a grid, such as "
    "observer.filter_rate=log:10:1e4:25, linear:0:1:11 or 1,2,3, a distribution, such as "
    "uniform:0:1, normal:0:0.1 or tolerance:0.05, or over plants, plant=[a.fmu,b.fmu]. "
    "Repeatable: grids are combined, distributions sampled jointly.",
    "--metric NAME=EXPRESSION : pairs": "Metric of every member, such as "
    "error='rms(observer.delta - delta.y)'; default: the results of the run. Repeatable.",
    "--samples : int": "Number of samples of the distributions.",
    "--sampling : str": "random (default), latin-hypercube, sobol, or saltelli.",
    "--seed : int": "Seed of all random numbers. [default: 0]",
    "--seeds : int": "Number of seeds for each noise source.",
    "--cases FILE : Path": "Table of members (.csv, .xlsx, ...), one column per key.",
    "--replay LOG : list[str]": "Logs to replay, such as 'field-*.mcap'. Repeatable.",
    "--allow-code : bool": "Run user code in replays: recompute components of kind python, as "
    "'cosim replay --allow-code' does.",
    **shared("set swap map stop"),
    "--results/--no-results : bool": "Also keep the results of the run: estimates, errors, "
    "verdicts.",
    "--keep MEMBERS : members": "Keep the logs of these members: failed, all, 'worst 5 of METRIC', "
    "'best 5 of METRIC', or numbers, such as 3,14.",
    **shared("workers"),
    "--scheduler ADDRESS : str": "Run members on a dask.distributed cluster, such as "
    "tcp://host:8786.",
    "--timeout SECONDS : float": "Wall time limit of a member [s]. [default: 10 times the longest "
    "of the first members, at least 60 s]",
    **shared("new"),
    "--dry-run": "Check everything, time a few members and estimate the duration; record nothing.",
    **shared("json quiet failing"),
}
SHOW: Final = {
    **shared("dataset"),
    "--member NUMBER : int": "Show everything about one member, with the command that runs it.",
    "--metric NAME : list[str]": "Show all statistics of a metric, with confidence intervals. "
    "Repeatable.",
    "--pass CONDITION : list[str]": "Show the share of members that pass, such as 'error < 0.1'. "
    "Repeatable.",
    "--by KEY : str = ''": "Show statistics for each value of a varied key.",
    "--sobol": "Show Sobol indices (sampling saltelli).",
    "--worst : int = 3": "Number of members to list: those with the largest values; of a tuning, "
    "the best.",
    **shared("json"),
}
VERIFY: Final = {
    **shared("dataset"),
    "--member NUMBER : list[int]": "Member to run again. Repeatable.",
    "--sample : int": "Number of members to run again, spread evenly. [default: 10 if no --member "
    "is given]",
    **shared("workers json quiet"),
}
STUDY_PLOT: Final = {
    **shared("dataset picture"),
    "--kind : str": "histogram, distribution, convergence, line, map, scatter, sobol or search; "
    "default: by the design of the study.",
    "--metric NAME : list[str]": "Metric to draw; default: all. Repeatable.",
    "--key KEY : list[str]": "Varied key to show. Repeatable.",
    **shared("size title"),
}
TUNE: Final = {
    "scenario SCENARIO : scenario": "A shipped scenario by name, a .toml file, or a log (.mcap) to "
    "replay.",
    "--minimize METRIC : str": "Metric to minimize: 'rms(observer.delta - delta.y)'.",
    "--maximize METRIC : str": "Metric to maximize instead.",
    "--vary KEY=VALUES : ranges": "Parameter and its range: observer.filter_rate=log:10:1e4, "
    "plant.R=0.5:2; with optuna also lists: plant=[a.fmu,b.fmu]. Repeatable.",
    "--members N : int = 200": "Largest number of runs.",
    "--method cobyqa|nelder-mead|global|optuna : str = 'cobyqa'": "cobyqa and nelder-mead: local "
    "search from several starts; global: differential evolution; optuna: model-based search.",
    "--starts N : int = 4": "Starting points of a local search.",
    "--seed N : int = 1": "Seed of starting points and random samples.",
    "--standard-errors": "Standard errors of the values, if the metric is the rms of a residual.",
    "--samples N : int": "Number of independent samples of the residual; default: all of them, or "
    "what colored noise leaves of them.",
    "--out -o DIR : str": "Dataset of all runs; its runs are not repeated.",
    **shared("new"),
    "--workers N : int": "Parallel processes; default: one per processor.",
    "--scheduler ADDRESS : str": "Run trials on a dask.distributed cluster, such as "
    "tcp://host:8786 (methods global and optuna, which run many at a time).",
    "--timeout SECONDS : float": "Wall time limit of a run [s].",
    "--replay LOG : list[str]": "Log to replay in every trial.",
    "--allow-code": "Run user code in replays, as 'cosim replay --allow-code' does.",
    **shared("set swap map stop json quiet"),
}


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


@study.command("run", cls=OnceCommand)
@command(
    STUDY,
    Rule("dry_run", "completes no member that could fail", excludes="fail_on assert_"),
    Rule("dry_run", "measures workers on this machine", excludes="scheduler"),
)
def run(given: Given) -> bool:
    """Run a study, or its missing members.

    Members run in separate processes: a crash or hang affects only that member. The same command
    resumes a stopped study and runs new members of one that was extended. Exit 1 if a member
    failed. A metric of --assert that has no name is kept as one of the study.
    """
    from cosim.studies import studying
    from cosim.studies.plan import plan_study
    from cosim.studies.show import ShownParts, show_estimate
    from cosim.studies.study_file import StudyOptions, read_study

    _check_out(given.out)
    with prints_to_stderr():
        options = StudyOptions(metrics=given.metric, **given.only(OF_STUDY))
        file = read_study(given.source).with_options(options)
        assertions = read_assertions(given.assert_, file.metrics)
        if assertions is not None:
            with_results = file.subject.with_results
            kept = StudyOptions(metrics=assertions.metrics, results=with_results)
            file = file.with_options(kept)
    check_verdicts(given.fail_on, file.subject.with_results, "--results")
    place = str(studying.default_place(file)) if given.out is None else given.out
    if given.dry_run:
        with prints_to_stderr():
            plan = plan_study(file)
            for text in plan.notices:
                print_notice(text)
            studying.check_place(plan, None if given.new else place)
            estimate = studying.estimate_study(plan, studying.worker_count(given.workers))
        given.print_shown(show_estimate(file.name, estimate))
        return False
    with _resumable(place, given) as progress:
        done = cosim.study(
            file,
            out=place,
            progress=progress,
            keep_progress=None if progress is None else partial(progress, what="logs"),
            notice=None if given.quiet else print_notice,
            **given.only("workers scheduler new"),
        )
    if not given.quiet:
        _show(place, given, ShownParts())
    is_asked = given.fail_on or assertions is not None
    failures = _failures(done, given.fail_on, assertions) if is_asked else ()
    return has_failed(failures) or bool(done.failures)


def _check_out(place: str | None) -> None:
    """Check that a dataset is there when the command has ended.

    Raises
    ------
    UsageError
        If it is not.
    """
    if place is not None and place.startswith("memory://"):
        raise UsageError(
            f"{option('out')}: expected a folder, or a URL such as s3://bucket/x; {quoted(place)} "
            "is lost when this command ends"
        )


@contextmanager
def _resumable(place: str | None, given: Given) -> Iterator[ShownMembers | None]:
    """Give what shows the progress of members; where Ctrl-C stops them, say what there is."""
    with prints_to_stderr(), show_members(given.quiet or given.json) as progress:
        try:
            yield progress
        except KeyboardInterrupt:
            if place is not None:
                print_notice(stopped_text(place, new=given.new))
            raise


def stopped_text(place: str, *, new: bool) -> str:
    """Return what there is of a study that is stopped; ``new``: that was to begin anew."""
    from cosim.studies.dataset import StudyDataset

    try:
        if not StudyDataset.is_at(place):
            return "stopped before the first member was recorded"
        stopped = cosim.open_study(place)
    except DatasetError as error:
        return f"stopped; {error}"
    recorded = f"stopped: {len(stopped)} of {stopped.planned} members are recorded in {place}"
    if new:
        return (
            f"{recorded}; the same command without --new resumes from them, with --new deletes them"
        )
    return f"{recorded}; the same command resumes"


def _failures(
    study: Study, fail_on: frozenset[str], assertions: Assertions | None
) -> Iterator[str]:
    """Yield what the command fails on, and how many members have it."""
    metrics = {} if assertions is None else assertions.metrics
    verdicts: list[str] = []
    if not BAD_VERDICTS.keys().isdisjoint(fail_on):
        verdicts = [name for name in study.metrics if name.endswith(" verdict")]
    columns = list(dict.fromkeys(["member", "status", "warnings", *metrics, *verdicts]))
    found: dict[str, list[tuple[int, str]]] = {}
    for row in study.table(columns).to_pylist():
        if row["status"] != "complete":
            continue
        problems = {} if assertions is None else assertions.problems(row)
        own = [(option("assert", text), problem) for text, problem in problems.items()]
        if "warning" in fail_on and row["warnings"]:
            own.append((option("fail-on", "warning"), row["warnings"]))
        for verdict in (row[column] or "no verdict" for column in verdicts):
            for name, words in BAD_VERDICTS.items():
                if name in fail_on and any(word in verdict for word in words):
                    own.append((option("fail-on", name), verdict))
        for label, text in own:
            found.setdefault(label, []).append((row["member"], text))
    for label, members in found.items():
        numbers = listing([str(number) for number, _ in members])
        first, text = members[0]
        count = f"{len(members)} of {len(study)} members ({numbers})"
        yield f"{label}: {count}; member {first}: {text.partition(chr(10))[0]}"


@study.command("show", cls=OnceCommand)
@command(SHOW)
def show(given: Given) -> None:
    """Show the results of a study, also while it runs."""
    from cosim.studies.show import ShownParts

    parts = ShownParts(
        given.member,
        tuple(given.metric or ()),
        tuple(given.pass_ or ()),
        **given.only("by sobol worst"),
    )
    for text in _show(given.place, given, parts):
        print_notice(f"warning: {text}")


def _show(place: str, given: Given, parts: ShownParts) -> tuple[str, ...]:
    """Show parts of a study; return what was not known of it when it was planned."""
    from cosim.studies.plan import RecordedStudy
    from cosim.studies.show import show_study

    opened = cosim.open_study(place)
    recorded = RecordedStudy.read(opened.text)
    command_of = recorded.command_of(opened)
    shown = show_study(opened, recorded.layout, command_of, parts, search=recorded.search)
    given.print_shown(shown)
    return recorded.warnings


@study.command("verify", cls=OnceCommand)
@command(VERIFY)
def verify(given: Given) -> bool:
    """Run members again, each alone, and compare bit for bit.

    Each member runs with the parameters of its row, as with 'cosim run' or 'cosim replay'. Refused
    if the scenario, FMUs, tables or metrics have changed (SHA-256). Exit 1 if a metric, the status
    or the steps of a member differ.
    """
    from cosim.studies.show import show_verification
    from cosim.studies.studying import worker_count
    from cosim.studies.verifying import verify_study

    with prints_to_stderr(), show_members(given.quiet or given.json) as progress:
        found = verify_study(
            given.place,
            members=given.member or (),
            sample=given.sample,
            workers=worker_count(given.workers),
            progress=progress,
        )
    if not given.quiet:
        given.print_shown(show_verification(found))
    return bool(found.differences)


@study.command("plot", cls=OnceCommand)
@command(STUDY_PLOT)
def plot(given: Given) -> None:
    """Plot the results of a study."""
    from cosim.report.plots.picture import PictureOptions
    from cosim.studies.layout import results_of_study
    from cosim.studies.plan import RecordedStudy
    from cosim.studies.plots import plot_study

    opened = cosim.open_study(given.place)
    recorded = RecordedStudy.read(opened.text)
    plot_study(
        results_of_study(opened, recorded.layout),
        given.out,
        kind=given.kind,
        metrics=given.metric or (),
        keys=given.key or (),
        options=PictureOptions(given.size, title=given.title),
        search=recorded.search,
    )
    print_text(given.out)


@command(TUNE, Rule("quiet", "alone would show and keep nothing", needs="out json"))
def tune(given: Given) -> bool:
    """Search for the parameters with the best metric.

    A stopped tuning resumes when started again with the same --out.
    """
    from cosim.studies.show import tuning_lines

    _check_out(given.out)
    notice = None if given.quiet else print_notice
    with _resumable(given.out, given) as progress:
        options = given.only(OF_TUNING)
        result = cosim.tune(given.scenario, progress=progress, notice=notice, **options)
    if given.json:
        typer.echo(dumps(result.to_dict(), indent=2))
    elif not given.quiet:
        for line in tuning_lines(result):
            print_text(line)
    return result.best is None
