"""The experiment of a replay: the scenario of a log, with what is taken from the log."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels, partial_of
from cosim.core.recording import CompleteRecording, SignalEvent
from cosim.errors import LogError, ScenarioError, UsageError, option
from cosim.instants import NANOSECONDS
from cosim.log import Log
from cosim.log.comparison.event_difference import OF_COMPONENTS
from cosim.log.contents.metadata import decode_design
from cosim.scenario.building.build import Builder, read
from cosim.scenario.building.experiment import Experiment, fingerprint
from cosim.scenario.document.document import Document
from cosim.scenario.document.swaps import PortNames, component_table, is_map_key
from cosim.scenario.kinds.build_record import Origins, RecordedFmu
from cosim.scenario.record import (
    MEANS,
    CodeRecord,
    ReplayOrigin,
    component_metadata,
    component_record,
    recorded_loop_gains,
)
from cosim.scenario.recordings.recorded_scenario import (
    check_clock,
    check_end,
    check_whole,
    load_rows,
    recorded_document,
)
from cosim.scenario.recordings.replay_changes import check_changes, replay_changes
from cosim.scenario.recordings.replayed_part import ReplayedPart, replayed_part

if TYPE_CHECKING:
    from cosim.scenario.recordings.window import ReplayWindow

_RECORDED: Final = "as recorded"


def texts_in(value: Any) -> set[str]:
    """Return the texts in a value and in all tables and lists inside it."""
    if isinstance(value, str):
        return {value}
    if isinstance(value, Mapping):
        value = list(value.values())
    texts: set[str] = set()
    if isinstance(value, list | tuple):
        texts = texts.union(*map(texts_in, value))
    return texts


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """How a log is to be replayed.

    Parameters
    ----------
    changes : mapping of dotted key to value
    swap : mapping of component name to path
        Components that are replaced.
    maps : mapping of port to names
        Ports that have other names in these.
    components : tuple of str or None
        The only ones to compute; None: all that can be.
    window : ReplayWindow or None
        What is recorded of it; None: all.
    allow_code : bool
        Whether the code of users' classes may run that the log names, and that of its FMUs.
    block : int or None
        Communication steps in a block.
    rerun : bool
        Whether plants are computed, too.
    """

    changes: Mapping[str, Any] = field(default_factory=dict)
    swap: Mapping[str, str | Path] = field(default_factory=dict)
    maps: Mapping[str, PortNames] = field(default_factory=dict)
    components: tuple[str, ...] | None = None
    window: ReplayWindow | None = None
    allow_code: bool = False
    block: int | None = None
    rerun: bool = False

    @property
    def all_changes(self) -> Mapping[str, Any]:
        """The changes, and the end of the window.

        Raises
        ------
        UsageError
            If both say where the replay ends.
        """
        if self.window is None:
            return self.changes
        if "scenario.stop" in self.changes:
            raise UsageError(f"expected {option('set', 'scenario.stop')} or a window, got both")
        return {**self.changes, "scenario.stop": self.window.end}


AS_RECORDED: Final = ReplayRequest()


def prepared_replay(
    source: Log,
    request: ReplayRequest,
    resources: ExitStack,
) -> Experiment:
    """Build the replay of a log.

    Raises
    ------
    LogError
        If the log is no log of a scenario, or does not fit its scenario.
    ScenarioError
        With every problem of the changed scenario.
    UsageError
        If the recording cannot follow what is changed.
    """
    experiment = rebuilt(source, resources, request)
    document = recorded_document(source)
    check_changes(experiment, document, request.all_changes, request.swap, request.maps)
    copied = experiment.recorded
    experiment.graph.take_solutions(source, copied)
    specs = experiment.scenario.specs
    uncomputed = dict(experiment.uncomputed)
    window = request.window
    if window is not None:
        from cosim.scenario.recordings.records import recorded_channels  # rarely needed
        from cosim.scenario.recordings.window import check_begin

        check_begin(window, recorded_channels(experiment), source.grid)
    experiment.origin = ReplayOrigin(
        os.path.relpath(source.path),
        source.recorded_hash or source.content_hash(),
        copied,
        window=None if window is None else (window.begin, window.end),
        left_out=tuple(n for n in copied if specs[n].computable and n not in uncomputed),
        absent=dict(experiment.absent),
        uncomputed=uncomputed,
    )
    for name, text in list(_recorded_warnings(experiment, source)):
        experiment.built.warn(name, text)
    experiment.designs = designs = _valid_designs(experiment, source, replaced=request.swap)
    if not (request.changes or request.swap):
        experiment.gains = recorded_loop_gains(source)
    if experiment.settings:
        from cosim.scenario.building.actions import recorded_designs

        recorded = recorded_designs(source).items()
        taken = {key: design for key, design in recorded if key.partition(" ")[2] in designs}
        experiment.setting_designs = experiment.prepare_settings(taken)
    return experiment


def rebuilt(
    source: CompleteRecording,
    resources: ExitStack,
    request: ReplayRequest = AS_RECORDED,
) -> Experiment:
    """Build the scenario of a log again, with its recorded components; only the log is needed.

    Parameters
    ----------
    source : CompleteRecording
    resources : ExitStack
        Closes what was opened.
    request : ReplayRequest
        What is changed or computed; whether the recorded components allow changes is for
        :func:`check_changes`. What these name may always run its code.

    Raises
    ------
    LogError
        If the log has no scenario or no steps, or does not fit its scenario.
    UsageError
        If a change is about the communication points, or goes beyond the recording; or one of
        ``components`` cannot be computed.
    ScenarioError
        With every problem of the changed scenario.
    """
    check_whole(source)
    check_end(source)
    wanted = request.all_changes
    swap = request.swap
    changes = replay_changes(source, wanted)
    document = recorded_document(source).with_swaps(swap, request.maps).with_changes(changes)
    scenario = read(document)
    problems = scenario.problems
    if not request.maps:
        # recorded ports have the scenario's names: a map need not fit changed connections
        problems = tuple((key, text) for key, text in problems if not is_map_key(key))
    named = texts_in(wanted) | _texts_of_swaps(document, swap)
    specs = dict(scenario.specs)
    for name, spec in scenario.specs.items():
        is_allowed = spec.code is not None and (request.allow_code or spec.code in named)
        if is_allowed or name in swap:
            specs[name] = spec.with_code()
    fmus_again: Mapping[str, RecordedFmu] = {}
    if request.rerun:
        from cosim.scenario.recordings.embedding import recorded_fmus, rerun_specs  # rarely needed

        again = rerun_specs(source, specs, swap, allow_code=request.allow_code)
        fmus_again = recorded_fmus(source, again, resources)
        specs |= again
    scenario = replace(scenario, specs=specs, problems=problems)
    part = replayed_part(source, scenario, request.components)
    load_rows(source, [name for name in part.copied if name in source.channels])
    declared = declared_channels(source.channels)
    builder = Builder(
        part.scenario,
        resources,
        Origins(
            recording=part.recording,
            named=named,
            left_out=part.left_out,
            fmus_again=fmus_again,
        ),
        replaced={name: declared[name].interface for name in swap if name in declared},
        beside=scenario,
    )
    experiment = _compared(builder, source, [name for name in swap if name in declared])
    experiment.clock = replace(experiment.clock, block=request.block)
    if request.rerun:
        from cosim.scenario.recordings.embedding import add_recorded_reports

        add_recorded_reports(experiment, source)
    _add_part(experiment, part)
    if part.recording is not source and not (wanted or swap):
        _check_held(experiment, source)
    check_clock(experiment.clock, source)
    if "scenario.until" not in changes:  # it ends where the recording does
        experiment.until = None
    _add_events(experiment, builder, source)
    return experiment


def _texts_of_swaps(document: Document, swap: Collection[str]) -> set[str]:
    """Return the texts in the tables of the components that take the places of others.

    Raises
    ------
    ScenarioError
        If a path is that of no component.
    """
    texts: set[str] = set()
    for name in swap:
        try:
            texts |= texts_in(component_table(name, document.swaps[name]))
        except UsageError as error:
            raise ScenarioError(f"{option('swap', name)}: {error}") from error
    return texts


def _compared(builder: Builder, source: CompleteRecording, swapped: Collection[str]) -> Experiment:
    """Build an experiment, with reports on how swapped components compare with the recorded ones.

    Raises
    ------
    ScenarioError
        With every problem of the scenario, and the ports that may have been meant.
    """
    names = [name for name in swapped if name in builder.components]
    if not names:
        return builder.experiment()
    from cosim.scenario.recordings.recording import with_reports
    from cosim.scenario.recordings.swap_comparison import compare_with_recorded
    from cosim.scenario.recordings.swap_report import SwapReports

    reports = SwapReports({name: compare_with_recorded(builder, source, name) for name in names})
    try:
        return with_reports(builder.experiment(), reports)
    except ScenarioError as error:
        raise ScenarioError("\n".join([str(error), *reports.hints])) from error


def _add_part(experiment: Experiment, part: ReplayedPart) -> None:
    """Fill in what is not in an experiment, and warn of that."""
    for name, reason in {**part.uncomputed, **part.absent}.items():
        verb = "not in this replay" if name in part.absent else "copied, not computed"
        experiment.built.warn(name, f"{verb}: {reason}")
    experiment.absent = part.absent
    experiment.uncomputed = part.uncomputed


def _check_held(experiment: Experiment, source: CompleteRecording) -> None:
    """Check that what is computed takes its inputs as it did in the run.

    Raises
    ------
    LogError
        If an input is held that was interpolated, or the other way round; or an FMU gets the mean
        of one over a step that had the latest value.
    """
    masks = source.held
    graph = experiment.graph
    all_means = graph.mean_inputs
    for name in experiment.scenario.specs:
        if name in experiment.recorded:
            continue
        means = component_metadata(source, name).get(MEANS)  # older logs tell nothing
        own_means = json.dumps(all_means.get(name, []))
        has_other_mask = not np.array_equal(masks[name], graph.held[name])
        if has_other_mask or means not in (None, own_means):
            raise LogError(
                f"{source.label}: {name!r} cannot be computed as in the run: how its inputs "
                "change within a step depends on signals that the log does not have"
            )


def _add_events(experiment: Experiment, builder: Builder, source: CompleteRecording) -> None:
    """Fill in the events of the recording, and what sets parameters in them.

    What jumps by itself does so again. Of a partial log a copied component need not have all of its
    signals: nothing that is computed rests on the others.
    """
    is_partial = partial_of(source.channels) is not None

    def happens(event: SignalEvent) -> bool:
        """Return whether a replay has what an event is about."""
        if not is_partial:
            return True
        port = Port.parse(event.signal)
        if port.component not in experiment.graph.components:
            return False
        known = experiment.graph.components[port.component].interface.by_name
        return event.cause in OF_COMPONENTS or port.find(known) is not None

    events = [event for event in source.events() if event.cause != "jump"]
    experiment.events = tuple(filter(happens, events))
    experiment.settings = {}
    if any(event.cause == "set" for event in experiment.events):
        from cosim.scenario.building.actions import SettingBuilder, recorded_settings

        making = SettingBuilder(experiment.scenario, builder.context, builder.components)
        experiment.settings = recorded_settings(making, experiment.events, experiment.recorded)


def _recorded_warnings(experiment: Experiment, source: Log) -> Iterator[tuple[str, str]]:
    """Yield what the run warned of that is not found again: of what is copied, and of the whole."""
    again = experiment.graph.components.keys() - set(experiment.recorded)
    for time_ns, _, name, text in source.warnings:
        is_left = name in again or name in experiment.absent or name == "run"
        if is_left or (name, text) in experiment.built.warnings:
            continue
        if not text.startswith(_RECORDED):
            text = f"{_RECORDED} at t = {time_ns / NANOSECONDS} s: {text}"
        yield name, text


def _valid_designs(
    experiment: Experiment, source: Log, *, replaced: Collection[str]
) -> dict[str, Design]:
    """Return the recorded designs that still hold: those that rest on nothing that changed.

    Those of ``replaced`` components do not.
    """
    recorded_designs = source.designs
    recorded_masks = source.held

    def holds(name: str) -> bool:
        if name in replaced:
            return False
        if name in experiment.recorded:
            return True
        current = fingerprint(experiment.scenario, name, experiment.built.reads[name])
        if component_metadata(source, name).get("fingerprint") != current:
            return False
        if experiment.scenario.specs[name].code is not None:
            code = experiment.built.metadata.get(name, {}).get("code")
            recorded = component_record(source, name).code
            if code is None or CodeRecord.model_validate(code) != recorded:
                return False
        held = experiment.graph.held[name]
        return name in recorded_masks and np.array_equal(recorded_masks[name], held)

    return {name: recorded_designs[name] for name in experiment.scenario.specs if holds(name)}


def designs_anew(experiment: Experiment) -> dict[str, Design]:
    """Compute the designs that a replay takes from its log, by the scenario alone.

    Returns
    -------
    dict of name to Design
        By component; of those that take the places of others in the run, by time and component.
    """
    step_ns = experiment.clock.step_ns
    anew = {}
    for name, recorded in (experiment.designs or {}).items():
        if recorded and name not in experiment.recorded:
            anew[name] = experiment.graph.prepare_one(name, step_ns, {})
    if experiment.setting_designs:
        texts = experiment.prepare_settings({})
        anew |= {key: decode_design(text) for key, text in texts.items()}
    return anew
