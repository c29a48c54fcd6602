"""Run a scenario into its recording: a log file, memory, or a recorder of one's own."""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Final, Protocol

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.master import run as run_graph
from cosim.core.recorded.partial import RecordSelection
from cosim.core.recorded.signals import RunMessage, warning_texts
from cosim.core.recorders import Memory, Slice
from cosim.core.recording import Recorder
from cosim.errors import Interrupted, LogError, RunError, UsageError, flag, option, warn
from cosim.files import file_type
from cosim.interrupts import REASONS
from cosim.log import Log, McapRecorder
from cosim.log.background import FLUSH_INTERVAL
from cosim.log.files import Rotation, UnfinishedLog, log_path
from cosim.log.preamble import PARTIAL_STATUS
from cosim.log.store import check_place
from cosim.native.fmi.process import report_log
from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import with_loop_gains
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.build_record import unpacked_in
from cosim.scenario.recordings.log_contents import attachments_of, metadata_of
from cosim.scenario.recordings.message_recorder import MessageRecorder

if TYPE_CHECKING:
    from cosim.scenario.recordings.swap_report import SwapReports

Progress = Callable[[float, float], None]  # simulated time, end [s]
Notice = Callable[[str], None]
Beside = Callable[[Recorder], Recorder]  # adds something to what a recorder takes
_LARGE: Final = 10**9  # bytes of a log that are worth a word


class LiveView(Protocol):
    """What shows a run while it goes on, beside what records it."""

    def beside(self, recorder: Recorder, kinds: Mapping[str, str]) -> Recorder:
        """Return what takes the run, shows it, and passes it on to its recorder.

        ``kinds`` are those of its components by name.
        """
        ...


@dataclass(frozen=True, slots=True)
class Target:
    """Where a run is recorded: over or beside a log that is there, or in memory.

    Parameters
    ----------
    out : str, Path or None
        None: in memory.
    force, numbered : bool
    notice : callable or None
    flush : float
        After how much wall time a row is in the log at the latest [s].
    sync : bool
        Wait for the disk at every flush.
    rotation : Rotation or None
        When the log goes on in a next file.
    embed : bool
        Put the FMUs of components there, too.
    live : LiveView or None
        What takes the run, too.
    """

    out: str | Path | None
    force: bool = False
    numbered: bool = False
    notice: Notice | None = None
    flush: float = FLUSH_INTERVAL
    sync: bool = False
    rotation: Rotation | None = None
    embed: bool = False
    live: LiveView | None = None


# --- before the run ---


def check_target(out: str | Path | None, *, force: bool = False, numbered: bool = False) -> None:
    """Refuse a path that the log of a run cannot be written to; None: there is no log.

    Raises
    ------
    UsageError
        If it does not end as a log does, is taken, or no file can be written there; or if it is
        said what becomes of a log where there is none.
    """
    if out is None:
        for name, value in (("force", force), ("numbered", numbered)):
            if value:
                raise UsageError(f"{flag(name)} applies to a log; expected {option('out')}, too")
        return
    path = log_path(out)
    if file_type(path) != "log":
        raise UsageError(f"{out}: expected a path that ends in .mcap")
    check_place(UnfinishedLog(path, force=force, numbered=numbered))


def build_experiment(
    scenario: Scenario,
    resources: ExitStack,
    reports: SwapReports | None = None,
) -> Experiment:
    """Build a scenario; one with swaps is compared with what it was, for its log and warnings.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what was opened, when the run is over.
    reports : SwapReports, optional
        How the swaps compare, where that is known.

    Raises
    ------
    ScenarioError
        With every problem of the file; or if the coupling of a loop is refused.
    """
    if scenario.file.swap and reports is None:
        from cosim.scenario.recordings.swap_comparison import compare_swaps  # few runs need it

        reports = compare_swaps(scenario, unpacked_in(resources))
        reports.check()
    replaced = None if reports is None else reports.replaced

    def build() -> Experiment:
        builder = Builder(scenario, resources, replaced=replaced)
        return with_reports(builder.experiment(), reports)

    def rebuild() -> Experiment:
        resources.close()
        return build()

    experiment = with_loop_gains(build(), rebuild)
    experiment.setting_designs = experiment.prepare_settings({})
    return experiment


