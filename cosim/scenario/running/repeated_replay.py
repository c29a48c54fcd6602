"""One recording that is replayed again and again, each time with other values.

Every replay is checked by building and preparing it. A log of cosim is opened and read once; a
recording of another tool is read by every replay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, final

from cosim.arguments import mapping_argument, path_argument
from cosim.core.recorders import Memory
from cosim.errors import UsageError, option
from cosim.log import Log, open_log
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.document.edits import short
from cosim.scenario.document.swap import PortNames
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.scenario.recordings.recording import Progress, Target
from cosim.scenario.recordings.replay_request import (
    ReplayRequest,
    check_replay_target,
    prepared_replay,
    record_replay,
    replay_request,
)
from cosim.scenario.running.execution import load, run
from cosim.scenario.running.field_replay import check_field_options, with_recorded_components


class RepeatedReplay(Protocol):
    """A recording, and how it is replayed."""

    @property
    def label(self) -> str:
        """Its path."""
        ...

    @property
    def changes(self) -> Mapping[str, Any]:
        """What all replays have."""
        ...

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values; raise UsageError if it cannot be run."""
        ...

    def check_target(self, path: Path, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to."""
        ...

    def record(
        self, values: Mapping[str, Any], target: Target, progress: Progress | None
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
    def changes(self) -> Mapping[str, Any]:
        """What all replays have."""
        return self.request.changes

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values."""
        with ExitStack() as resources:
            experiment = prepared_replay(self.source, self._with(values), resources)
            experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)

    def check_target(self, path: Path, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to."""
        check_replay_target(self.source, path, force=force)

    def record(
        self, values: Mapping[str, Any], target: Target, progress: Progress | None
    ) -> Log | Memory:
        """Replay with some values."""
        return record_replay(self.source, self._with(values), target, progress=progress)

    def _with(self, values: Mapping[str, Any]) -> ReplayRequest:
        return replace(self.request, changes={**self.changes, **values})


@final
@dataclass(frozen=True)
class FieldReplays:
    """Replays of a recording of another tool, by a scenario that takes components from it."""

    path: Path
    scenario: Scenario
    changes: Mapping[str, Any]

    @property
    def label(self) -> str:
        """Its path."""
        return str(self.path)

    def check(self, values: Mapping[str, Any]) -> None:
        """Build and prepare the replay with some values."""
        with ExitStack() as resources:
            experiment = build_experiment(self._with(values), resources, None)
            if experiment.plan is None:
                experiment.graph.prepare(experiment.clock.step_ns)

    def check_target(self, path: Path, *, force: bool) -> None:
        """Refuse a path that the log of a replay cannot be written to."""
        from cosim.scenario.recordings.recording import check_target

        check_target(path, force=force)

    def record(
        self, values: Mapping[str, Any], target: Target, progress: Progress | None
    ) -> Log | Memory:
        """Replay with some values."""
        return run(self._with(values), out=target.out, force=target.force, progress=progress)

    def _with(self, values: Mapping[str, Any]) -> Scenario:
        return self.scenario.edit(set={**self.changes, **values})


def repeated_replay(
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
) -> RepeatedReplay:
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
        return FieldReplays(path, recorded, mapping_argument("set", set))
    source = log if isinstance(log, Log) else open_log(log)
    if scenario is not None:
        raise UsageError(
            f"{source.label} carries its own scenario; leave out {option('scenario')}, which is "
            "for recordings of other tools"
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
    )
    return LogReplays(source, request)


def check_varied(changes: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Check that nothing is varied that is set, too.

    Raises
    ------
    UsageError
        If something is.
    """
    known = {short(key) for key in changes}
    for key in values:
        if short(key) in known:
            raise UsageError(
                f"found both {option('set', short(key))} and {option('vary', short(key))}; needed "
                "one of them"
            )
