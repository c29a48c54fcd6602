"""What a replay takes from a log, and which changes its recorded components allow."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.core.clock import Clock
from cosim.core.contracts import Design
from cosim.core.partial import declared_channels, partial_of
from cosim.core.port import Port
from cosim.core.recorded_run import SCENARIO_FILE
from cosim.core.recording import CompleteRecording, SignalEvent
from cosim.core.signals import Interface
from cosim.core.stepping.actions import Action
from cosim.errors import (
    LogError,
    ScenarioError,
    UsageError,
    command,
    flag,
    listing,
    nearest,
    option,
    quoted,
)
from cosim.log import Log
from cosim.log.comparison.event_difference import OF_COMPONENTS
from cosim.log.contents.metadata import json_table
from cosim.log.contents.result import PARTIAL_STATUS
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.fingerprint import fingerprint
from cosim.scenario.context.fmus import NONE_AGAIN, RecordedFmu
from cosim.scenario.document.document import Document
from cosim.scenario.document.edits import ACTIONS, short
from cosim.scenario.document.swap import PortNames, component_table, is_map_key
from cosim.scenario.kinds import KINDS, Kind
from cosim.scenario.parsing import Scenario, read
from cosim.scenario.recorded_metadata import (
    component_metadata,
    component_record,
    recorded_window,
    replay_origin,
    run_metadata,
)
from cosim.scenario.recorded_tables import (
    CodeRecord,
)
from cosim.scenario.recordings.embedding import recorded_fmus
from cosim.scenario.recordings.rerunning import fmu_paths, rerun_specs, with_recorded_reports

if TYPE_CHECKING:
    from cosim.scenario.recordings.replayed_part import ReplayedPart


@dataclass(frozen=True, slots=True)
class Swaps:
    """Components that a replay replaces.

    Parameters
    ----------
    paths : mapping of component name to path
    maps : mapping of port to names
        Ports that have other names there.
    """

    paths: Mapping[str, str | Path]
    maps: Mapping[str, PortNames]

    def applied(self, document: Document) -> Document:
        """Return a document with them.

        Raises
        ------
        UsageError
            If a path is none, or what a port is mapped to no name.
        """
        return document.with_swaps(self.paths, self.maps) if self.paths or self.maps else document

    def tables(self, document: Document) -> dict[str, dict[str, Any]]:
        """Return the tables of the components that take the places of others in a document."""
        tables = {}
        for name in self.paths:
            with suppress(UsageError):  # a problem of the scenario, which reports it
                tables[name] = component_table(name, document.swaps[name])
        return tables


NO_SWAPS: Final = Swaps({}, {})
EVERYWHERE = {  # what matters to all inputs
    "scenario.input_interpolation",
    "scenario.coupling",
    "scenario.iterations",
    "scenario.substeps",
}
NO_CHANGES: Final[Mapping[str, Any]] = MappingProxyType({})
_TABLES = ("components", "models", "connections")


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


def recorded_document(log: CompleteRecording) -> Document:
    """Return the scenario of a log.

    Raises
    ------
    LogError
        If the log carries none.
    """
    edits = run_metadata(log).get("edits")
    if SCENARIO_FILE not in log.attachments or edits is None:
        raise LogError(
            f"the log carries no {SCENARIO_FILE}; needed a log that {command('run')} wrote"
        )
    try:
        text = log.attachment(SCENARIO_FILE).decode()
        document = Document.recorded(text, edits, Path.cwd())
        return replace(document, foreign_kinds=_foreign_kinds(log))
    except ValueError as error:
        raise LogError(f"{log.label}: its scenario cannot be understood: {error}") from error


def _foreign_kinds(log: CompleteRecording) -> frozenset[str]:
    """Return the kinds of a log that are not cosim's: those of its components of a user's class.

    The packages that declared them need not be installed where the log is read.
    """
    kinds = set()
    for name in declared_channels(log.channels):
        texts = component_metadata(log, name)
        # the texts of thousands of components take long to be checked
        if '"code"' in texts.get("metadata", "") and component_record(log, name).code is not None:
            table = json_table(texts.get("table", "{}"))
            kinds.add(str(table.get("kind")))
    return frozenset(kinds.difference(KINDS))


def recorded_stop(log: CompleteRecording) -> float:
    """Return where the scenario of a log ends [s], which its run need not have reached.

    Raises
    ------
    LogError
        If the log carries none.
    ScenarioError
        If that is no TOML.
    """
    scenario, _ = read(recorded_document(log), parse)
    return scenario.file.scenario.stop


def replay_changes(source: CompleteRecording, wanted: Mapping[str, Any]) -> dict[str, Any]:
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
    for key in changes:
        if key.partition(".")[0] == ACTIONS:
            raise UsageError(
                f"{option('set', key)}: a replay follows the actions that were recorded; run the "
                "scenario to change them"
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


def rebuilt(
    source: CompleteRecording,
    resources: ExitStack,
    wanted: Mapping[str, Any] = NO_CHANGES,
    block: int | None = None,
    *,
    allow_code: bool = False,
    rerun: bool = False,
    components: Sequence[str] | None = None,
    swaps: Swaps = NO_SWAPS,
) -> Experiment:
    """Build the scenario of a log again, with its recorded components; only the log is needed.

    Parameters
    ----------
    source : CompleteRecording
    resources : ExitStack
        Closes what was opened.
    wanted : mapping of dotted key to value, optional
        Changes; whether the recorded components allow them is for :func:`check_changes`.
    block : int, optional
        Fixed number of communication steps in a block.
    allow_code : bool
        Compute the components of user's classes that the log names, which runs their code. What
        ``wanted`` names may always run.
    rerun : bool
        Compute plants too: by their models, and with ``allow_code`` by the FMUs that the run had.
    components : sequence of str, optional
        The only ones to compute; the others are taken from the log. None: all that can be.
    swaps : Swaps
        Components to replace by others, which are computed.

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
    _check_whole(source)
    changes = replay_changes(source, wanted)
    document = swaps.applied(recorded_document(source)).with_changes(changes)
    scenario, problems = read(document, parse)
    if not swaps.maps:
        # recorded ports have the scenario's names: a map need not fit changed connections
        problems = [(key, text) for key, text in problems if not is_map_key(key)]
    named = texts_in(wanted) | texts_in(swaps.tables(document))
    specs = _with_code(scenario.specs, named, allow_code=allow_code)
    fmus_again: Mapping[str, RecordedFmu] = NONE_AGAIN
    if rerun:
        again = rerun_specs(source, specs, swaps.paths, allow_code=allow_code)
        fmus_again = recorded_fmus(source, fmu_paths(again), resources)
        specs |= again
    specs |= {name: specs[name].with_code() for name in swaps.paths if name in specs}
    scenario = replace(scenario, specs=specs)
    left_out = () if components is None else _left_out(scenario, components)
    part = None
    if partial_of(source.channels) is not None:
        part = _part(source, scenario, left_out, components or ())
        left_out = tuple(name for name in part.copied if scenario.specs[name].computable)
    runs = scenario if part is None else part.scenario
    source.load(*_recorded_in(source, runs, left_out))  # in one pass over the file
    builder = Builder(
        runs,
        resources,
        problems=problems,
        recording=source if part is None else part.recording,
        named_files=named,
        left_out=left_out,
        fmus_again=fmus_again,
        block=block,
        replaced=_replaced(source, swaps.paths),
        beside=scenario,
    )
    experiment = _compared(builder, source, swaps.paths)
    if rerun:
        experiment = with_recorded_reports(experiment, source)
    if part is not None:
        experiment = _with_absent(experiment, part)
        if not wanted and not swaps.paths:
            _check_held(experiment, source)
    check_clock(experiment.clock, source)
    if "scenario.until" not in changes:  # it ends where the recording does
        experiment = replace(experiment, until=None)
    return _with_events(experiment, builder, source, resources)


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
    from cosim.scenario.preparing import with_reports  # rarely needed
    from cosim.scenario.swapping.swap_comparison import compare_with_recorded
    from cosim.scenario.swapping.swap_report import SwapReports

    reports = SwapReports({name: compare_with_recorded(builder, source, name) for name in names})
    try:
        return with_reports(builder.experiment(), reports)
    except ScenarioError as error:
        raise ScenarioError("\n".join([str(error), *reports.hints])) from error


