"""The commands that run scenarios: run, replay and compare."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final

import cosim
from cosim.cli.command import Given, command, start_collecting
from cosim.cli.options import (
    check_plot,
    check_verdicts,
    has_failed,
    live_server,
    prints_to_stderr,
    read_assertions,
    run_in_child,
    shared,
)
from cosim.errors import UsageError, option
from cosim.options import STEP_IS_CHOSEN, Rule
from cosim.report.printable import print_notice
from cosim.terminal import show_progress

if TYPE_CHECKING:
    from cosim.live import LiveServer
    from cosim.report.comparing import Comparison
    from cosim.studies.measuring import AssertedView

BEGAN: Final = perf_counter()

RUN: Final = {
    **shared("scenario"),
    "--out -o PATH : Path": "Log to write (.mcap); default: logs/<scenario>.mcap, -2, -3, ...",
    **shared("force set swap map stop"),
    "--step SECONDS : step": "Communication step [s], or a fraction such as 1/60; the same as "
    "--set scenario.step=...",
    **shared("plot json quiet"),
    "--embed": "Embed the FMUs in the log, so that 'cosim replay LOG --rerun --allow-code' runs "
    "them from the log alone.",
    "--profile": "Show the wall time of each component.",
    "--certify": "Also run with half and a quarter of the step and estimate the time-step error of "
    "each signal. Takes seven times as long.",
    "--find-step SIGNAL=TOLERANCE : numbers": "Run with the largest step that keeps the time-step "
    "error of a signal within a tolerance, in the unit of the signal, such as "
    "observer.delta=1e-4; implies --certify, excludes --step. The search starts from the largest "
    "step that divides all times of the scenario. Repeatable.",
    "--realtime FACTOR : float": "Run at FACTOR times the pace of the wall clock, in blocks of "
    "about 10 ms, and report how late the run was.",
    "--live": "Stream the run to Foxglove or Lichtblick in addition to the log; with --realtime "
    "at the pace of the wall clock.",
    **shared("viewers"),
    "--show SIGNAL : list[str]": "With --live: component, signal or pattern to stream; default: "
    "all. Repeatable.",
    "--flush SECONDS : float": "Longest wall time until a row is written to the log; a killed run "
    "loses at most these rows. [default: 1.0]",
    "--sync": "Wait for the disk at every flush, so that the log survives a power failure.",
    "--rotate LIMIT : str": "Continue in a new file, x.part2.mcap, x.part3.mcap, ..., when the log "
    "reaches this size (B, kB, MB, GB, TB, KiB, MiB, GiB) or simulated time (s, min, h), such as "
    "1GB or 1h. Each file opens on its own; 'cosim merge' joins them.",
    **shared("failing no-verdicts"),
    "--dry-run": "Check the scenario and compare swapped components with the replaced ones; do "
    "not run. FMUs and Python classes are loaded and initialized, which runs their code, in a "
    "separate process.",
}
REPLAY: Final = {
    **shared("log"),
    "--verify": "Check the content hash of the log and compare everything recomputed with the "
    "log: every signal bit for bit, and the records of the run (truth, connections, schedule, "
    "times, component tables, designs, overrides, substeps, warnings, last row, verdicts). Shows "
    "the first difference of each component; exit 1 if there is one. Logs are not signed: "
    "replacing one by the log of another run is not detected.",
    "--allow-code": "Run user code: recompute components of kind python from their classes, found "
    "in this folder or on sys.path, instead of taking them from the log. Their sources must be "
    "those of the run. With --rerun also run FMUs.",
    "--rerun": "Also recompute plants, so that --verify covers them: models and, with "
    "--allow-code, FMUs, taken from the log (run --embed) or from their original paths and "
    "checked by SHA-256. Without both flags no FMU runs.",
    "--from T0 : float": "Record, or compare with --verify, only from this communication point on "
    "[s]. The replay still computes from the start, as logs contain no internal states.",
    "--to T1 : float": "Record, or compare, only up to this communication point [s]; the replay "
    "ends there.",
    "--component NAME : list[str]": "Recompute only this component and take the others from the "
    "log. Repeatable.",
    "--scenario SCENARIO : scenario = None": "Scenario for a recording of another tool: a shipped "
    "scenario by name, or a .toml file. Components named by --map are taken from the recording.",
    **shared("out force set"),
    "--vary COMPONENT.PARAMETER=V1,V2,... : variations": "Replay with each of these values, or "
    "of a grid such as log:10:1e3:5, and print a table of the results. Repeatable: all "
    "combinations, at most 1000. All are checked before the first one runs. Logs are only written "
    "with --out FOLDER.",
    **shared("swap map stop plot json quiet failing no-verdicts"),
}
COMPARE: Final = {
    **shared("scenario"),
    "--swap COMPONENT=PATH : alternatives": "An alternative for a component: x.fmu, x.fmu#me, "
    "x.fmu#cs, a recorded log (.mcap) or time-stamped samples (.csv, .xlsx, ...). Repeatable.",
    "--estimators all|METHOD,... : estimators": "Methods of the identifier, each on the same "
    "recorded data. Repeatable.",
    **shared("map set"),
    "--base/--no-base : bool = True": "Also run the scenario's own component, as the reference.",
    "--plot FILE : Path": "Plot the estimates of all runs and their differences.",
    "--out -o DIR : Path": "Folder for the logs.",
    **shared("force json"),
}
VERDICTS: Final = "verdicts; omit --no-verdicts"


@command(
    RUN,
    Rule("dry_run", "runs nothing", excludes="certify find_step fail_on assert_"),
    STEP_IS_CHOSEN,
    Rule("force", "replaces the log at a path", needs="out"),
    Rule("plot profile", "needs a log in one file", excludes="rotate"),
    Rule("host port allow_host show", "is about viewers of the run", needs="live"),
)
def run(given: Given) -> bool:
    """Run a scenario and record every signal to an MCAP log."""
    from cosim.report.tables.logs import is_rotated, show_rotated
    from cosim.report.tables.run import print_summary
    from cosim.scenario.running.execution import load
    from cosim.scenario.running.execution import run as run_scenario

    check_verdicts(given.fail_on, not given.no_verdicts, VERDICTS)
    assertions = read_assertions(given.assert_)
    if given.dry_run:
        run_in_child(given.arguments)
    imported = perf_counter()
    with prints_to_stderr():
        scenario = load(given.scenario).edit(**given.only("set swap map"))
    start_collecting()
    if given.dry_run:
        from cosim.report.tables.preparation import show_dry_run
        from cosim.scenario.recordings.swap_comparison import dry_run

        with prints_to_stderr():
            reports = dry_run(scenario)
        given.print_shown(show_dry_run(reports))
        if reports.refusals:
            raise UsageError("\n".join([*reports.refusals, *reports.hints]))
        return False
    check_plot(given.plot, given.out)
    shown = {"as_json": given.json, "quiet": given.quiet}
    profile: dict[str, float] | None = {} if given.profile else None
    server: LiveServer | None = None
    with ExitStack() as resources:
        if given.live:
            server = resources.enter_context(live_server(given, given.show, print_notice))
        progress = resources.enter_context(show_progress(given.quiet or given.json))
        resources.enter_context(prints_to_stderr())
        view = None if assertions is None else assertions.view(server)
        log = run_scenario(
            scenario,
            out=given.out or Path("logs") / f"{scenario.name}.mcap",
            numbered=given.out is None,
            progress=progress,
            notice=None if given.quiet else print_notice,
            profile=profile,
            live=view or server,
            **given.only("force embed certify find_step realtime flush sync rotate"),
        )
    wall = {"imports": imported - BEGAN, "run": perf_counter() - imported}
    _draw(log, given.plot)
    if given.rotate is not None and is_rotated(log):
        if given.json or not given.quiet:
            given.print_shown(show_rotated(log, wall))
    else:
        print_summary(log, wall=wall, profile=profile, **shown)
    return has_failed(_failures(log, given, view))


@command(
    REPLAY,
    Rule("verify plot fail_on assert_", "is for one replay", excludes="vary"),
    Rule("assert_", "is of the whole replay", excludes="from_ to"),
)
def replay(given: Given) -> bool:
    """Run the scenario of a log again on its recorded plant.

    Needs only the log; for a recording of another tool also --scenario and --map.
    """
    from cosim.log import Log
    from cosim.report.tables.run import print_summary
    from cosim.scenario.recordings.replay_request import ReplayRequest
    from cosim.scenario.running.replay import replayed_once, replays_of

    start_collecting()
    imported = perf_counter()
    if given.verify and "scenario.stop" in given.set:
        stop = option("set", "scenario.stop")  # or --stop, where that set it
        raise UsageError(f"--verify compares the whole log; omit {stop}")
    check_verdicts(given.fail_on, not given.no_verdicts, VERDICTS)
    assertions = read_assertions(given.assert_)
    span = (given.from_, given.to)
    with prints_to_stderr():
        request = ReplayRequest(
            window=None if span == (None, None) else span,
            components=given.component or None,
            **given.only("set swap map allow_code rerun scenario"),
        )
        replays = replays_of(given.log, request)
    if given.verify and not isinstance(replays.source, Log):
        raise UsageError(f"--verify compares with a log of cosim; {given.log} is of another tool")
    shown = {"as_json": given.json, "quiet": given.quiet}
    target = given.only("out force")
    if given.vary:
        from cosim.report.comparing import print_failures
        from cosim.studies.sweeping import show_sweep, sweep_of

        with show_progress(given.quiet or given.json) as progress, prints_to_stderr():
            sweep = sweep_of(replays, given.vary, progress=progress, **target)
        if given.json or not given.quiet:
            given.print_shown(show_sweep(sweep))
        print_failures((f"row {i}", row.problem) for i, row in enumerate(sweep.rows, start=1))
        return not sweep.passed
    check_plot(given.plot, given.out)
    notice = None if given.quiet else print_notice
    view = None if assertions is None else assertions.view()
    with ExitStack() as resources:
        with show_progress(given.quiet or given.json) as progress, prints_to_stderr():
            replayed = replayed_once(replays, progress=progress, notice=notice, live=view, **target)
            again = resources.enter_context(replayed)
        _draw(again, given.plot)
        if given.verify and isinstance(replays.source, Log):
            from cosim.report.tables.logs import show_verification
            from cosim.report.verification import verify

            designs = None if request.window is not None else replays.designs()
            verification = verify(replays.source, again, designs)
            given.print_shown(show_verification(verification, given.log, quiet=given.quiet))
            if not verification.passed:
                return True
        else:
            wall = {"imports": imported - BEGAN, "replay": perf_counter() - imported}
            print_summary(again, wall=wall, is_kept=given.out is not None, **shown)
        return has_failed(_failures(again, given, view))


def _draw(run: Any, plot: Path | None) -> None:
    if plot is not None:
        from cosim.report.plots.runs import plot_run

        plot_run(run, plot)


def _failures(run: Any, given: Given, view: AssertedView | None) -> Iterator[str]:
    """Yield why a run has failed: it has what --fail-on names, or does not fulfil an assertion."""
    for text, found in ({} if view is None else view.problems).items():
        yield f"{option('assert', text)}: {found}"
    if given.fail_on:
        from cosim.report.tables.run import failure_lines

        # where warnings have not been printed they are told here
        unsaid = given.quiet or getattr(given, "verify", False)
        yield from failure_lines(run, given.fail_on, quiet=unsaid)


@command(COMPARE)
def compare(given: Given) -> bool:
    """Run a scenario on several plants, or with several estimators.

    With --swap the scenario runs once for each plant; with --estimators every method gets the same
    recorded data. Exit 1 if one of them fails.
    """
    from cosim.report.comparing import EstimatorComparison, show_estimators, show_plants

    methods = [name.strip() for name in ",".join(given.estimators or ()).split(",")]
    several = [component for component, paths in given.swap.items() if len(paths) > 1]
    if given.estimators and not given.base:
        raise UsageError("--no-base is for plants; omit it with --estimators")
    if given.estimators and several:
        raise UsageError(
            f"--estimators: expected one plant, got several in --swap {several[0]}; "
            "compare plants and estimators one after the other"
        )
    if not (given.estimators or given.swap):
        raise UsageError("expected --swap or --estimators: what to compare")
    scenario = cosim.load(given.scenario)
    check_plot(given.plot, given.out)
    if given.plot is not None and not (given.estimators or scenario.file.truth):
        raise UsageError("the scenario has no [truth], so there are no estimates to plot")
    options = given.only("map set out force")
    comparison: Comparison | EstimatorComparison
    with prints_to_stderr():
        if given.estimators:
            comparison = cosim.compare_estimators(
                scenario,
                estimators=methods,
                swap={component: paths[0] for component, paths in given.swap.items()},
                **options,
            )
        else:
            comparison = cosim.compare(scenario, swap=given.swap, base=given.base, **options)
    if given.plot is not None and comparison.recordings:
        from cosim.report.plots.runs import plot_comparison

        plot_comparison(comparison, given.plot)
    if isinstance(comparison, EstimatorComparison):
        given.print_shown(show_estimators(comparison))
        return any(result.failure for result in comparison.results)
    given.print_shown(show_plants(comparison))
    return any(outcome.error for outcome in comparison.outcomes)
