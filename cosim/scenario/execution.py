"""Run a scenario, and run it again from its log."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import Any

from cosim.core.contracts import Block, Recorder
from cosim.core.graph import Graph
from cosim.core.master import run as run_graph
from cosim.core.recorders import Memory, Watched
from cosim.errors import Interrupted, LogError, UsageError
from cosim.log import Log, McapRecorder, open_log
from cosim.scenario.build import Experiment, Scenario, build, parse
from cosim.scenario.document import Document, find, short
from cosim.scenario.profile import Timed
from cosim.scenario.records import SCENARIO_FILE, MessageRecorder, attachments_of, metadata_of
from cosim.scenario.replaying import cut_off, designs_that_hold
from cosim.scenario.swap_report import Contract, examine

Progress = Callable[[float, float], None]  # simulated time, end [s]


def load(name: str | Path) -> Scenario:
    """Load and validate a scenario: a path, or the name of a shipped one.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    return parse(find(str(name)))


def run(
    scenario: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    force: bool = False,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, str] | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    profile: dict[str, float] | None = None,
) -> Log | Memory:
    """Run a scenario.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` gave.
    out : str or Path, optional
        Log file to write; without it the run is kept in memory.
    force : bool
        Replace an existing log.
    set : mapping of dotted key to value, optional
        Such as ``{"observer.filter_rate": 500.0, "scenario.stop": 10.0}``; applied after ``swap``.
    swap : mapping of component name to path, optional
        Components to replace by an FMU (``x.fmu``, ``x.fmu#me``, ``x.fmu#cs``) or by a recorded log.
    map : mapping of port to name, optional
        Ports of the scenario that have another name there, such as ``{"observer.y": "out1"}``.
    block : int, optional
        Communication steps in a block; the result does not depend on it.
    progress : callable, optional
        Called with simulated time and end [s] as the run goes on.
    profile : dict, optional
        Filled with wall seconds by component.

    Returns
    -------
    Log or Memory
        The recording: the log file if ``out`` is given.

    Raises
    ------
    CosimError
        UsageError before the first step, RunError after it; see :mod:`cosim.errors`.
    """
    edited = (scenario if isinstance(scenario, Scenario) else load(scenario)).edit(
        swap=swap, map=map, set=set
    )
    contract = examine(edited.document) if edited.file.swap else None
    if contract is not None:
        contract.check()
    return _execute(
        edited.document,
        out=out,
        force=force,
        block=block,
        progress=progress,
        profile=profile,
        contract=contract,
    )


def replay(
    log: str | Path | Log,
    *,
    out: str | Path | None = None,
    force: bool = False,
    set: Mapping[str, Any] | None = None,
    block: int | None = None,
    progress: Progress | None = None,
) -> Log | Memory:
    """Run the scenario of a log again, with the recorded plant in the plant's place; nothing is needed but the log.

    Plants, FMUs and tables from files are taken from the recording; everything else is computed again. Design-time results are
    taken from the log too, except those of components that ``set`` changes or that rest on one that it changes.

    Raises
    ------
    LogError
        If the log cannot be read or is no log of a scenario.
    UsageError
        If ``set`` changes the communication step, or a recorded component.
    """
    source = log if isinstance(log, Log) else open_log(log)
    if out is not None and Path(out).resolve() == Path(source.path).resolve():
        raise UsageError(f"{out} is the log that is replayed; choose another path")
    changes = {short(key): value for key, value in (set or {}).items()}
    if "scenario.step" in changes:
        found, needed = changes["scenario.step"], source.step_ns / 1e9
        raise UsageError(
            f"scenario.step: found {found} s, a replay keeps the recorded {needed} s; run the scenario to change it"
        )
    recorded_end = source.end_ns / 1e9
    if recorded_end == 0.0:
        raise LogError("the log has no step to replay; it ends where it begins")
    stop = changes.setdefault("scenario.stop", recorded_end)
    if isinstance(stop, (int, float)) and stop > recorded_end:
        raise UsageError(
            f"--set scenario.stop: found {stop} s, the recording ends at {recorded_end} s; needed no more than that"
        )
    document = recorded_document(source).with_changes(changes)
    return _execute(
        document,
        out=out,
        force=force,
        block=block,
        progress=progress,
        source=source,
        changed=set or {},
    )