def _with_absent(experiment: Experiment, part: ReplayedPart) -> Experiment:
    """Return an experiment that knows what is not in it, and warns of that."""
    warnings = list(experiment.warnings)
    for name, reason in {**part.uncomputed, **part.absent}.items():
        verb = "not in this replay" if name in part.absent else "copied, not computed"
        warnings.append((name, f"{verb}: {reason}"))
    return replace(
        experiment,
        warnings=tuple(warnings),
        absent=part.absent,
        uncomputed=part.uncomputed,
    )


def _check_held(experiment: Experiment, source: CompleteRecording) -> None:
    """Check that what is computed takes its inputs as it did in the run.

    Raises
    ------
    LogError
        If an input is held that was interpolated, or the other way round.
    """
    masks = source.held
    for name in experiment.scenario.specs:
        if name in experiment.recorded:
            continue
        if not np.array_equal(masks[name], experiment.graph.held[name]):
            raise LogError(
                f"{source.label}: {name!r} cannot be computed as in the run: how its inputs change "
                "inside a step follows from signals that the log does not have"
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


def _with_events(
    experiment: Experiment, builder: Builder, source: CompleteRecording, resources: ExitStack
) -> Experiment:
    """Return an experiment with the events of its recording, and what sets parameters in them.

    What jumps by itself does so again.
    """
    events = tuple(event for event in source.events() if _happens(experiment, event))
    settings: dict[tuple[int, str], Action] = {}
    if any(event.cause == "set" for event in events):
        from cosim.scenario.actions.settings import (  # rarely needed
            SettingBuilder,
            recorded_settings,
        )

        making = SettingBuilder(
            experiment.scenario,
            builder.context,
            builder.components,
            resources=resources,
            recording=source,
        )
        settings = recorded_settings(making, events, experiment.recorded)
    return replace(experiment, events=events, settings=settings)


def _happens(experiment: Experiment, event: SignalEvent) -> bool:
    """Return whether a replay does again what it has of an event; what jumps does so by itself."""
    if event.cause == "jump" or not (experiment.uncomputed or experiment.absent):
        return event.cause != "jump"
    port = Port.parse(event.signal)
    if port.component not in experiment.graph.components:
        return False
    known = experiment.graph.components[port.component].interface.by_name
    return event.cause in OF_COMPONENTS or port.find(known) is not None


def with_setting_designs(
    experiment: Experiment, source: CompleteRecording, designs: Mapping[str, Design]
) -> Experiment:
    """Prepare the components that take the places of others, with designs of the recording.

    ``designs`` are those of the components themselves that still hold.
    """
    if not experiment.settings:
        return experiment
    from cosim.scenario.actions.settings import prepare_settings, recorded_designs  # rarely needed

    taken = {}
    for key, design in recorded_designs(source).items():
        if key.partition(" ")[2] in designs:
            taken[key] = design
    step_ns = experiment.clock.step_ns
    prepared = prepare_settings(experiment.graph, step_ns, experiment.settings, taken)
    return replace(experiment, setting_designs=prepared)


def _with_code(specs: Mapping[str, Kind], named: Set[str], *, allow_code: bool) -> dict[str, Kind]:
    """Return the components, of which those may run their code that are allowed to or named."""
    result = {}
    for name, spec in specs.items():
        is_allowed = spec.code is not None and (allow_code or spec.code in named)
        result[name] = spec.with_code() if is_allowed else spec
    return result


def _check_whole(source: CompleteRecording) -> None:
    """Check that a log has all rows up to its end: nothing can be computed without those before.

    Raises
    ------
    LogError
        If it is a window of a replay, or a part of a log that leaves rows out.
    """
    if source.status == PARTIAL_STATUS and not _has_all_rows(source):
        raise LogError(
            f"{source.label} is partial, {source.reason}; a replay needs all rows from the start "
            "of the run on: 'cosim merge' joins parts, 'cosim cut --to' keeps what is whole"
        )
    window = recorded_window(source)
    if window is not None:
        raise LogError(
            f"{source.label}: found a replay from {window[0]} s to {window[1]} s alone; needed a "
            f"log from the start of its run on, such as {replay_origin(source).log}"
        )


def _has_all_rows(source: CompleteRecording) -> bool:
    """Return whether every component has its rows from the start of the run to the end here."""
    start_ns = source.end_ns - source.steps * source.step_ns
    for name, channel in source.channels.items():
        times = source.time_ns(name)
        if len(times) != source.steps // channel.period + 1 or int(times[0]) != start_ns:
            return False
    return True


def check_clock(clock: Clock, source: CompleteRecording) -> None:
    """Check that a scenario has the communication points of the rows in its log.

    Raises
    ------
    LogError
        If it has not.
    """
    first_ns = source.end_ns - source.steps * source.step_ns
    if (clock.start_ns, clock.step_ns) != (first_ns, source.step_ns):
        raise LogError(
            f"{source.label}: its scenario has steps of {clock.step_ns} ns from {clock.start_ns} "
            f"ns on, its rows of {source.step_ns} ns from {first_ns} ns on"
        )


def _check_end(source: CompleteRecording) -> None:
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
            f"{source.label}: it is said to end at {end_ns / 1e9} s after {source.steps} steps, "
            f"but the rows of {channel.name!r} end at {last_ns / 1e9} s"
        )


