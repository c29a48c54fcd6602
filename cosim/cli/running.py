"""The commands that compute: run and replay."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cosim import completion
from cosim.cli.collecting import start_collecting
from cosim.cli.options import (
    ForceOption,
    JsonOption,
    LogArgument,
    MapOption,
    OutOption,
    PlotOption,
    QuietOption,
    ScenarioArgument,
    SetOption,
    StopOption,
    check_plot,
    given_values,
    print_notice,
    prints_to_stderr,
    read_edits,
    read_numbers,
    read_unique_pairs,
)
from cosim.cli.playing import HostOption, LiveOption, PortOption, ShowOption, shown_live
from cosim.errors import UsageError
from cosim.terminal import show_progress

if TYPE_CHECKING:
    from cosim.scenario.parsing import Scenario


BEGAN = perf_counter()

SwapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--swap",
        metavar="COMPONENT=PATH",
        autocompletion=completion.complete_swap,
        help="Replace a component by an FMU (x.fmu, x.fmu#me, x.fmu#cs), a recorded component "
        "(.mcap) or samples with their times (.csv, .parquet, an .mcap of another tool). "
        "Repeatable.",
    ),
]

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
    float | None,
    typer.Option(help="Communication step [s]; the same as --set scenario.step=..."),
]

ProfileOption = Annotated[
    bool, typer.Option("--profile", help="Show the wall time of each component.")
]

EmbedOption = Annotated[
    bool,
    typer.Option(
        "--embed",
        help="Put the FMUs of components into the log: 'cosim replay LOG --rerun --allow-code' "
        "then runs them again from the log alone.",
    ),
]

CertifyOption = Annotated[
    bool,
    typer.Option(
        "--certify",
        help="Run with half the step and a quarter, too, and show how large the error of the step "
        "is, signal by signal: seven times the work.",
    ),
]

FindStepOption = Annotated[
    list[str] | None,
    typer.Option(
        "--find-step",
        metavar="SIGNAL=TOLERANCE",
        help="Run with the largest step with which the error of the step in a signal is within a "
        "tolerance, in its unit, such as observer.delta=1e-4; implies --certify. The search "
        "begins with the largest step that divides all times, whatever the scenario's own step is; "
        "--step beside it is refused. Repeatable.",
    ),
]

RealTimeOption = Annotated[
    float | None,
    typer.Option(
        "--realtime",
        metavar="FACTOR",
        help="Keep the pace of the wall clock, 1.0, or of FACTOR times it, in blocks of about "
        "10 ms; shows how late the run was.",
    ),
]

FlushOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="After how much wall time a row is in the log at the latest: a run that is killed "
        "leaves a log that opens, without the last of these.  [default: 1.0]",
    ),
]

SyncOption = Annotated[
    bool,
    typer.Option(
        "--sync",
        help="Wait for the disk at every flush: then the log survives a loss of power, too.",
    ),
]

RotateOption = Annotated[
    str | None,
    typer.Option(
        metavar="LIMIT",
        help="Go on in a next file, x.part2.mcap, x.part3.mcap, ..., where the log has this size "
        "(B, kB, MB, GB, TB, KiB, MiB, GiB) or simulated time (s, min, h), such as 1GB or 1h. "
        "Each opens alone; 'cosim merge' joins them.",
    ),
]

DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Check the scenario and compare swapped components with the replaced; do not run. "
        "FMUs are loaded and initialized, classes of kind python are imported and initialized: "
        "that runs their code, in a process of its own.",
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
    show: ShowOption = None,
    flush: FlushOption = None,
    sync: SyncOption = False,
    rotate: RotateOption = None,
    dry_run: DryRunOption = False,
) -> None:
    """Run a scenario and record every signal to an MCAP log."""
    from cosim.processes import COMMAND_VARIABLE, end_with_parent, note_own_end
    from cosim.report.tables.rotation import is_rotated, print_rotated
    from cosim.report.tables.run import print_summary
    from cosim.scenario.running.execution import load
    from cosim.scenario.running.execution import run as run_scenario

    if dry_run and (certify or find_step):
        name = "--certify" if certify else "--find-step"
        raise UsageError(f"found --dry-run, which runs nothing, and {name}; needed one of them")
    if find_step and step is not None:
        raise UsageError(
            "found both --find-step and --step; needed one of them: the search chooses the step"
        )
    if dry_run and COMMAND_VARIABLE not in os.environ:
        options = {"--set": changes, "--swap": swaps, "--map": maps}
        _dry_run_in_child(scenario, options, {"--stop": stop, "--step": step}, as_json=as_json)
    end_with_parent()
    note_own_end()
    imported = perf_counter()
    edits = read_edits(changes, {"scenario.stop": stop, "scenario.step": step})
    swap = read_unique_pairs(swaps, "swap")
    names = read_unique_pairs(maps, "map")
    with prints_to_stderr():
        edited = load(scenario).edit(swap=swap, map=names, set=edits)
    start_collecting()
    if dry_run:
        _dry_run(edited, as_json=as_json)
        return
    if force and out is None:
        raise UsageError("--force replaces the log at --out; needed both, or neither")
    path = out or Path("logs") / f"{edited.name}.mcap"
    check_plot(plot, out)
    if rotate is not None and (plot is not None or profile):
        name = "--profile" if plot is None else "--plot"
        raise UsageError(
            f"found both --rotate and {name}, which shows a log of one file; needed one of them"
        )
    tolerances = read_numbers(find_step, "find-step")
    seconds: dict[str, float] | None = {} if profile else None
    with (
        shown_live(live, host, port, show) as server,
        show_progress(quiet or as_json) as progress,
        prints_to_stderr(),
    ):
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
            find_step=tolerances,
            realtime=realtime,
            live=server,
            flush=flush,
            sync=sync,
            rotate=rotate,
        )
    wall = {"imports": imported - BEGAN, "run": perf_counter() - imported}
    if plot is not None:
        from cosim.report.plots import plot_run

        plot_run(log, plot)
    if rotate is not None and is_rotated(log):
        print_rotated(log, wall=wall, as_json=as_json, quiet=quiet)
        return
    print_summary(log, wall=wall, profile=seconds, as_json=as_json, quiet=quiet)


def _dry_run_in_child(
    scenario: str,
    options: Mapping[str, Sequence[str] | None],
    numbers: Mapping[str, float | None],
    *,
    as_json: bool,
) -> NoReturn:
    """Do a dry run in a child process, as it runs the code of FMUs; exit as that does."""
    from cosim.processes import run_command
    from cosim.report.tables.console import terminal_width

    arguments = ["run", scenario, "--dry-run"]
    for name, values in options.items():
        for value in values or ():
            arguments += [name, value]
    for name, number in given_values(numbers).items():
        arguments += [name, repr(number)]
    if as_json:
        arguments.append("--json")
    result = run_command(arguments, columns=terminal_width())
    typer.echo(result.output, nl=False)
    typer.echo(result.messages, nl=False, err=True)
    raise typer.Exit(result.exit_code)


def _dry_run(scenario: Scenario, *, as_json: bool) -> None:
    """Compare swapped components with those they replace.

    Raises
    ------
    UsageError
        If the scenario cannot run with them.
    """
    from cosim.report.tables.comparison import print_dry_run
    from cosim.scenario.swapping.swap_comparison import compare_swaps

    with prints_to_stderr():
        reports = compare_swaps(scenario)
    print_dry_run(reports, as_json=as_json)
    if reports.refusals:
        raise UsageError("\n".join([*reports.refusals, *reports.hints]))


def replay(
    log: LogArgument,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Check the log's content hash, and compare with the log what is computed again: "
            "every signal, bit for bit, and what the log says of its run (truth, connections, "
            "schedule, times, component tables, overrides, substeps, warnings, last row, "
            "verdicts); exit 1 if one differs, with the first difference of every component. A "
            "log is not signed: one of another run, put in its place as a whole, passes.",
        ),
    ] = False,
    allow_code: Annotated[
        bool,
        typer.Option(
            "--allow-code",
            help="Compute components of kind python too: import the classes that the log names, "
            "from this folder or as Python finds modules, and run their code. Else they are taken "
            "from the log. Their sources have to be those of the run. With --rerun, run FMUs.",
        ),
    ] = False,
    rerun: Annotated[
        bool,
        typer.Option(
            "--rerun",
            help="Compute plants too, so that --verify verifies them: those of models, and with "
            "--allow-code FMUs, from the log (run --embed) or from where they were. Each has to be "
            "that of the run, by its SHA-256. Without both flags no FMU is run.",
        ),
    ] = False,
    begin: Annotated[
        float | None,
        typer.Option(
            "--from",
            metavar="T0",
            help="Record, or compare with --verify, only from this communication point on [s]. All "
            "is computed from the start, as a log has not the states of components: the rows are "
            "those of the whole replay.",
        ),
    ] = None,
    end: Annotated[
        float | None,
        typer.Option("--to", metavar="T1", help="And only up to this one; nothing behind is run."),
    ] = None,
    components: Annotated[
        list[str] | None,
        typer.Option(
            "--component",
            metavar="NAME",
            help="Compute this component alone, and take the others from the log. Repeatable.",
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="SCENARIO",
            help="Of a recording of another tool, which carries none: a shipped scenario by name, "
            "or a .toml file. The components that --map names are taken from the recording.",
            autocompletion=completion.complete_scenario,
        ),
    ] = None,
    out: OutOption = None,
    force: ForceOption = False,
    changes: SetOption = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="COMPONENT.PARAMETER=V1,V2,...",
            help="Replay with each of these values, and show what the results say as a table. "
            "Repeatable: every combination, at most 1000. All are checked before the first is run. "
            "Nothing is written, unless --out names a folder for their logs.",
        ),
    ] = None,
    swaps: SwapOption = None,
    maps: MapOption = None,
    stop: StopOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run a log's scenario again on its recorded plant.

    The log is all that is needed; of another tool's, --scenario and --map, too.
    """
    from cosim.log.editing.joining import open_joined
    from cosim.log.foreign.topics import is_foreign
    from cosim.report.tables.run import print_summary, print_verification
    from cosim.report.verification import verify as verify_replay
    from cosim.scenario.running.execution import replay as replay_log

    start_collecting()
    imported = perf_counter()
    source = log if is_foreign(log) else open_joined(log)
    if verify and isinstance(source, Path):
        raise UsageError(f"--verify compares with a log of cosim; {log} is of another tool")
    if verify and stop is not None:
        raise UsageError("--verify compares the whole log; leave out --stop")
    window = None if begin is None and end is None else (begin, end)
    edits = read_edits(changes, {"scenario.stop": stop})
    swap = read_unique_pairs(swaps, "swap")
    names = read_unique_pairs(maps, "map")
    if vary:
        if verify or plot is not None:
            name = "--verify" if verify else "--plot"
            raise UsageError(f"found --vary, many replays, and {name} of one; needed one of them")
        from cosim.cli.sweeping import read_variations
        from cosim.report.sweep import replay_sweep
        from cosim.report.tables.sweep import print_sweep

        values = read_variations(vary)
        with show_progress(quiet or as_json) as progress, prints_to_stderr():
            sweep = replay_sweep(
                source,
                vary=values,
                set=edits,
                swap=swap,
                map=names,
                allow_code=allow_code,
                rerun=rerun,
                window=window,
                components=components or None,
                scenario=scenario,
                out=out,
                force=force,
                progress=progress,
            )
        print_sweep(sweep, as_json=as_json, quiet=quiet)
        if not sweep.passed:
            raise typer.Exit(1)
        return
    check_plot(plot, out)
    with show_progress(quiet or as_json) as progress, prints_to_stderr():
        notice = None if quiet else print_notice
        again = replay_log(
            source,
            out=out,
            force=force,
            set=edits,
            swap=swap,
            map=names,
            allow_code=allow_code,
            rerun=rerun,
            window=window,
            components=components or None,
            scenario=scenario,
            progress=progress,
            notice=notice,
        )
    if plot is not None:
        from cosim.report.plots import plot_run

        plot_run(again, plot)
    if verify and not isinstance(source, Path):
        verification = verify_replay(source, again)
        print_verification(verification, source, path=log, as_json=as_json, quiet=quiet)
        if not verification.passed:
            raise typer.Exit(1)
    else:
        wall = {"imports": imported - BEGAN, "replay": perf_counter() - imported}
        print_summary(again, wall=wall, profile=None, as_json=as_json, quiet=quiet)