def with_reports(experiment: Experiment, reports: SwapReports | None) -> Experiment:
    """Keep in the log how swapped components compare with those they replace."""
    if reports is not None:
        for name, report in reports.reports.items():
            experiment.built.add_metadata(name, {"swap_report": report.to_dict()})
        for name, text in reports.warnings:
            experiment.built.warn(name, text)
    return experiment


# --- the run ---


def record(
    experiment: Experiment,
    target: Target,
    *,
    progress: Progress | None,
    profile: dict[str, float] | None = None,
    beside: Beside | None = None,
    finish: Callable[[], None] = lambda: None,
) -> Log | Memory:
    """Run an experiment and return its recording: the log file if a path is given.

    Parameters
    ----------
    experiment : Experiment
    target : Target
    progress : callable or None
    profile : dict, optional
        Filled with wall seconds by component.
    beside : callable, optional
        Returns what takes the run and passes it on to the recorder of the recording.
    finish : callable, optional
        Ends the recording, where ``beside`` leaves that to it.
    """
    out = target.out
    if out is None:
        attachments = attachments_of(experiment, embed=target.embed)
        memory = Memory(metadata_of(experiment), {file.name: file.data for file in attachments})
        taking = shown(experiment, target.live, beside, chosen_of(experiment, memory))
        run_into(taking, experiment, progress=progress, profile=profile)
        finish()
        return memory
    log = log_recorder(experiment, out, target)
    taking = shown(experiment, target.live, beside, chosen_of(experiment, log))
    began = partial(_announce_size, log, experiment.clock.steps, target.notice)
    try:
        run_into(taking, experiment, progress=progress, profile=profile, began=began, log=log)
        finish()
    except RunError as error:
        with suppress(LogError):  # nothing was written
            recorded = log.recorded()
            if recorded.is_at_its_path and str(recorded.path) not in str(error):
                error.add_note(f"{recorded.path} {_recorded_part(recorded)}")
        raise
    finally:
        report_log(None)
    return log.recorded()


def shown(
    experiment: Experiment, live: LiveView | None, beside: Beside | None, recorder: Recorder
) -> Recorder:
    """Return what shows a run and passes it on to what is beside its recorder, and to that."""
    taking = recorder if beside is None else beside(recorder)
    return taking if live is None else live.beside(taking, _kinds(experiment))


def _kinds(experiment: Experiment) -> dict[str, str]:
    return {name: spec.kind for name, spec in experiment.scenario.specs.items()}


def chosen_of(experiment: Experiment, recorder: Recorder) -> Recorder:
    """Return what passes on to a recorder what the scenario has it record."""
    selection = experiment.scenario.file.record.selection
    if selection == RecordSelection():
        return recorder
    return Slice(recorder, selection, beside=experiment.declared)


def _recorded_part(log: Log) -> str:
    """Return what a log has of a run that failed: nothing, if that was at its initialization."""
    if not log.steps and not any(len(log.time_ns(name)) for name in log.channels):
        return "has no row of the run"
    if log.status == PARTIAL_STATUS:
        return f"is the last of several files, which hold the run up to t = {log.end_ns / 1e9} s"
    return f"holds the run up to t = {log.end_ns / 1e9} s"


def _announce_size(log: McapRecorder, steps: int, notice: Notice | None) -> None:
    """Announce how large a log may become, if that is much or more than there is room for.

    Where nobody takes notices, the latter is a warning.
    """
    bound = log.size_bound(steps)
    free = shutil.disk_usage(log.path.parent).free
    text = f"{log.path} takes up to {bound / 1e9:.3g} GB, before compression and without messages"
    if bound > free:
        text += f"; its disk has {free / 1e9:.3g} GB left"
        if notice is None:
            warn([text])
        else:
            notice(f"warning: {text}")
    elif bound > _LARGE and notice is not None:
        notice(text)