def check_changes(
    experiment: Experiment,
    original: Document,
    changes: Mapping[str, Any],
    swaps: Swaps = NO_SWAPS,
) -> None:
    """Check that no recorded component is changed, or driven by what is changed.

    A recording cannot follow: what the rest computed from it would belong to no run of anything.

    Parameters
    ----------
    experiment : Experiment
        With all changes.
    original : Document
        Without them.
    changes : mapping of dotted key to value
    swaps : Swaps

    Raises
    ------
    UsageError
        If a change reaches a recorded component; names the change.
    """
    whole = experiment.scenario
    if experiment.absent:
        whole, _ = read(whole.document, parse)
    drivers = _drivers(whole)
    document = original
    before, _ = document.tree()
    for change, next_document in _changed_documents(document, changes, swaps):
        after, _ = next_document.tree()
        _check_change(experiment, change, _changed_tables(before, after), drivers)
        before = after


def _changed_documents(
    document: Document, changes: Mapping[str, Any], swaps: Swaps
) -> Iterator[tuple[str, Document]]:
    """Yield the name of every change, and the document with it and all before it."""
    if swaps.paths or swaps.maps:
        document = swaps.applied(document)
        yield option("swap", next(iter(swaps.paths), None)), document
    for key, value in changes.items():
        document = document.with_changes({key: value})
        yield option("set", short(key)), document