def recorded_document(log: Log) -> Document:
    """Give the scenario of a log.

    Raises
    ------
    LogError
        If the log carries none.
    """
    edits = log.metadata.get("cosim.run", {}).get("edits")
    if SCENARIO_FILE not in log.attachments or edits is None:
        raise LogError(f"the log carries no {SCENARIO_FILE}; needed a log that 'cosim run' wrote")
    return Document.recorded(log.attachment(SCENARIO_FILE).decode(), edits, Path.cwd())


def _execute(
    document: Document,
    *,
    out: str | Path | None,
    force: bool,
    block: int | None,
    progress: Progress | None,
    profile: dict[str, float] | None = None,
    contract: Contract | None = None,
    source: Log | None = None,
    changed: Mapping[str, Any] | None = None,
) -> Log | Memory:
    if out is not None and Path(out).suffix != ".mcap":
        raise UsageError(f"{out}: a log needs a path that ends in .mcap")
    with ExitStack() as resources:
        experiment = build(document, resources, recording=source, block=block)
        if out is not None and Path(out).resolve() in experiment.files:
            raise UsageError(f"{out} is read in this run; choose another path for the log")
        if contract is not None:
            experiment = _with_contract(experiment, contract)
        if source is not None:
            experiment = replace(
                experiment, warnings=(*experiment.warnings, *cut_off(experiment, changed or {}))
            )
        designs = {} if source is None else designs_that_hold(experiment, source, changed or {})
        graph = experiment.graph if profile is None else _timed(experiment.graph, profile)
        metadata = metadata_of(experiment)
        memory = Memory(metadata)
        recorder: Recorder = memory
        if out is not None:
            kinds = {name: spec.kind for name, spec in experiment.scenario.specs.items()}
            log = McapRecorder(
                out,
                force=force,
                kinds=kinds,
                metadata=metadata,
                attachments=attachments_of(experiment),
            )
            recorder = MessageRecorder(log, experiment)
        began = perf_counter()
        with _interruptible() as check:
            run_graph(
                graph,
                experiment.clock,
                _watched(recorder, experiment, progress, check),
                designs=designs,
            )
        if profile is not None:
            profile["recorder and master"] = perf_counter() - began - sum(profile.values())
    return memory if out is None else open_log(out)


def _with_contract(experiment: Experiment, contract: Contract) -> Experiment:
    """Keep in the log how swapped components compare with those they replace."""
    metadata = dict(experiment.metadata)
    for name, report in contract.reports.items():
        metadata[name] = {**metadata.get(name, {}), "contract": report.to_dict()}
    return replace(
        experiment, metadata=metadata, warnings=(*experiment.warnings, *contract.warnings)
    )


def _timed(graph: Graph, profile: dict[str, float]) -> Graph:
    components = {
        name: Timed(component, name, profile) for name, component in graph.components.items()
    }
    return Graph(
        components,
        graph.connections,
        coupling=graph.coupling,
        input_interpolation=graph.input_interpolation,
        periods=graph.periods,
    )


def _watched(
    recorder: Recorder, experiment: Experiment, progress: Progress | None, check: Callable[[], None]
) -> Recorder:
    end = experiment.clock.stop

    def reached(block: Block) -> None:
        if progress is not None:
            progress(float(block.time[-1]), end)
        check()

    return Watched(recorder, reached)


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Turn the first Ctrl-C, or a request to terminate, into a clean end after the current block; the second ends at once."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pressed = []

    def press(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        if len(pressed) > 1:
            raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise Interrupted(
                "interrupted by the user"
                if pressed[0] == signal.SIGINT
                else "terminated from outside"
            )

    before = {number: signal.signal(number, press) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def default_log(name: str, folder: Path = Path("logs")) -> Path:
    """Give the first free path of ``logs/<name>.mcap``, ``logs/<name>-2.mcap``, ..."""
    path, number = folder / f"{name}.mcap", 1
    while path.exists():
        number += 1
        path = folder / f"{name}-{number}.mcap"
    return path
