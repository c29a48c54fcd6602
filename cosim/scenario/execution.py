"""Run a scenario, and run it again from its log."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar, overload

from cosim.arguments import (
    callable_argument,
    mapping_argument,
    truth_argument,
    whole_argument,
)
from cosim.core.clock import Clock
from cosim.core.contracts import Block, Design, Recorder
from cosim.core.graph import Graph
from cosim.core.master import run as run_graph
from cosim.core.recorders import Memory, Watched
from cosim.errors import LogError, UsageError, command, option, quoted
from cosim.log import Log, McapRecorder, open_log
from cosim.log.metadata import json_table
from cosim.log.paths import check_new_log, log_path
from cosim.scenario.build import Builder, Experiment, parse
from cosim.scenario.document import Document, find
from cosim.scenario.edits import short
from cosim.scenario.interrupting import interruptible
from cosim.scenario.parsing import Scenario, read
from cosim.scenario.profile import Timed
from cosim.scenario.recorded_metadata import ReplayOrigin
from cosim.scenario.records import SCENARIO_FILE, MessageRecorder, attachments_of, metadata_of
from cosim.scenario.replaying import (
    check_changes,
    recorded_components,
    texts_in,
    valid_designs,
)
from cosim.scenario.swap import PortNames, is_map_key, is_port_names
from cosim.scenario.swap_comparison import build_swapped
from cosim.scenario.swap_report import SwapReports

Progress = Callable[[float, float], None]  # simulated time, end [s]
Notice = Callable[[str], None]
_LARGE = 10**9  # bytes of a log that are worth a word

OwnRecorder = TypeVar("OwnRecorder", bound=Recorder)


@dataclass(frozen=True, slots=True)
class _Target:
    """Where a run is recorded: over or beside a log that is there; None: in memory."""

    out: str | Path | None
    force: bool = False
    numbered: bool = False
    notice: Notice | None = None


def load(name: str | Path) -> Scenario:
    """Load and validate a scenario: a path, or the name of a shipped one.

    Raises
    ------
    UsageError
        If it is no path.
    ScenarioError
        With every problem of the file.
    """
    return parse(find(name))


@overload
def run(
    scenario: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    force: bool = False,
    numbered: bool = False,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    notice: Notice | None = None,
    profile: dict[str, float] | None = None,
    recorder: None = None,
) -> Log | Memory: ...


@overload
def run(
    scenario: str | Path | Scenario,
    *,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    notice: Notice | None = None,
    profile: dict[str, float] | None = None,
    recorder: OwnRecorder,
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
    block: int | None = None,
    progress: Progress | None = None,
    notice: Notice | None = None,
    profile: dict[str, float] | None = None,
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
        Replace an existing log.
    numbered : bool
        Where there is a log, write to the next free one of ``x-2.mcap``, ``x-3.mcap``, ...; the
        ``path`` of the result says which. Any number of runs at once may share one ``out``.
    set : mapping of dotted key to value, optional
        Such as ``{"observer.filter_rate": 500.0, "scenario.stop": 10.0}``; applied after ``swap``.
    swap : mapping of component name to path, optional
        Components to replace by an FMU (``x.fmu``, ``x.fmu#me``, ``x.fmu#cs``) or by a recorded
        log.
    map : mapping of port to names, optional
        Ports of the scenario that have another name there, such as ``{"observer.y": "out1"}``, or
        are made of several, such as ``{"plant.x_a": ["s1", "s2"]}``.
    block : int, optional
        Communication steps in a block; the result does not depend on it.
    progress : callable, optional
        Called with simulated time and end [s] as the run goes on.
    notice : callable, optional
        Called with a text before the first step, if the log may become large, or larger than the
        disk has room for.
    profile : dict, optional
        Filled with wall seconds by component.
    recorder : Recorder, optional
        One's own recorder, instead of ``out``: it takes the rows of the run, its messages and its
        results as they are computed. Nothing else is kept, and nothing is written.

    Returns
    -------
    Log, Memory or Recorder
        The recording: the log file if ``out`` is given, ``recorder`` itself if that is given.

    Raises
    ------
    CosimError
        UsageError before the first step, RunError after it; see :mod:`cosim.errors`.
    """
    _check_recorder(out, recorder)
    truth_argument("force", force)
    truth_argument("numbered", numbered)
    if force and numbered:
        raise UsageError(
            "found both force and numbered; needed one of them: a log is replaced, or "
            "kept beside the new one"
        )
    whole_argument("block", block)
    callable_argument("progress", progress)
    callable_argument("notice", notice)
    _check_profile(profile)
    check_target(out, force=force, numbered=numbered)
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    edited = loaded.edit(swap=swap, map=map, set=set)
    with ExitStack() as resources:
        experiment = _built(edited, resources, block)
        if recorder is not None:
            _run_into(recorder, experiment, {}, progress=progress, profile=profile)
            return recorder
        target = _Target(out, force, numbered, notice)
        return _record(experiment, {}, target, progress=progress, profile=profile)