def _check_change(
    experiment: Experiment,
    change: str,
    changed: Set[str],
    drivers: Mapping[str, Set[str]],
) -> None:
    """Check that tables that change reach no recorded component; ``change`` names the reason."""
    recorded = experiment.recorded
    specs = experiment.scenario.specs
    origins = _origins(experiment, changed)
    for name, reason in experiment.absent.items():
        if f"components.{name}" in changed or name in origins:
            raise UsageError(f"{change}: {name!r} is not in this replay: {reason}")
    for name in recorded:
        if name in origins:
            remedy = experiment.uncomputed.get(name) or _remedy(specs[name])
            raise UsageError(f"{change}: {name!r} is taken from the recording; {remedy}")
    affected = _reached(origins, drivers, recorded)
    for name in recorded:
        what = _what_drives(name, drivers[name], affected, changed)
        if what:
            raise UsageError(
                f"{change}: {what}; {name!r} is taken from the recording and cannot follow: "
                f"{experiment.uncomputed.get(name) or _remedy(specs[name])}"
            )


def _remedy(spec: Kind) -> str:
    """Return the way out where a recorded component would have to change."""
    if spec.computable:
        return "choose it, too, as a component to compute"
    if spec.code is not None:
        return f"run the scenario to change it, or allow its code to run with {flag('allow_code')}"
    again = f", or compute it, too: {flag('rerun')}" if spec.is_rerun else ""
    return f"run the scenario to change it{again}"


