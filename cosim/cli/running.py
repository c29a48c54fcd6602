"""The command run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.collecting import start_collecting
from cosim.cli.failing import (
    AssertOption,
    FailOnOption,
    NoVerdictsOption,
    fail_if,
    read_assertions,
    read_fail_on,
)
from cosim.cli.options import (
    ForceOption,
    JsonOption,
    MapOption,
    PlotOption,
    QuietOption,
    ScenarioArgument,
    SetOption,
    StopOption,
    SwapOption,
    check_plot,
    given_values,
    print_notice,
    prints_to_stderr,
    read_edits,
    read_numbers,
    read_unique_pairs,
    run_in_child,
)
from cosim.cli.playing import (
    AllowHostOption,
    HostOption,
    LiveOption,
    PortOption,
    ShowOption,
    shown_live,
)
from cosim.errors import UsageError
from cosim.terminal import show_progress

if TYPE_CHECKING:
    from cosim.scenario.building.parsing import Scenario


BEGAN = perf_counter()

RunOutOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="PATH",
        help="Log to write (.mcap); default: logs/<scenario>.mcap, -2, -3, ...",
    ),
]

StepOption = Annotated[
    str | None,
    typer.Option(
        metavar="SECONDS",
        help="Communication step [s], or a fraction such as 1/60; the same as --set "
        "scenario.step=...",
    ),
]

ProfileOption = Annotated[
    bool, typer.Option("--profile", help="Show the wall time of each component.")
]

EmbedOption = Annotated[
    bool,
    typer.Option(
        "--embed",
        help="Embed the FMUs in the log, so that 'cosim replay LOG --rerun --allow-code' "
        "runs them from the log alone.",
    ),
]

CertifyOption = Annotated[
    bool,
    typer.Option(
        "--certify",
        help="Also run with half and a quarter of the step and estimate the time-step error "
        "of each signal. Takes seven times as long.",
    ),
]

FindStepOption = Annotated[
    list[str] | None,
    typer.Option(
        "--find-step",
        metavar="SIGNAL=TOLERANCE",
        help="Run with the largest step that keeps the time-step error of a signal within a "
        "tolerance, in the unit of the signal, such as observer.delta=1e-4; implies "
        "--certify, excludes --step. The search starts from the largest step that "
        "divides all times of the scenario. Repeatable.",
    ),
]

RealTimeOption = Annotated[
    float | None,
    typer.Option(
        "--realtime",
        metavar="FACTOR",
        help="Run at FACTOR times the pace of the wall clock, in blocks of about 10 ms, and "
        "report how late the run was.",
    ),
]

FlushOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Longest wall time until a row is written to the log; a killed run loses at "
        "most these rows. [default: 1.0]",
    ),
]

SyncOption = Annotated[
    bool,
    typer.Option(
        "--sync",
        help="Wait for the disk at every flush, so that the log survives a power failure.",
    ),
]

RotateOption = Annotated[
    str | None,
    typer.Option(
        metavar="LIMIT",
        help="Continue in a new file, x.part2.mcap, x.part3.mcap, ..., when the log reaches "
        "this size (B, kB, MB, GB, TB, KiB, MiB, GiB) or simulated time (s, min, h), "
        "such as 1GB or 1h. Each file opens on its own; 'cosim merge' joins them.",
    ),
]

DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Check the scenario and compare swapped components with the replaced ones; do "
        "not run. FMUs and Python classes are loaded and initialized, which runs their "
        "code, in a separate process.",
    ),
]


def run(
    scenario: ScenarioArgument,
    out: RunOutOption = None,
    force: ForceOption = False,
    changes: SetOption = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    step: StepOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    embed: EmbedOption = False,
    profile: ProfileOption = False,
    certify: CertifyOption = False,
    find_step: FindStepOption = None,
    realtime: RealTimeOption = None,
    live: LiveOption = False,
    host: HostOption = None,
    port: PortOption = None,
    allow_host: AllowHostOption = None,
    show: ShowOption = None,
    flush: FlushOption = None,
    sync: SyncOption = False,
    rotate: RotateOption = None,
    fail_on: FailOnOption = None,
    asserted: AssertOption = None,
    no_verdicts: NoVerdictsOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Run a scenario and record every signal to an MCAP log."""
    from cosim.report.tables.logs import is_rotated, print_rotated
    from cosim.report.tables.run import print_summary
    from cosim.scenario.running.execution import load
    from cosim.scenario.running.execution import run as run_scenario

    failures = read_fail_on(fail_on, no_verdicts=no_verdicts)
    assertions = read_assertions(asserted)
    if dry_run:
        excluded = {"--certify": certify, "--find-step": find_step, "--fail-on": failures}
        _check_dry_run({**excluded, "--assert": asserted})
    if find_step and step is not None:
        raise UsageError("--find-step chooses the step itself; omit --step")
    if dry_run:
        options = {"--set": changes, "--swap": swaps, "--map": maps}
        numbers = given_values({"--stop": stop, "--step": step})
        options |= {name: [str(number)] for name, number in numbers.items()}
        run_in_child(["run", scenario, "--dry-run"], options, as_json=as_json)
    imported = perf_counter()
    with prints_to_stderr():
        edited = load(scenario).edit(
            swap=read_unique_pairs(swaps, "swap"),
            map=read_unique_pairs(maps, "map"),
            set=read_edits(
                changes,
                {
                    "scenario.stop": stop,
                    "scenario.step": None if step is None else _number_or_text(step),
                    "scenario.verdicts": False if no_verdicts else None,
                },
            ),
        )
    start_collecting()
    if dry_run:
        _dry_run(edited, as_json=as_json)
        return
    if force and out is None:
        raise UsageError("--force replaces the log at --out; give --out too")
    path = out or Path("logs") / f"{edited.name}.mcap"
    check_plot(plot, out)
    if rotate is not None:
        _check_rotated(plot, profile=profile)
    seconds: dict[str, float] | None = {} if profile else None
    with (
        shown_live(live, host, port, allow_host, show) as server,
        show_progress(quiet or as_json) as progress,
        prints_to_stderr(),
    ):
        view = None if assertions is None else assertions.view(server)
        log = run_scenario(
            edited,
            out=path,
            force=force,
            numbered=out is None,
            progress=progress,
            notice=None if quiet else print_notice,
            embed=embed,
            profile=seconds,
            certify=certify,
            find_step=read_numbers(find_step, "find-step"),
            realtime=realtime,
            live=view or server,
            flush=flush,
            sync=sync,
            rotate=rotate,
        )
    wall = {"imports": imported - BEGAN, "run": perf_counter() - imported}
    if plot is not None:
        from cosim.report.plots.runs import plot_run

        plot_run(log, plot)
    if rotate is not None and is_rotated(log):
        print_rotated(log, wall=wall, as_json=as_json, quiet=quiet)
    else:
        print_summary(log, wall=wall, profile=seconds, as_json=as_json, quiet=quiet)
    fail_if(log, failures, view, quiet=quiet)


def _check_dry_run(excluded: Mapping[str, object]) -> None:
    """Check that nothing is asked for beside a dry run that only a run shows."""
    for name, value in excluded.items():
        if value:
            raise UsageError(f"--dry-run runs nothing; omit it or {name}")


def _check_rotated(plot: Path | None, *, profile: bool) -> None:
    """Check that nothing is asked for that is shown of a log of one file only."""
    if plot is not None or profile:
        name = "--profile" if plot is None else "--plot"
        raise UsageError(f"{name} needs a log in one file; omit it or --rotate")


def _number_or_text(step: str) -> float | str:
    """Return a step as it would be in a file: a fraction is a text there."""
    try:
        return float(step)
    except ValueError:
        return step


def _dry_run(scenario: Scenario, *, as_json: bool) -> None:
    """Show what a run says before its first step, and how swapped components compare.

    Raises
    ------
    UsageError
        If the scenario cannot run with them.
    """
    from cosim.report.tables.preparation import print_dry_run
    from cosim.scenario.recordings.swap_comparison import dry_run

    with prints_to_stderr():
        reports = dry_run(scenario)
    print_dry_run(reports, as_json=as_json)
    if reports.refusals:
        raise UsageError("\n".join([*reports.refusals, *reports.hints]))
