"""Replay a recording: once, or again and again, each time with other values.

A log of cosim is opened and read once; a recording of another tool is read by every replay.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from cosim.arguments import (
    callable_argument,
    fillable_argument,
    path_argument,
    setting_arguments,
    truth_argument,
)
from cosim.core.contracts import Design
from cosim.core.recorded.signals import warning_texts
from cosim.core.recorders import Memory
from cosim.errors import UsageError, flag, option, warn
from cosim.log import Log
from cosim.log.files import all_parts, log_path
from cosim.log.foreign.topics import is_foreign
from cosim.log.spans import open_joined
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.swaps import PortNames, WrittenPorts, ports_in
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.recorded_scenario import is_large
from cosim.scenario.recordings.recording import (
    LiveView,
    Notice,
    Progress,
    Target,
    build_experiment,
    check_target,
    record,
)
from cosim.scenario.recordings.replay_request import ReplayRequest, window_of
from cosim.scenario.recordings.replaying import designs_anew, prepared_replay
from cosim.scenario.running.execution import load


@final
@dataclass(frozen=True)
class Replays:
    """A recording, and how it is replayed.

    Parameters
    ----------
    label : str
        Its path.
    source : Log or Scenario
        The log, joined with the files before it; of another tool's recording the scenario that
        takes components from it.
    request : ReplayRequest
        What all replays have.
    """

    label: str
    source: Log | Scenario
    request: ReplayRequest

    def experiment(self, values: Mapping[str, Any], resources: ExitStack) -> Experiment:
        """Build the replay with some values, to run it into a recorder of one's own."""
        changes = {**self.request.changes, **values}
        if isinstance(self.source, Log):
            request = replace(self.request, set=changes)
            return prepared_replay(self.source, request, resources)
        experiment = build_experiment(self.source.edit(set=changes), resources)
        experiment.clock = replace(experiment.clock, block=self.request.block)
        return experiment

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values; raise UsageError if it cannot be run."""
        with ExitStack() as resources:
            experiment = self.experiment(values, resources)
            if experiment.plan is None:
                experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)

    def check_target(self, out: str | Path | None, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to.

        Raises
        ------
        UsageError
            If it is the log that is replayed, another file of that where it was rotated, or as from
            :func:`cosim.scenario.recordings.recording.check_target`.
        """
        if out is not None and isinstance(self.source, Log):
            target = os.path.realpath(log_path(out))
            for file in (self.source.path, *all_parts(self.source.path)):
                if target == os.path.realpath(file):
                    what = "the log" if file == self.source.path else "a file of the log"
                    raise UsageError(f"{out} is {what} being replayed; choose another path")
        check_target(out, force=force)

    def record(
        self,
        values: Mapping[str, Any],
        target: Target,
        *,
        progress: Progress | None,
        profile: dict[str, float] | None = None,
    ) -> Log | Memory:
        """Replay with some values; refuse a path as :meth:`check_target` does."""
        self.check_target(target.out, force=target.force)
        beside = None
        if isinstance(self.source, Log) and self.request.window is not None:
            beside = window_of(self.source, self.request.window).beside
        with ExitStack() as resources:
            experiment = self.experiment(values, resources)
            recorded = record(experiment, target, progress=progress, profile=profile, beside=beside)
        warn(warning_texts(recorded.warnings))
        return recorded

    def designs(self) -> dict[str, Design]:
        """Compute the designs that a replay takes from the log anew, to be compared with those."""
        with ExitStack() as resources:
            return designs_anew(self.experiment({}, resources))


def replays_of(log: str | Path | Log, request: ReplayRequest) -> Replays:
    """Return a recording that can be replayed.

    Raises
    ------
    UsageError
        If the request does not go with it.
    """
    if isinstance(log, str | Path) and is_foreign(path_argument("log", log)):
        path = path_argument("log", log)
        return Replays(str(path), _with_recorded_components(path, request), request)
    source = open_joined(log)
    if request.scenario is not None:
        raise UsageError(
            f"{source.label} has its own scenario; omit {option('scenario')}, which is for "
            "recordings of other tools"
        )
    if request.maps and not request.swaps:
        raise UsageError(
            f"expected {option('swap')} with {option('map')}: only a replacement has other port "
            "names"
        )
    return Replays(source.label, source, request)


