"""The experiment of a replay: the scenario of a log, with what is taken from the log."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels, partial_of
from cosim.core.recording import CompleteRecording, SignalEvent
from cosim.core.signals import Interface
from cosim.errors import LogError, ScenarioError, UsageError, flag, listing, nearest, option, quoted
from cosim.log import Log
from cosim.log.comparison.event_difference import OF_COMPONENTS
from cosim.log.contents.metadata import decode_design
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.building.experiment import Experiment, fingerprint
from cosim.scenario.building.parsing import Scenario, read
from cosim.scenario.document.swaps import is_map_key
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.build_record import Origins, RecordedFmu
from cosim.scenario.record import MEANS, CodeRecord, component_metadata, component_record
from cosim.scenario.recordings.embedding import recorded_fmus
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.recordings.recorded_span import check_clock, check_whole, load_rows
from cosim.scenario.recordings.replay_changes import NO_SWAPS, Swaps, replay_changes
from cosim.scenario.recordings.rerunning import add_recorded_reports, fmu_paths, rerun_specs

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus
    from cosim.scenario.recordings.replayed_part import ReplayedPart
    from cosim.scenario.recordings.window import ReplayWindow


def texts_in(value: Any) -> set[str]:
    """Return the texts in a value and in all tables and lists inside it."""
    if isinstance(value, str):
        return {value}
    texts: set[str] = set()
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            texts |= texts_in(item)
    return texts


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """How a log is to be replayed.

    Parameters
    ----------
    changes : mapping of dotted key to value
    swaps : Swaps
    components : tuple of str or None
        The only ones to compute; None: all that can be.
    window : ReplayWindow or None
        What is recorded of it; None: all.
    allow_code : bool
        Whether the code of users' classes may run that the log names, and that of its FMUs.
    rerun : bool
        Whether plants are computed, too.
    block : int or None
        Communication steps in a block.
    """

    changes: Mapping[str, Any] = field(default_factory=dict)
    swaps: Swaps = NO_SWAPS
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


def rebuilt(
    source: CompleteRecording,
    resources: ExitStack,
    request: ReplayRequest = AS_RECORDED,
    unpacked: UnpackedFmus | None = None,
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
    unpacked : UnpackedFmus, optional
        Where FMUs are unpacked and loaded for all builds of a process.

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
    wanted = request.all_changes
    swaps = request.swaps
    changes = replay_changes(source, wanted)
    document = swaps.applied(recorded_document(source)).with_changes(changes)
    scenario, problems = read(document, parse)
    if not swaps.maps:
        # recorded ports have the scenario's names: a map need not fit changed connections
        problems = [(key, text) for key, text in problems if not is_map_key(key)]
    named = texts_in(wanted) | texts_in(swaps.tables(document))
    specs = _with_code(scenario.specs, named, allow_code=request.allow_code)
    fmus_again: Mapping[str, RecordedFmu] = {}
    if request.rerun:
        again = rerun_specs(source, specs, swaps.paths, allow_code=request.allow_code)
        fmus_again = recorded_fmus(source, fmu_paths(again), resources)
        specs |= again
    specs |= {name: specs[name].with_code() for name in swaps.paths if name in specs}
    scenario = replace(scenario, specs=specs)
    left_out = () if request.components is None else _left_out(scenario, request.components)
    part = None
    if partial_of(source.channels) is not None:
        part = _part(source, scenario, left_out, request.components or ())
        left_out = tuple(name for name in part.copied if scenario.specs[name].computable)
    runs = scenario if part is None else part.scenario
    origins = Origins(
        recording=source if part is None else part.recording,
        named=named,
        left_out=left_out,
        fmus_again=fmus_again,
        unpacked=unpacked,
    )
    copied = [
        name
        for name, spec in runs.specs.items()
        if origins.copies(name, computable=spec.computable)
    ]
    load_rows(source, [name for name in copied if name in source.channels])
    builder = Builder(
        runs,
        resources,
        origins,
        problems=problems,
        block=request.block,
        replaced=_replaced(source, swaps.paths),
        beside=scenario,
    )
    experiment = _compared(builder, source, swaps.paths)
    if request.rerun:
        add_recorded_reports(experiment, source)
    if part is not None:
        _add_absent(experiment, part)
        if not wanted and not swaps.paths:
            _check_held(experiment, source)
    check_clock(experiment.clock, source)
    if "scenario.until" not in changes:  # it ends where the recording does
        experiment.until = None
    _add_events(experiment, builder, source)
    return experiment


def _compared(builder: Builder, source: CompleteRecording, swapped: Iterable[str]) -> Experiment:
    """Build an experiment, with reports on how swapped components compare with the recorded ones.

    Raises
    ------
    ScenarioError
        With every problem of the scenario, and the ports that may have been meant.
    """
    declared = declared_channels(source.channels)
    names = [n for n in swapped if n in builder.components and n in declared]
    if not names:
        return builder.experiment()
    from cosim.scenario.recordings.preparing import with_reports
    from cosim.scenario.recordings.swap_comparison import compare_with_recorded
    from cosim.scenario.recordings.swap_report import SwapReports

    reports = SwapReports({name: compare_with_recorded(builder, source, name) for name in names})
    try:
        return with_reports(builder.experiment(), reports)
    except ScenarioError as error:
        raise ScenarioError("\n".join([str(error), *reports.hints])) from error


def _add_absent(experiment: Experiment, part: ReplayedPart) -> None:
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
    all_means = experiment.graph.mean_inputs
    for name in experiment.scenario.specs:
        if name in experiment.recorded:
            continue
        means = component_metadata(source, name).get(MEANS)  # older logs tell nothing
        own_means = json.dumps(all_means.get(name, []))
        has_other_mask = not np.array_equal(masks[name], experiment.graph.held[name])
        if has_other_mask or means not in (None, own_means):
            raise LogError(
                f"{source.label}: {name!r} cannot be computed as in the run: how its inputs "
                "change within a step depends on signals that the log does not have"
            )


def _part(
    source: CompleteRecording,
    scenario: Scenario,
    left_out: Collection[str],
    components: Sequence[str],
) -> ReplayedPart:
    """Return what a replay has of a partial log.

    Raises
    ------
    UsageError
        If one of the components that were chosen cannot be computed from it.
    LogError
        If nothing can.
    """
    from cosim.scenario.recordings.replayed_part import replayed_part  # rarely needed

    part = replayed_part(source, scenario, left_out=left_out)
    for name in components:
        if name in part.uncomputed:
            raise UsageError(
                f"{name!r} cannot be computed: {part.uncomputed[name]}; the log is partial, it was "
                f"recorded with {part.selection}"
            )
    return part


def _replaced(source: CompleteRecording, names: Iterable[str]) -> dict[str, Interface]:
    """Return the interfaces of components that are replaced, as they were recorded."""
    channels = declared_channels(source.channels)
    return {name: channels[name].interface for name in names if name in channels}


def _add_events(experiment: Experiment, builder: Builder, source: CompleteRecording) -> None:
    """Fill in the events of the recording, and what sets parameters in them.

    What jumps by itself does so again.
    """
    events = tuple(event for event in source.events() if _happens(experiment, event))
    experiment.events = events
    experiment.settings = {}
    if any(event.cause == "set" for event in events):
        from cosim.scenario.building.actions import SettingBuilder, recorded_settings

        making = SettingBuilder(experiment.scenario, builder.context, builder.components)
        experiment.settings = recorded_settings(making, events, experiment.recorded)


def _happens(experiment: Experiment, event: SignalEvent) -> bool:
    """Return whether a replay does again what it has of an event; what jumps does so by itself."""
    if event.cause == "jump" or not (experiment.uncomputed or experiment.absent):
        return event.cause != "jump"
    port = Port.parse(event.signal)
    if port.component not in experiment.graph.components:
        return False
    known = experiment.graph.components[port.component].interface.by_name
    return event.cause in OF_COMPONENTS or port.find(known) is not None


def add_setting_designs(
    experiment: Experiment, source: CompleteRecording, designs: Mapping[str, Design]
) -> None:
    """Prepare the components that take the places of others, with designs of the recording.

    ``designs`` are those of the components themselves that still hold.
    """
    if not experiment.settings:
        return
    from cosim.scenario.building.actions import prepare_settings, recorded_designs

    taken = {}
    for key, design in recorded_designs(source).items():
        if key.partition(" ")[2] in designs:
            taken[key] = design
    step_ns = experiment.clock.step_ns
    experiment.setting_designs = prepare_settings(
        experiment.graph, step_ns, experiment.settings, taken
    )


def _with_code(specs: Mapping[str, Kind], named: Set[str], *, allow_code: bool) -> dict[str, Kind]:
    """Return the components, of which those may run their code that are allowed to or named."""
    result = {}
    for name, spec in specs.items():
        is_allowed = spec.code is not None and (allow_code or spec.code in named)
        result[name] = spec.with_code() if is_allowed else spec
    return result


def _left_out(scenario: Scenario, components: Sequence[str]) -> tuple[str, ...]:
    """Return the components that are copied although they could be computed.

    Raises
    ------
    UsageError
        If there is no component of such a name, or it cannot be computed from a log.
    """
    computable = [name for name, spec in scenario.specs.items() if spec.computable]
    for name in components:
        if name not in scenario.specs:
            raise UsageError(
                f"the log has no component {quoted(name)}; {nearest(name, scenario.specs)}"
            )
        if name not in computable:
            raise UsageError(
                f"{name!r} cannot be computed, as a replay takes it from the log: "
                f"{_why_recorded(scenario.specs[name])}; available: {listing(computable, 100)}"
            )
    return tuple(name for name in computable if name not in components)


def _why_recorded(spec: Kind) -> str:
    """Return why a component cannot be computed from a log."""
    if spec.code is not None:
        return f"{flag('allow_code')} allows its code to run"
    return f"{flag('rerun')} computes it" if spec.is_rerun else "its file is not part of the log"


def valid_designs(
    experiment: Experiment, source: Log, *, replaced: Collection[str] = ()
) -> dict[str, Design]:
    """Return the recorded designs that still hold: those that rest on nothing that changed.

    Those of ``replaced`` components do not.
    """
    designs = {}
    recorded_designs = source.designs
    recorded_masks = source.held
    for name, spec in experiment.scenario.specs.items():
        if name in replaced:
            continue
        recorded = component_metadata(source, name)
        current = fingerprint(experiment.scenario, name, experiment.built.reads[name])
        same_tables = recorded.get("fingerprint") == current
        held = experiment.graph.held[name]
        same_code = spec.code is None or _same_code(experiment, source, name)
        same_hold = name in recorded_masks and np.array_equal(recorded_masks[name], held)
        if name in experiment.recorded or (same_tables and same_code and same_hold):
            designs[name] = recorded_designs[name]
    return designs


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
        from cosim.scenario.building.actions import prepare_settings

        texts = prepare_settings(experiment.graph, step_ns, experiment.settings, {})
        anew |= {key: decode_design(text) for key, text in texts.items()}
    return anew


def _same_code(experiment: Experiment, source: Log, name: str) -> bool:
    """Return whether a component was built from the code that its recorded run had."""
    code = experiment.metadata.get(name, {}).get("code")
    recorded = component_record(source, name).code
    return code is not None and CodeRecord.model_validate(code) == recorded