def _changed_tables(before: Mapping[str, Any], after: Mapping[str, Any]) -> set[str]:
    """Return the tables that differ, such as ``components.u``, and the keys of [scenario]."""
    changed = set()
    for table in (*_TABLES, "scenario"):
        first = before.get(table, {})
        second = after.get(table, {})
        for name in {*first, *second}:
            if first.get(name) != second.get(name):
                changed.add(f"{table}.{name}")
    return changed


def _origins(experiment: Experiment, changed: Set[str]) -> set[str]:
    """Return the components that are changed themselves, or by a table that they read."""
    origins = set()
    for name in experiment.scenario.specs:
        if f"components.{name}" in changed or experiment.reads[name] & changed:
            origins.add(name)
    for table in changed:
        kind, _, name = table.partition(".")
        if kind == "connections":
            origins.add(Port.parse(name).component)
    return origins


def _reached(
    origins: Set[str], drivers: Mapping[str, Set[str]], recorded: Iterable[str]
) -> set[str]:
    """Return some components and those that they reach; a recorded one passes nothing on."""
    followers: dict[str, set[str]] = {name: set() for name in drivers}
    for name, sources in drivers.items():
        for source in sources:
            followers[source].add(name)
    reached = set(origins)
    waiting = list(origins)
    while waiting:
        new = (followers[waiting.pop()] - reached).difference(recorded)
        reached |= new
        waiting += new
    return reached


def _what_drives(name: str, drivers: Set[str], affected: Set[str], changed: Set[str]) -> str | None:
    """Return how changed tables change what drives a component; None: they do not."""
    causes = sorted(drivers & affected)
    if causes:
        return f"this changes {causes[0]!r}, which drives {name!r}"
    if drivers and not EVERYWHERE.isdisjoint(changed):
        return f"this may change the inputs of {name!r}"
    return None


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
                f"{_why_recorded(scenario.specs[name])}; there is: {listing(computable, 100)}"
            )
    return tuple(name for name in computable if name not in components)


def _why_recorded(spec: Kind) -> str:
    """Return why a component cannot be computed from a log."""
    if spec.code is not None:
        return f"{flag('allow_code')} allows its code to run"
    return f"{flag('rerun')} computes it" if spec.is_rerun else "its file is not part of a log"


def _drivers(scenario: Scenario) -> dict[str, set[str]]:
    """Return the components that drive each component."""
    drivers: dict[str, set[str]] = {name: set() for name in scenario.specs}
    for to, connection in scenario.connections.items():
        for source in connection.sources:
            drivers[to.component].add(source.component)
    return drivers


def _recorded_in(
    source: CompleteRecording, scenario: Scenario, left_out: Collection[str]
) -> list[str]:
    """Return the components of a scenario that are taken from a log, as far as it has them."""
    specs = scenario.specs
    recorded = [name for name in specs if not specs[name].computable or name in left_out]
    return [name for name in recorded if name in source.channels]


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
        current = fingerprint(experiment.scenario, name, experiment.reads[name])
        same_tables = recorded.get("fingerprint") == current
        held = experiment.graph.held[name]
        same_code = spec.code is None or _same_code(experiment, source, name)
        same_hold = name in recorded_masks and np.array_equal(recorded_masks[name], held)
        if name in experiment.recorded or (same_tables and same_code and same_hold):
            designs[name] = recorded_designs[name]
    return designs


def _same_code(experiment: Experiment, source: Log, name: str) -> bool:
    """Return whether a component was built from the code that its recorded run had."""
    code = experiment.metadata.get(name, {}).get("code")
    recorded = component_record(source, name).code
    return code is not None and CodeRecord.model_validate(code) == recorded
