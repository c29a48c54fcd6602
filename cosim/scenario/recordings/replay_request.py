"""What a replay is asked for, checked, and the experiment that follows from it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cosim.arguments import (
    mapping_argument,
    swap_argument,
    texts_argument,
    truth_argument,
    whole_argument,
)
from cosim.core.recorded.signals import warning_texts
from cosim.core.recorders import Memory
from cosim.errors import UsageError, option, warn
from cosim.instants import NANOSECONDS
from cosim.log import Log
from cosim.log.mcap_file.paths import log_path
from cosim.log.mcap_file.rotation import all_parts
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.swaps import PortNames
from cosim.scenario.record import ReplayOrigin, recorded_loop_gains
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.recordings.recording import Progress, Target, check_target, record
from cosim.scenario.recordings.replay_changes import Swaps, check_changes
from cosim.scenario.recordings.replaying import (
    ReplayRequest,
    add_setting_designs,
    rebuilt,
    valid_designs,
)
from cosim.scenario.recordings.window import window_of

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus

_RECORDED: Final = "as recorded"


def replay_request(
    source: Log,
    *,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    allow_code: bool = False,
    rerun: bool = False,
    window: tuple[float | None, float | None] | None = None,
    components: Sequence[str] | None = None,
    block: int | None = None,
) -> ReplayRequest:
    """Return what is asked for; parameters as of :func:`cosim.replay`.

    Raises
    ------
    UsageError
        If one of them is of another type, or does not go with the others or with the log.
    """
    chosen = texts_argument("components", components)
    if chosen == ():
        raise UsageError(
            f"{option('components')}: expected at least one component to compute, or None for "
            "all; got none"
        )
    return ReplayRequest(
        mapping_argument("set", set),
        _swaps_argument(swap, map),
        chosen,
        None if window is None else window_of(source, window),
        truth_argument("allow_code", allow_code),
        whole_argument("block", block),
        truth_argument("rerun", rerun),
    )


def _swaps_argument(
    swap: Mapping[str, str | Path] | None, map: Mapping[str, PortNames] | None
) -> Swaps:
    paths = swap_argument(swap)
    names = mapping_argument("map", map)
    if names and not paths:
        raise UsageError(
            f"expected {option('swap')} with {option('map')}: only a replacement has other port "
            "names"
        )
    return Swaps(paths, names)


def check_replay_target(source: Log, out: str | Path | None, *, force: bool) -> None:
    """Refuse a path that the log of a replay cannot be written to.

    Raises
    ------
    UsageError
        If it is the log that is replayed, another file of that where it was rotated, or as from
        ``check_target``.
    """
    if out is not None:
        target = os.path.realpath(log_path(out))
        if target == os.path.realpath(source.path):
            raise UsageError(f"{out} is the log being replayed; choose another path")
        if target in map(os.path.realpath, all_parts(source.path)):
            raise UsageError(
                f"{out} is one of the rotated files of the log being replayed; choose another path"
            )
    check_target(out, force=force)


def prepared_replay(
    source: Log,
    request: ReplayRequest,
    resources: ExitStack,
    unpacked: UnpackedFmus | None = None,
) -> Experiment:
    """Build the replay of a log; FMUs that take the places of others are unpacked once for all.

    Raises
    ------
    LogError
        If the log is no log of a scenario, or does not fit its scenario.
    ScenarioError
        With every problem of the changed scenario.
    UsageError
        If the recording cannot follow what is changed.
    """
    swaps = request.swaps
    experiment = rebuilt(source, resources, request, unpacked)
    check_changes(experiment, recorded_document(source), request.all_changes, swaps)
    designs = valid_designs(experiment, source, replaced=swaps.paths)
    copied = experiment.recorded
    experiment.graph.take_solutions(source, copied)
    specs = experiment.scenario.specs
    uncomputed = experiment.uncomputed
    window = request.window
    origin = ReplayOrigin(
        os.path.relpath(source.path),
        source.recorded_hash or source.content_hash(),
        copied,
        window=None if window is None else (window.begin, window.end),
        left_out=tuple(
            name for name in copied if specs[name].computable and name not in uncomputed
        ),
        absent=dict(experiment.absent),
        uncomputed=dict(uncomputed),
    )
    gains = () if request.changes or swaps.paths else recorded_loop_gains(source)
    for name, text in list(_recorded_warnings(experiment, source)):
        experiment.built.warn(name, text)
    experiment.origin = origin
    experiment.designs = designs
    experiment.gains = gains
    add_setting_designs(experiment, source, designs)
    return experiment


def _recorded_warnings(experiment: Experiment, source: Log) -> Iterator[tuple[str, str]]:
    """Yield what the run warned of that is not found again: of what is copied, and of the whole."""
    again = experiment.graph.components.keys() - set(experiment.recorded)
    for time_ns, _, name, text in source.warnings:
        is_left = name in again or name in experiment.absent or name == "run"
        if is_left or (name, text) in experiment.warnings:
            continue
        if not text.startswith(_RECORDED):
            text = f"{_RECORDED} at t = {time_ns / NANOSECONDS} s: {text}"
        yield name, text


def record_replay(
    source: Log,
    request: ReplayRequest,
    target: Target,
    *,
    progress: Progress | None,
    profile: dict[str, float] | None = None,
) -> Log | Memory:
    """Replay a log and return the recording: the log file if the target has a path.

    Raises
    ------
    CosimError
        As from :func:`prepared_replay`; RunError where it cannot go on.
    """
    beside = None if request.window is None else request.window.beside
    with ExitStack() as resources:
        experiment = prepared_replay(source, request, resources)
        recorded = record(experiment, target, progress=progress, profile=profile, beside=beside)
    warn(warning_texts(recorded.warnings))
    return recorded