def replay(
    log: str | Path | Log,
    *,
    out: str | Path | None = None,
    force: bool = False,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    stop: float | None = None,
    verdicts: bool | None = None,
    allow_code: bool = False,
    rerun: bool = False,
    window: tuple[float | None, float | None] | None = None,
    components: Sequence[str] | None = None,
    scenario: str | Path | Scenario | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    notice: Notice | None = None,
    profile: dict[str, float] | None = None,
) -> Log | Memory:
    """Replay the scenario of a log from the log alone.

    Recorded outputs stand in for plants, FMUs, tables from files and components of users' classes;
    the rest is recomputed. Designs are taken from the log too, except those of components that
    ``set`` changes and of components that depend on these. No file is opened and no class is
    imported but those that ``set`` names.

    Parameters
    ----------
    log : str, Path or Log
        The recording of a run. A file of a rotated log is replayed with those before it, which
        must be in the same folder.
    out, force, block, progress, notice, profile
        As of :func:`run`.
    set : mapping of dotted key to value, optional
        Such as ``{"observer.filter_rate": 500.0, "scenario.stop": 10.0}``. A class that it names,
        ``{"relay.class": "relay:Relay"}``, is imported as it is now.
    stop, verdicts
        As of :func:`run`.
    swap, map
        As of :func:`run`. The replacement is computed, which runs the code of an FMU; the
        components that it drives must be computed too.
    allow_code : bool
        Compute components of users' classes too, which runs the code of the classes that the log
        names. Each is imported from the working directory or sys.path, and must have the source
        hash that the run recorded.
    rerun : bool
        Compute plants too: those of models, and with ``allow_code`` the FMUs of the run, from the
        log (``run(..., embed=True)``) or from their paths; each must have the SHA-256 that the run
        recorded. The plants are then not taken from the log, and their inputs can be changed.
    window : (float or None, float or None), optional
        Record only between two communication points [s]; None: from the beginning, or to the end.
        Everything is computed from the start, since a log does not hold all states, so the rows
        are those of the whole replay; nothing after the window is computed.
    components : sequence of str, optional
        The only components to compute, such as ``["observer"]``; all others are taken from the log.
    scenario : str, Path or Scenario, optional
        Scenario for a recording of another tool: the mapped components are taken from the
        recording, all others are computed. ``map`` names fields of the recording, such as
        ``{"plant.y": "/drive/state.position"}``.

    Returns
    -------
    Log or Memory
        The recording: the log file if ``out`` is given.

    Raises
    ------
    LogError
        If the log cannot be read, is no log of a scenario, or does not fit its scenario.
    FmuError
        If an FMU that is to be run again is missing, or another one.
    ScenarioError
        If a class cannot be imported, or is another one than in the run.
    UsageError
        If ``set`` or ``swap`` changes the communication step, a recorded component, or the inputs
        of one. If the window is invalid, or one of ``components`` does not exist or cannot be
        computed.
    """
    force = truth_argument("force", force)
    callable_argument("progress", progress)
    callable_argument("notice", notice)
    fillable_argument("profile", profile)
    with setting_arguments(set, stop=stop, verdicts=verdicts) as changes:
        request = ReplayRequest(
            set=changes,
            swap=swap,
            map=map,
            allow_code=allow_code,
            rerun=rerun,
            window=window,
            components=components,
            scenario=scenario,
            block=block,
        )
        target = Target(out, force, notice=notice)
        return replays_of(log, request).record({}, target, progress=progress, profile=profile)


@contextmanager
def replayed_once(
    replays: Replays,
    out: str | Path | None,
    *,
    force: bool,
    progress: Progress | None,
    notice: Notice | None,
    live: LiveView | None = None,
) -> Iterator[Log | Memory]:
    """Yield a replay without other values; parameters as of :func:`replay` and :func:`run`.

    Without ``out`` it is gone after the ``with`` block. Till then it is in memory, or, where that
    is much, in a temporary file; another tool's recording is read as a whole anyway.
    """
    target = Target(out, force, notice=notice, live=live)
    if out is not None or isinstance(replays.source, Scenario) or not is_large(replays.source):
        yield replays.record({}, target, progress=progress)
        return
    from cosim.temporary import TemporaryFolder  # most replays need none

    check_target(out, force=force)
    with TemporaryFolder("replay") as folder:
        temporary = Target(folder / "replay.mcap", live=live)
        yield replays.record({}, temporary, progress=progress)


# --- recordings of other tools ---


def _with_recorded_components(log: Path, request: ReplayRequest) -> Scenario:
    """Return the scenario whose mapped components come from a recording of another tool.

    Raises
    ------
    UsageError
        If there is no scenario, nothing is mapped, or something is asked for that only a replay of
        a log has.
    ScenarioError
        With every problem of the scenario and the maps.
    """
    given = {
        flag("allow_code"): request.allow_code,
        flag("rerun"): request.rerun,
        "a window of time": request.window is not None,
        "components to compute": request.components is not None,
    }
    for name in filter(given.get, given):
        raise UsageError(
            f"{name} does not apply to a recording of another tool, from which mapped components "
            "are taken while all others are computed; omit it"
        )
    needed_map = option("map", "plant.y", "/topic.field")
    scenario = request.scenario
    if scenario is None:
        raise UsageError(
            f"{log} was written by another tool and has no scenario; expected "
            f"{option('scenario')}, the one whose components it recorded, and a map of these, "
            f"{needed_map}"
        )
    if not isinstance(scenario, Scenario):
        scenario = load(scenario)
    if not request.maps:
        raise UsageError(
            f"{log} was written by another tool, so that its fields have no known place in the "
            f"scenario {scenario.name!r}; expected a map, {needed_map}; 'cosim info' lists the "
            "fields"
        )
    recorded = dict.fromkeys(_recorded(scenario, request.maps), log)
    return scenario.edit(swap={**recorded, **request.swaps}, map=request.maps)


def _recorded(scenario: Scenario, names: Mapping[str, PortNames]) -> list[str]:
    """Return the components that are recorded: those with a mapped output.

    A mapped input belongs to them, or else to the components that drive it.
    """
    ports = WrittenPorts(scenario.tree)
    mapped = ports_in(names)
    recorded = dict.fromkeys(p.component for p in mapped if ports.causality(p) != "input")
    for port in mapped:
        if port.component not in recorded:
            recorded |= dict.fromkeys(scenario.sources(port.whole) or [port.component])
    return list(recorded)