def _check_profile(profile: object) -> None:
    if profile is not None and not isinstance(profile, dict):
        raise UsageError(f"{option('profile')}: found {quoted(profile)}; needed a dict, to fill")


def _check_recorder(out: str | Path | None, recorder: Recorder | None) -> None:
    if out is not None and recorder is not None:
        raise UsageError(
            f"found both out={str(out)!r} and a recorder; needed one of them: "
            "out writes a log file, recorder takes the run itself"
        )
    if recorder is not None and (isinstance(recorder, type) or not isinstance(recorder, Recorder)):
        raise UsageError(
            f"recorder: found {quoted(recorder)}; needed an object with the methods of "
            "cosim.core.Recorder"
        )


def _built(scenario: Scenario, resources: ExitStack, block: int | None) -> Experiment:
    """Build a scenario; one with swaps is compared with what it was, for its log and warnings."""
    if not scenario.file.swap:
        return Builder(scenario, resources, block=block).experiment()
    experiment, reports = build_swapped(scenario, resources, block)
    return _with_reports(experiment, reports)


def replay(
    log: str | Path | Log,
    *,
    out: str | Path | None = None,
    force: bool = False,
    set: Mapping[str, Any] | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    notice: Notice | None = None,
) -> Log | Memory:
    """Run the scenario of a log again, with its recorded plants; only the log is needed.

    Plants, FMUs and tables from files are taken from the recording; everything else is computed
    again. Designs are taken from the log too, except those of components that ``set`` changes or
    that rest on one that it changes. No file is opened but the log and those that ``set`` names.

    Raises
    ------
    LogError
        If the log cannot be read, is no log of a scenario, or does not fit its scenario.
    UsageError
        If ``set`` changes the communication step, a recorded component, or what drives one: its
        recording cannot follow.
    """
    truth_argument("force", force)
    whole_argument("block", block)
    callable_argument("progress", progress)
    callable_argument("notice", notice)
    wanted = mapping_argument("set", set)
    source = log if isinstance(log, Log) else open_log(log)
    if out is not None and os.path.realpath(out) == os.path.realpath(source.path):
        raise UsageError(f"{out} is the log that is replayed; choose another path")
    check_target(out, force=force)
    changes = _replay_changes(source, wanted)
    original = recorded_document(source)
    document = original.with_changes(changes)
    with ExitStack() as resources:
        scenario, problems = read(document, parse)
        # recorded ports have the scenario's names: a map need not fit changed connections
        problems = [(key, text) for key, text in problems if not is_map_key(key)]
        source.load(*_recorded_in(source, scenario))  # in one pass over the file
        builder = Builder(
            scenario,
            resources,
            problems=problems,
            recording=source,
            named_files=texts_in(wanted),
            block=block,
        )
        experiment = builder.experiment()
        _check_clock(experiment.clock, source)
        check_changes(experiment, original, wanted)
        designs = valid_designs(experiment, source)
        copied = tuple(recorded_components(experiment))
        origin = ReplayOrigin(str(source.path), source.recorded_hash, copied)
        experiment = replace(experiment, origin=origin)
        return _record(experiment, designs, _Target(out, force, notice=notice), progress=progress)


