"""The command replay."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cosim import completion
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
    LogArgument,
    MapOption,
    OutOption,
    PlotOption,
    QuietOption,
    SetOption,
    StopOption,
    SwapOption,
    check_plot,
    print_notice,
    prints_to_stderr,
    read_edits,
    read_unique_pairs,
)
from cosim.cli.sweeping import read_variations
from cosim.errors import UsageError
from cosim.terminal import show_progress

if TYPE_CHECKING:
    from cosim.scenario.running.replay import Replays

BEGAN = perf_counter()

VerifyOption = Annotated[
    bool,
    typer.Option(
        "--verify",
        help="Check the content hash of the log and compare everything recomputed with the "
        "log: every signal bit for bit, and the records of the run (truth, connections,"
        " schedule, times, component tables, designs, overrides, substeps, warnings, last row, "
        "verdicts). Shows the first difference of each component; exit 1 if there is "
        "one. Logs are not signed: replacing one by the log of another run is not "
        "detected.",
    ),
]

AllowCodeOption = Annotated[
    bool,
    typer.Option(
        "--allow-code",
        help="Run user code: recompute components of kind python from their classes, found "
        "in this folder or on sys.path, instead of taking them from the log. Their "
        "sources must be those of the run. With --rerun also run FMUs.",
    ),
]

RerunOption = Annotated[
    bool,
    typer.Option(
        "--rerun",
        help="Also recompute plants, so that --verify covers them: models and, with --allow-"
        "code, FMUs, taken from the log (run --embed) or from their original paths and "
        "checked by SHA-256. Without both flags no FMU runs.",
    ),
]

WindowBeginOption = Annotated[
    float | None,
    typer.Option(
        "--from",
        metavar="T0",
        help="Record, or compare with --verify, only from this communication point on [s]. "
        "The replay still computes from the start, as logs contain no internal states.",
    ),
]

WindowEndOption = Annotated[
    float | None,
    typer.Option(
        "--to",
        metavar="T1",
        help="Record, or compare, only up to this communication point [s]; the replay ends there.",
    ),
]

ComponentOption = Annotated[
    list[str] | None,
    typer.Option(
        "--component",
        metavar="NAME",
        help="Recompute only this component and take the others from the log. Repeatable.",
    ),
]

FieldScenarioOption = Annotated[
    str | None,
    typer.Option(
        metavar="SCENARIO",
        help="Scenario for a recording of another tool: a shipped scenario by name, or a "
        ".toml file. Components named by --map are taken from the recording.",
        autocompletion=completion.complete_scenario,
    ),
]

VaryOption = Annotated[
    list[str] | None,
    typer.Option(
        "--vary",
        metavar="COMPONENT.PARAMETER=V1,V2,...",
        help="Replay with each of these values and print a table of the results. Repeatable:"
        " all combinations, at most 1000. All are checked before the first one runs. "
        "Logs are only written with --out FOLDER.",
    ),
]


def replay(
    log: LogArgument,
    verify: VerifyOption = False,
    allow_code: AllowCodeOption = False,
    rerun: RerunOption = False,
    begin: WindowBeginOption = None,
    end: WindowEndOption = None,
    components: ComponentOption = None,
    scenario: FieldScenarioOption = None,
    out: OutOption = None,
    force: ForceOption = False,
    changes: SetOption = None,
    vary: VaryOption = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    fail_on: FailOnOption = None,
    asserted: AssertOption = None,
    no_verdicts: NoVerdictsOption = False,
) -> None:
    """Run the scenario of a log again on its recorded plant.

    Needs only the log; for a recording of another tool also --scenario and --map.
    """
    from cosim.report.tables.run import print_summary
    from cosim.scenario.running.replay import LogReplays, replayed_once, replays_of

    start_collecting()
    imported = perf_counter()
    _check_choices(vary, plot, stop, verify=verify, changes=changes)
    failures = read_fail_on(fail_on, no_verdicts=no_verdicts)
    assertions = read_assertions(asserted)
    if vary and (failures or assertions):
        raise UsageError("--fail-on and --assert are for one replay; omit them or --vary")
    if assertions and not (begin is None and end is None):
        raise UsageError("--assert is of the whole replay; omit it, or --from and --to")
    with prints_to_stderr():
        replays = replays_of(
            log,
            set=read_edits(
                changes,
                {"scenario.stop": stop, "scenario.verdicts": False if no_verdicts else None},
            ),
            swap=read_unique_pairs(swaps, "swap"),
            map=read_unique_pairs(maps, "map"),
            allow_code=allow_code,
            rerun=rerun,
            window=None if begin is None and end is None else (begin, end),
            components=components or None,
            scenario=scenario,
        )
    if verify and replays.source is None:
        raise UsageError(f"--verify compares with a log of cosim; {log} is of another tool")
    if vary:
        _replay_each(replays, vary, out, force=force, as_json=as_json, quiet=quiet)
        return
    check_plot(plot, out)
    notice = None if quiet else print_notice
    view = None if assertions is None else assertions.view()
    with ExitStack() as resources:
        with show_progress(quiet or as_json) as progress, prints_to_stderr():
            replayed = replayed_once(
                replays, out, force=force, progress=progress, notice=notice, live=view
            )
            again = resources.enter_context(replayed)
        if plot is not None:
            from cosim.report.plots.runs import plot_run

            plot_run(again, plot)
        if verify and isinstance(replays, LogReplays):
            from cosim.report.tables.logs import print_verification
            from cosim.report.verification import verify as verify_replay

            source = replays.source
            designs = None if replays.request.window is not None else replays.designs()
            verification = verify_replay(source, again, designs)
            print_verification(verification, source, path=log, as_json=as_json, quiet=quiet)
            if not verification.passed:
                raise typer.Exit(1)
        else:
            wall = {"imports": imported - BEGAN, "replay": perf_counter() - imported}
            kept = out is not None
            print_summary(again, wall=wall, as_json=as_json, quiet=quiet, is_kept=kept)
        fail_if(again, failures, view, quiet=quiet or verify)


def _check_choices(
    vary: list[str] | None,
    plot: Path | None,
    stop: float | None,
    *,
    verify: bool,
    changes: list[str] | None,
) -> None:
    """Check that options go together.

    Raises
    ------
    UsageError
        If two of them do not.
    """
    if verify and stop is not None:
        raise UsageError("--verify compares the whole log; omit --stop")
    if verify and any(change.startswith("scenario.stop=") for change in changes or ()):
        raise UsageError("--verify compares the whole log; omit --set scenario.stop")
    if vary and (verify or plot is not None):
        name = "--verify" if verify else "--plot"
        raise UsageError(f"{name} is for one replay; omit it or --vary")


def _replay_each(
    replays: Replays,
    vary: list[str],
    out: Path | None,
    *,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Replay with every combination of values; exit with 1 if one fails."""
    from cosim.report.comparing import sweep_of
    from cosim.report.tables.comparison import print_sweep

    values = read_variations(vary)
    with show_progress(quiet or as_json) as progress, prints_to_stderr():
        sweep = sweep_of(replays, values, out=out, force=force, progress=progress)
    print_sweep(sweep, as_json=as_json, quiet=quiet)
    if not sweep.passed:
        raise typer.Exit(1)
