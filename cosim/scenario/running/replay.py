"""Replay a recording: once, or again and again, each time with other values.

A log of cosim is opened and read once; a recording of another tool is read by every replay.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, final

from cosim.arguments import (
    callable_argument,
    fillable_argument,
    mapping_argument,
    path_argument,
    setting_arguments,
    truth_argument,
    whole_argument,
)
from cosim.core.contracts import Design
from cosim.core.recorders import Memory
from cosim.errors import UsageError, option
from cosim.log import Log
from cosim.log.editing.joining import open_joined
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.swaps import PortNames
from cosim.scenario.recordings.preparing import build_experiment
from cosim.scenario.recordings.recording import (
    LiveView,
    Notice,
    Progress,
    Target,
    check_target,
)
from cosim.scenario.recordings.replay_request import (
    check_replay_target,
    prepared_replay,
    record_replay,
    replay_request,
)
from cosim.scenario.recordings.replaying import ReplayRequest, designs_anew
from cosim.scenario.running.execution import load, run
from cosim.scenario.running.field_replay import check_field_options, with_recorded_components

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus

_LARGE: Final = 2**25  # bytes of rows


class Replays(Protocol):
    """A recording, and how it is replayed."""

    @property
    def label(self) -> str:
        """Its path."""
        ...

    @property
    def source(self) -> Log | None:
        """The log; None: it is of another tool."""
        ...

    @property
    def is_large(self) -> bool:
        """Whether what is replayed takes much memory."""
        ...

    @property
    def changes(self) -> Mapping[str, Any]:
        """What all replays have."""
        ...

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values; raise UsageError if it cannot be run."""
        ...

    def experiment(
        self,
        values: Mapping[str, Any],
        resources: ExitStack,
        unpacked: UnpackedFmus | None = None,
    ) -> Experiment:
        """Build the replay with some values, to run it into a recorder of one's own.

        FMUs are unpacked into ``unpacked`` for all replays; without it, for this one.
        """
        ...

    def check_target(self, out: str | Path | None, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to."""
        ...

    def record(
        self,
        values: Mapping[str, Any],
        target: Target,
        *,
        progress: Progress | None,
        profile: dict[str, float] | None = None,
    ) -> Log | Memory:
        """Replay with some values."""
        ...


@final
@dataclass(frozen=True)
class LogReplays:
    """Replays of a log of cosim."""

    source: Log
    request: ReplayRequest

    @property
    def label(self) -> str:
        """Its path."""
        return self.source.label

    @property
    def is_large(self) -> bool:
        """Whether the log takes much memory."""
        return self.source.row_bytes > _LARGE

    @property
    def changes(self) -> Mapping[str, Any]:
        """What all replays have."""
        return self.request.changes

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values."""
        with ExitStack() as resources:
            experiment = self.experiment(values, resources)
            experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)

    def experiment(
        self,
        values: Mapping[str, Any],
        resources: ExitStack,
        unpacked: UnpackedFmus | None = None,
    ) -> Experiment:
        """Build the replay with some values."""
        return prepared_replay(self.source, self._with(values), resources, unpacked)

    def check_target(self, out: str | Path | None, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to."""
        check_replay_target(self.source, out, force=force)

    def record(
        self,
        values: Mapping[str, Any],
        target: Target,
        *,
        progress: Progress | None,
        profile: dict[str, float] | None = None,
    ) -> Log | Memory:
        """Replay with some values."""
        request = self._with(values)
        return record_replay(self.source, request, target, progress=progress, profile=profile)

    def designs(self) -> dict[str, Design]:
        """Compute the designs that a replay takes from the log anew, to be compared with those."""
        with ExitStack() as resources:
            return designs_anew(self.experiment({}, resources))

    def _with(self, values: Mapping[str, Any]) -> ReplayRequest:
        return replace(self.request, changes={**self.changes, **values})


@final
@dataclass(frozen=True)
class FieldReplays:
    """Replays of a recording of another tool, by a scenario that takes components from it."""

    path: Path
    scenario: Scenario
    changes: Mapping[str, Any]
    block: int | None

    @property
    def label(self) -> str:
        """Its path."""
        return str(self.path)

    @property
    def source(self) -> None:
        """It is no log of cosim."""
        return None

    @property
    def is_large(self) -> bool:
        """Whether it takes much memory: it is read as a whole, as each component takes its own."""
        return False

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values."""
        with ExitStack() as resources:
            experiment = self.experiment(values, resources)
            if experiment.plan is None:
                experiment.graph.prepare(experiment.clock.step_ns)

    def experiment(
        self,
        values: Mapping[str, Any],
        resources: ExitStack,
        unpacked: UnpackedFmus | None = None,
    ) -> Experiment:
        """Build the replay with some values."""
        return build_experiment(self._with(values), resources, self.block, unpacked=unpacked)

    def check_target(self, out: str | Path | None, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to."""
        check_target(out, force=force)

    def record(
        self,
        values: Mapping[str, Any],
        target: Target,
        *,
        progress: Progress | None,
        profile: dict[str, float] | None = None,
    ) -> Log | Memory:
        """Replay with some values."""
        return run(
            self._with(values),
            out=target.out,
            force=target.force,
            block=self.block,
            progress=progress,
            notice=target.notice,
            profile=profile,
            live=target.live,
        )

    def _with(self, values: Mapping[str, Any]) -> Scenario:
        return self.scenario.edit(set={**self.changes, **values})


def replays_of(
    log: str | Path | Log,
    *,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    allow_code: bool = False,
    rerun: bool = False,
    window: tuple[float | None, float | None] | None = None,
    components: Sequence[str] | None = None,
    scenario: str | Path | Scenario | None = None,
    block: int | None = None,
) -> Replays:
    """Return a recording that can be replayed; parameters as of :func:`cosim.replay`.

    Raises
    ------
    UsageError
        If one of them does not go with the others or with the recording.
    """
    if isinstance(log, str | Path) and is_foreign(path_argument("log", log)):
        check_field_options(
            allow_code=allow_code, rerun=rerun, window=window, components=components
        )
        path = path_argument("log", log)
        loaded = scenario if isinstance(scenario, Scenario) or scenario is None else load(scenario)
        recorded = with_recorded_components(loaded, path, swaps=swap, maps=map)
        changes = mapping_argument("set", set)
        return FieldReplays(path, recorded, changes, whole_argument("block", block))
    source = open_joined(log)
    if scenario is not None:
        raise UsageError(
            f"{source.label} has its own scenario; omit {option('scenario')}, which is for "
            "recordings of other tools"
        )
    request = replay_request(
        source,
        set=set,
        swap=swap,
        map=map,
        allow_code=allow_code,
        rerun=rerun,
        window=window,
        components=components,
        block=block,
    )
    return LogReplays(source, request)


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
        replays = replays_of(
            log,
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
        return replay_once(
            replays, out, force=force, progress=progress, notice=notice, profile=profile
        )


def replay_once(
    replays: Replays,
    out: str | Path | None,
    *,
    force: bool,
    progress: Progress | None,
    notice: Notice | None,
    profile: dict[str, float] | None = None,
    live: LiveView | None = None,
) -> Log | Memory:
    """Replay without other values; parameters as of :func:`replay` and :func:`run`."""
    replays.check_target(out, force=force)
    target = Target(out, force, notice=notice, live=live)
    return replays.record({}, target, progress=progress, profile=profile)


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
    is much, in a temporary file.
    """
    if out is not None or not replays.is_large:
        yield replay_once(replays, out, force=force, progress=progress, notice=notice, live=live)
        return
    from cosim.temporary import TemporaryFolder  # most replays need none

    replays.check_target(out, force=force)
    with TemporaryFolder("replay") as folder:
        target = Target(folder / "replay.mcap", live=live)
        yield replays.record({}, target, progress=progress)