def _replay_changes(source: Log, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes of a replay: those that are wanted, and the end of the recording.

    Raises
    ------
    LogError
        If there is no step in it.
    UsageError
        If they change the communication points, or go beyond the recording.
    """
    changes = {short(key): value for key, value in wanted.items()}
    if "scenario.step" in changes:
        recorded_step = source.step_ns / 1e9
        raise UsageError(
            f"scenario.step: found {changes['scenario.step']} s, a replay keeps the recorded "
            f"{recorded_step} s; run the scenario to change it"
        )
    if "scenario.start_time" in changes:
        raise UsageError(
            f"scenario.start_time: found {changes['scenario.start_time']} s, a replay keeps the "
            "recorded one; run the scenario to change it"
        )
    _check_end(source)
    recorded_end = source.end_ns / 1e9
    stop = changes.setdefault("scenario.stop", recorded_end)
    if isinstance(stop, (int, float)) and stop > recorded_end:
        raise UsageError(
            f"{option('set', 'scenario.stop')}: found {stop} s, the recording ends at "
            f"{recorded_end} s; needed no more than that"
        )
    return changes


def _check_clock(clock: Clock, source: Log) -> None:
    """Check that a scenario has the communication points of the rows in its log.

    Raises
    ------
    LogError
        If it has not.
    """
    first_ns = source.end_ns - source.steps * source.step_ns
    if (clock.start_ns, clock.step_ns) != (first_ns, source.step_ns):
        raise LogError(
            f"{source.path}: its scenario has steps of {clock.step_ns} ns from {clock.start_ns} ns "
            f"on, its rows of {source.step_ns} ns from {first_ns} ns on"
        )


def _check_end(source: Log) -> None:
    """Check that the recorded end is that of the rows: a replay would go on to it.

    Raises
    ------
    LogError
        If there is no step in the log, or its rows end elsewhere.
    """
    end_ns = source.end_ns
    if source.steps == 0:
        raise LogError("the log has no step to replay; it ends where it begins")
    channel = next(iter(source.channels.values()))
    times = source.time_ns(channel.name).tolist() or [0]
    first_ns = times[0]
    last_ns = times[-1]
    is_last = 0 <= end_ns - last_ns < channel.period * source.step_ns
    if end_ns != first_ns + source.steps * source.step_ns or not is_last:
        raise LogError(
            f"{source.path}: it is said to end at {end_ns / 1e9} s after {source.steps} steps, but "
            f"the rows of {channel.name!r} end at {last_ns / 1e9} s"
        )


def recorded_document(log: Log) -> Document:
    """Return the scenario of a log.

    Raises
    ------
    LogError
        If the log carries none.
    """
    edits = log.metadata.get("cosim.run", {}).get("edits")
    if SCENARIO_FILE not in log.attachments or edits is None:
        raise LogError(
            f"the log carries no {SCENARIO_FILE}; needed a log that {command('run')} wrote"
        )
    try:
        text = log.attachment(SCENARIO_FILE).decode()
        return Document.recorded(text, _edits(edits), Path.cwd())
    except ValueError as error:
        raise LogError(f"{log.path}: its scenario cannot be understood: {error}") from error


def _edits(text: str) -> dict[str, Any]:
    """Read the edits of a recorded scenario.

    Raises
    ------
    ValueError
        If they are not what :meth:`Document.edits` writes.
    """
    edits = json_table(text)
    for key, kind in (("source", str), ("swaps", dict), ("changes", dict)):
        if not isinstance(edits.get(key), kind):
            raise ValueError(f"found {key} {quoted(edits.get(key))}")
    maps = edits.setdefault("maps", {})
    if not isinstance(maps, dict):
        raise ValueError(f"found maps {quoted(maps)}")
    for name, path in edits["swaps"].items():
        if not isinstance(path, str):
            raise ValueError(f"found {quoted(path)} for {name!r}")
    for port, names in maps.items():
        if not is_port_names(names):
            raise ValueError(f"found {quoted(names)} for {port!r}")
    return edits


def _recorded_in(source: Log, scenario: Scenario) -> list[str]:
    """Return the components of a scenario that are taken from a log, as far as it has them."""
    specs = scenario.specs
    return [name for name in source.channels if name in specs and not specs[name].computable]


def check_target(out: str | Path | None, *, force: bool = False, numbered: bool = False) -> None:
    """Refuse a path that the log of a run cannot be written to; None: it is kept in memory.

    Raises
    ------
    UsageError
        If it does not end as a log does, is taken, or no file can be written there.
    """
    if out is None:
        return
    path = log_path(out)
    if path.suffix != ".mcap":
        raise UsageError(f"{out}: a log needs a path that ends in .mcap")
    check_new_log(path, force=force, numbered=numbered)


def _record(
    experiment: Experiment,
    designs: Mapping[str, Design],
    target: _Target,
    *,
    progress: Progress | None,
    profile: dict[str, float] | None = None,
) -> Log | Memory:
    """Run an experiment and return its recording: the log file if a path is given."""
    out = target.out
    if out is None:
        memory = Memory(metadata_of(experiment))
        _run_into(memory, experiment, designs, progress=progress, profile=profile)
        return memory
    is_read = Path(os.path.realpath(out)) in experiment.files
    if is_read and not target.numbered:
        raise UsageError(f"{out} is read in this run; choose another path for the log")
    log = _log_recorder(experiment, out, target)

    def began() -> None:
        if target.notice is not None:
            _announce_size(log, experiment.clock.steps, target.notice)

    _run_into(log, experiment, designs, progress=progress, profile=profile, began=began)
    return log.recorded()


def _announce_size(log: McapRecorder, steps: int, notice: Notice) -> None:
    """Announce how large a log may become, if that is much or more than there is room for."""
    bound = log.size_bound(steps)
    free = shutil.disk_usage(log.path.parent).free
    text = f"{log.path} takes up to {bound / 1e9:.3g} GB, before compression and without messages"
    if bound > free:
        notice(f"warning: {text}; there are {free / 1e9:.3g} GB left on its disk")
    elif bound > _LARGE:
        notice(text)


def _run_into(
    recorder: Recorder,
    experiment: Experiment,
    designs: Mapping[str, Design],
    *,
    progress: Progress | None,
    profile: dict[str, float] | None,
    began: Callable[[], None] | None = None,
) -> None:
    """Run an experiment; its rows, messages and results go to the recorder."""
    seconds: dict[str, float] = {}  # of this run alone, whatever is in the dict to fill
    graph = experiment.graph if profile is None else _timed(experiment.graph, seconds)
    with_messages = MessageRecorder(recorder, experiment)
    first = perf_counter()
    with interruptible() as check:
        reached = _reached(experiment, progress, check)
        watched = Watched(with_messages, reached, began)
        plan = experiment.plan or graph.prepare(experiment.clock.step_ns, designs)
        run_graph(graph, experiment.clock, watched, plan)
    if profile is not None:
        elapsed = perf_counter() - first
        seconds["recorder and master"] = elapsed - sum(seconds.values())
        profile.update(seconds)


def _log_recorder(experiment: Experiment, out: str | Path, target: _Target) -> McapRecorder:
    kinds = {name: spec.kind for name, spec in experiment.scenario.specs.items()}
    metadata = metadata_of(experiment)
    attachments = attachments_of(experiment)
    return McapRecorder(
        out,
        force=target.force,
        numbered=target.numbered,
        kinds=kinds,
        metadata=metadata,
        attachments=attachments,
    )


def _with_reports(experiment: Experiment, reports: SwapReports) -> Experiment:
    """Keep in the log how swapped components compare with those they replace."""
    metadata = dict(experiment.metadata)
    for name, report in reports.reports.items():
        kept = metadata.get(name, {})
        metadata[name] = {**kept, "swap_report": report.to_dict()}
    warnings = (*experiment.warnings, *reports.warnings)
    return replace(experiment, metadata=metadata, warnings=warnings)


def _timed(graph: Graph, profile: dict[str, float]) -> Graph:
    components = {}
    for name, component in graph.components.items():
        components[name] = Timed(component, name, profile)
    return Graph(
        components,
        graph.connections,
        coupling=graph.coupling,
        input_interpolation=graph.input_interpolation,
        periods=graph.periods,
    )


def _reached(
    experiment: Experiment, progress: Progress | None, check: Callable[[], None]
) -> Callable[[Block], None]:
    end = experiment.clock.stop

    def reached(block: Block) -> None:
        if progress is not None:
            progress(float(block.time[-1]), end)
        check()

    return reached
