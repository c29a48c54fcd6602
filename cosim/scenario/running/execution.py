"""Run a scenario, or start it to be advanced by hand."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar, Unpack, overload

from cosim.arguments import (
    callable_argument,
    fillable_argument,
    mapping_argument,
    positive_argument,
    setting_arguments,
    truth_argument,
    whole_argument,
)
from cosim.core.arguments import check_recorder
from cosim.core.recorded.signals import warning_texts
from cosim.core.recorders import Memory, Nothing
from cosim.core.recording import Recorder
from cosim.core.simulation import Simulation
from cosim.errors import UsageError, option, quoted, warn
from cosim.log import Log
from cosim.log.background import FLUSH_INTERVAL
from cosim.log.files import read_rotation
from cosim.options import OF_A_LOG, OF_A_RECORDER, STEP_IS_CHOSEN, check_rules
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document, find
from cosim.scenario.document.swaps import PortNames
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.log_contents import metadata_of
from cosim.scenario.recordings.message_recorder import MessageRecorder
from cosim.scenario.recordings.recording import (
    Beside,
    LiveView,
    Notice,
    Progress,
    Target,
    build_experiment,
    check_target,
    chosen_of,
    log_recorder,
    record,
    run_into,
    shown,
)
from cosim.scenario.running.real_time import paced
from cosim.scenario.session import Opened, Session

if TYPE_CHECKING:
    from cosim.scenario.running.certificate import Certification

OwnRecorder = TypeVar("OwnRecorder", bound=Recorder)


def load(name: str | Path) -> Scenario:
    """Load and validate a scenario: a path, or the name of a shipped one.

    Raises
    ------
    UsageError
        If it is no path.
    ScenarioError
        With every problem of the file.
    """
    return load_document(find(name))


def load_document(document: Document) -> Scenario:
    """Read and validate a document; the scenario can be started."""
    return replace(parse(document), parse=load_document, starter=start)


def start(
    scenario: Scenario, out: str | Path | None, *, force: bool = False, numbered: bool = False
) -> Session:
    """Start a scenario; see :meth:`cosim.scenario.kinds.base.Scenario.start`.

    Raises
    ------
    CosimError
        If it cannot be built, initialized, or recorded.
    """
    force = truth_argument("force", force)
    numbered = truth_argument("numbered", numbered)
    check_target(out, force=force, numbered=numbered)
    return Session(partial(_opened, scenario, Target(out, force, numbered)))


def _opened(scenario: Scenario, target: Target, resources: ExitStack, is_next: bool) -> Opened:
    """Build a scenario, and begin its simulation and its log."""
    experiment = build_experiment(scenario, resources)
    values = metadata_of(experiment)
    del values["cosim.run"]  # its times: states go on whatever they are
    identity = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    out = target.out
    log = None
    if out is None:
        recorder = MessageRecorder(Nothing(), replace(experiment, identified={}))
    else:
        kept = Target(out, numbered=True) if is_next else target
        log = log_recorder(experiment, out, kept, events=True)
        recorder = MessageRecorder(chosen_of(experiment, log), experiment)
    with ExitStack() as entered:
        entered.enter_context(recorder)
        plan = experiment.plan or experiment.graph.prepare(experiment.clock.step_ns)
        recorder.begin(plan)
        simulation = Simulation(
            experiment.graph,
            experiment.clock,
            plan,
            recorder=None if log is None else recorder,
            identity=identity,
            actions=experiment.actions,
            reactions=experiment.reactions,
            until=experiment.until,
        )
        entered.pop_all()  # the session closes it
    path = (lambda: None) if log is None else (lambda: log.path)
    return Opened(simulation, recorder, path, lambda: recorder.warnings)


class RunOptions(TypedDict, total=False):
    """What :func:`run` takes beside a recorder."""

    out: str | Path | None
    force: bool
    numbered: bool
    set: Mapping[str, Any] | None
    swap: Mapping[str, str | Path] | None
    map: Mapping[str, PortNames] | None
    stop: float | None
    step: float | str | None
    verdicts: bool | None
    block: int | None
    progress: Progress | None
    notice: Notice | None
    embed: bool
    profile: dict[str, float] | None
    certify: bool
    find_step: Mapping[str, float] | None
    realtime: float | None
    live: LiveView | None
    flush: float | None
    sync: bool
    rotate: str | None


@overload
def run(
    scenario: str | Path | Scenario, *, recorder: None = None, **options: Unpack[RunOptions]
) -> Log | Memory: ...


@overload
def run(
    scenario: str | Path | Scenario, *, recorder: OwnRecorder, **options: Unpack[RunOptions]
) -> OwnRecorder: ...


def run(
    scenario: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    force: bool = False,
    numbered: bool = False,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    stop: float | None = None,
    step: float | str | None = None,
    verdicts: bool | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    notice: Notice | None = None,
    embed: bool = False,
    profile: dict[str, float] | None = None,
    certify: bool = False,
    find_step: Mapping[str, float] | None = None,
    realtime: float | None = None,
    live: LiveView | None = None,
    flush: float | None = None,
    sync: bool = False,
    rotate: str | None = None,
    recorder: Recorder | None = None,
) -> Log | Memory | Recorder:
    """Run a scenario.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` gave.
    out : str or Path, optional
        Log file to write; without it the run is kept in memory.
    force : bool
        Replace a log at ``out``.
    numbered : bool
        Where there is a log at ``out``, write to the next free one of ``x-2.mcap``, ``x-3.mcap``,
        ...; the ``path`` of the result says which. Any number of runs at once may share one
        ``out``.
    set : mapping of dotted key to value, optional
        Such as ``{"observer.filter_rate": 500.0, "scenario.stop": 10.0}``; applied after ``swap``.
    swap : mapping of component name to path, optional
        Components to replace by an FMU (``x.fmu``, ``x.fmu#me``, ``x.fmu#cs``) or by a recorded
        log.
    map : mapping of port to names, optional
        Ports of the scenario that have another name in the replacement, such as
        ``{"observer.y": "out1"}``, or consist of several ports, such as
        ``{"plant.x_a": ["s1", "s2"]}``.
    stop, step, verdicts : optional
        End of the run [s], communication step [s] or a fraction such as ``"1/60"``, and whether
        estimates are judged by a fit at the end: the settings of these names, as
        ``set={"scenario.stop": ...}``.
    block : int, optional
        Communication steps in a block; the result does not depend on it.
    progress : callable, optional
        Called with the simulated time and the stop time [s] during the run.
    notice : callable, optional
        Called with a text before the first step if the log at ``out`` may become large, or larger
        than the free disk space.
    embed : bool
        Put the FMUs of components into the log, so that a replay can run them again from the log
        alone (``rerun``).
    profile : dict, optional
        Filled with wall seconds by component.
    certify : bool
        Run with half and a quarter of the step, too, and record the time-step error of every
        signal; see :func:`cosim.certificate`.
    find_step : mapping of signal to float, optional
        Run with the largest step that keeps the time-step errors of these signals within these
        tolerances, each in the unit of its signal, and certify that run. The step divides all
        times in the scenario; the step of the file is ignored, one in ``set`` is refused.
    realtime : float, optional
        Simulated time per wall time: 1.0 follows the wall clock, in blocks of about 10 ms. The
        lag is recorded; the rows are the same.
    live : LiveView, optional
        A :class:`cosim.live.LiveServer`: shows the run to viewers while it runs.
    flush : float, optional
        Longest wall time before a row is in the log [s], which is what a killed process loses;
        default: 1.
    sync : bool
        Wait for the disk at every flush, so that flushed rows survive a power loss.
    rotate : str, optional
        A size, such as ``"1GB"``, or a simulated time, such as ``"1h"``, after which the log at
        ``out`` continues in a new file: ``run.mcap``, ``run.part2.mcap``, ``run.part3.mcap``, ...
        Each opens alone; ``cosim merge`` joins them.
    recorder : Recorder, optional
        A recorder of your own in place of ``out`` and its options: it takes rows, messages and
        results as they are computed. Nothing else is kept, and nothing is written.

    Returns
    -------
    Log, Memory or Recorder
        The recording: the log file if ``out`` is given, ``recorder`` itself if that is given. Of a
        rotated log it is the last file: its rows are the last part of the run, its ``status`` is
        ``partial``, its ``results`` are those of the whole run.

    Raises
    ------
    CosimError
        UsageError before the first step, RunError after it; see :mod:`cosim.errors`.

    Warns
    -----
    CosimWarning
        Of what ``warnings`` of the result has.
    """
    force = truth_argument("force", force)
    numbered = truth_argument("numbered", numbered)
    embed = truth_argument("embed", embed)
    certify = truth_argument("certify", certify)
    sync = truth_argument("sync", sync)
    block = whole_argument("block", block)
    callable_argument("progress", progress)
    callable_argument("notice", notice)
    fillable_argument("profile", profile)
    check_rules((OF_A_RECORDER, OF_A_LOG, STEP_IS_CHOSEN), locals())
    if recorder is not None:
        check_recorder(recorder)
    if live is not None and not hasattr(live, "beside"):
        raise UsageError(f"{option('live')}: expected a cosim.live.LiveServer, got {quoted(live)}")
    check_target(out, force=force, numbered=numbered)
    interval = FLUSH_INTERVAL if flush is None else positive_argument("flush", flush)
    rotation = None if rotate is None else read_rotation(rotate)
    pace = None if realtime is None else positive_argument("realtime", realtime)
    with ExitStack() as resources:
        settings = setting_arguments(set, stop=stop, step=step, verdicts=verdicts)
        changes = resources.enter_context(settings)
        loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
        edited = loaded.edit(swap=swap, map=map, set=changes)
        certification: Certification | None = None
        if find_step is not None:
            from cosim.scenario.running.step_search import find_step as search_step  # costly

            tolerances = mapping_argument("find_step", find_step)
            certification = search_step(edited, tolerances, progress)
            edited = certification.scenario
        elif certify:
            from cosim.scenario.running.certificate import Certification  # costly

            certification = Certification(edited, progress)
            certification.check()
        beside: Beside | None = None if certification is None else certification.beside
        experiment = build_experiment(edited, resources)
        experiment.clock = replace(experiment.clock, block=block)
        if pace is not None:
            beside = paced(experiment, pace, beside)

        def finish() -> None:
            if certification is not None:
                certification.complete(resources)

        if recorder is not None:
            taking = shown(experiment, live, beside, recorder)
            warnings = run_into(taking, experiment, progress=progress, profile=profile)
            finish()
            warn(warning_texts(warnings))
            return recorder
        target = Target(
            out,
            force,
            numbered,
            notice,
            flush=interval,
            sync=sync,
            rotation=rotation,
            embed=embed,
            live=live,
        )
        recorded = record(
            experiment, target, progress=progress, profile=profile, beside=beside, finish=finish
        )
    warn(warning_texts(recorded.warnings))
    return recorded