def run_into(
    recorder: Recorder,
    experiment: Experiment,
    *,
    progress: Progress | None,
    profile: dict[str, float] | None,
    began: Callable[[], None] | None = None,
    log: McapRecorder | None = None,
) -> list[RunMessage]:
    """Run an experiment; its rows, messages and results go to the recorder, perhaps a log's.

    Returns
    -------
    list of RunMessage
        Its warnings; those of a run that fails are notes of the error.
    """
    graph = experiment.graph
    seconds = {} if profile is None else graph.measure()
    first = perf_counter()
    with interruptible() as check:

        def reached(block: Block, _: Matrix) -> None:
            nonlocal log
            if log is not None:  # with its first rows it is at its path
                report_log(log.path)
                log = None
            if progress is not None:
                progress(float(block.time[-1]), experiment.clock.stop)
            check()

        with_messages = MessageRecorder(recorder, experiment, began=began, reached=reached)
        try:
            _run(experiment, with_messages)
        except RunError as error:
            for text in warning_texts(with_messages.warnings):
                error.add_note(f"warning: {text}")
            raise
    if profile is not None:
        elapsed = perf_counter() - first
        seconds["recorder and master"] = elapsed - sum(seconds.values())
        profile.update(seconds)
    return with_messages.warnings


def run_rows(recorder: Recorder, experiment: Experiment) -> None:
    """Run an experiment without verdicts at its end."""
    run_into(recorder, replace(experiment, identified={}), progress=None, profile=None)


def _run(experiment: Experiment, recorder: Recorder) -> None:
    """Run the graph; with its actions, or with the events of its recording."""
    graph = experiment.graph
    clock = experiment.clock
    plan = experiment.plan
    designs = experiment.designs if plan is None else None
    until = experiment.until
    if experiment.actions or experiment.reactions:
        from cosim.core.stepping.repeating import run_with_actions  # few runs need it

        actions = experiment.actions
        reactions = experiment.reactions
        run_with_actions(
            graph, clock, recorder, plan, actions=actions, reactions=reactions, until=until
        )
    elif experiment.events:
        from cosim.core.stepping.repeating import RecordedChanges, repeat

        changes = RecordedChanges(experiment.events, experiment.recorded, experiment.settings)
        repeat(graph, clock, recorder, plan, changes=changes, designs=designs, until=until)
    else:
        run_graph(graph, clock, recorder, plan, designs=designs, until=until)


def log_recorder(
    experiment: Experiment, out: str | Path, target: Target, *, events: bool = False
) -> McapRecorder:
    """Return the recorder of a log; with ``events`` for a run whose inputs may be overridden.

    Raises
    ------
    UsageError
        If the run reads what is to be replaced.
    """
    is_read = Path(os.path.realpath(log_path(out))) in experiment.built.files
    if is_read and not target.numbered:
        raise UsageError(f"{out} is read by this run; choose another path for the log")
    metadata = metadata_of(experiment)
    attachments = attachments_of(experiment, embed=target.embed)
    return McapRecorder(
        out,
        force=target.force,
        numbered=target.numbered,
        kinds=_kinds(experiment),
        metadata=metadata,
        attachments=attachments,
        events=events or experiment.has_events,
        substeps=bool(experiment.graph.substep_controls),
        flush=target.flush,
        sync=target.sync,
        rotation=target.rotation,
    )


@contextmanager
def interruptible() -> Iterator[Callable[[], None]]:
    """Yield a check that raises where the run was interrupted, called after every block.

    Ctrl-C, a request to terminate and a closed terminal so end the run cleanly; a second one does
    what it did before: as a rule it ends the program at once. What is ignored stays ignored, as in
    a program that ``nohup`` started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    received: list[int] = []
    handlers: dict[int, Callable[[int, FrameType | None], object] | int] = {}

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1:
            return
        before = handlers[number]
        if callable(before):
            with suppress(KeyboardInterrupt):  # it has no reason
                before(number, frame)
        raise KeyboardInterrupt(REASONS[number])

    def check() -> None:
        if received:
            raise Interrupted(REASONS[received[0]], received[0])

    for number in REASONS:
        before = signal.getsignal(number)
        if before not in (signal.SIG_IGN, None):  # None: not from Python, so not ours to replace
            handlers[number] = before
            signal.signal(number, receive)
    try:
        yield check
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
