"""The experiment of a replay: the scenario of a log, with what is taken from the log.

A change is allowed where no recorded component would have to follow it: what the rest computed from
its recording would belong to no run of anything.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Set
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Final, final

import numpy as np

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels, partial_of
from cosim.core.recorded.run import RecordedRun
from cosim.core.recording import SignalEvent
from cosim.core.structure.cycles import reached_from
from cosim.errors import LogError, ScenarioError, UsageError, option
from cosim.instants import NANOSECONDS, step_value
from cosim.log import Log
from cosim.log.difference import OF_COMPONENTS
from cosim.log.metadata import decode_design
from cosim.scenario.building.build import Builder, read
from cosim.scenario.building.experiment import Experiment, fingerprint
from cosim.scenario.document.document import Document, short, shown
from cosim.scenario.document.schema import ACTIONS
from cosim.scenario.document.swaps import component_table as swapped_table
from cosim.scenario.document.swaps import is_map_key
from cosim.scenario.kinds.build_record import Origins, RecordedFmu
from cosim.scenario.record import (
    MEANS,
    CodeRecord,
    ReplayOrigin,
    component_metadata,
    component_record,
    component_table,
    recorded_loop_gains,
    recorded_warnings,
)
from cosim.scenario.recordings.log_contents import recorded_channels
from cosim.scenario.recordings.recorded_scenario import (
    check_rows,
    load_rows,
    recorded_document,
    rerun_plants,
)
from cosim.scenario.recordings.recording import with_reports
from cosim.scenario.recordings.replay_request import ReplayRequest, ReplayWindow, window_of
from cosim.scenario.recordings.replayed_part import replayed_part, way_out

_RECORDED: Final = "as recorded"
_OF_ALL_INPUTS: Final = frozenset(
    f"scenario.{key}" for key in ("input_interpolation", "coupling", "iterations", "substeps")
)
_OF_COMPONENTS: Final = ("components.", "connections.")
_TABLES: Final = ("components", "models", "connections", "scenario")


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


@final
class RebuiltRun:
    """The scenario of a log, built again with its recorded components; only the log is needed.

    What is changed or swapped may always run its code. Whether the recorded components allow the
    changes is for :meth:`check_changes`.

    Parameters
    ----------
    source : RecordedRun
    request : ReplayRequest
    resources : ExitStack
        Closes what was opened.

    Attributes
    ----------
    scenario : Scenario
        With all changes, and all components.
    window : ReplayWindow or None
        What is recorded of the replay; None: all.
    part : ReplayedPart
        Where each component is from.
    experiment : Experiment

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

    def __init__(
        self,
        source: RecordedRun,
        request: ReplayRequest,
        resources: ExitStack,
    ) -> None:
        check_rows(source)
        self._source = source
        self._request = request
        self.window: ReplayWindow | None = None
        self._changes = {short(key): value for key, value in request.changes.items()}
        if request.window is not None:
            self.window = window_of(source, request.window)
            if "scenario.stop" in self._changes:
                raise UsageError(f"expected {option('set', 'scenario.stop')} or a window, got both")
            self._changes["scenario.stop"] = self.window.ends[1]
        stop = self._changes.get("scenario.stop", source.end_ns / 1e9)
        self._check_times()
        self._original = recorded_document(source)
        # a run may have ended before its stop
        document = self._edited({**self._changes, "scenario.stop": stop})
        self.scenario, problems = read(document)
        if not request.maps:
            # recorded ports have the scenario's names: a map need not fit changed connections
            problems = [(key, text) for key, text in problems if not is_map_key(key)]
        named = self._named(document)
        specs = dict(self.scenario.specs)
        for name, spec in specs.items():
            is_allowed = spec.code is not None and (request.allow_code or spec.code in named)
            if is_allowed or name in request.swaps:
                specs[name] = spec.with_code()
        fmus_again: Mapping[str, RecordedFmu] = {}
        if request.rerun:
            again, fmus_again = rerun_plants(source, specs, request, resources)
            specs |= again
        self.scenario = replace(self.scenario, specs=specs)
        self.part = replayed_part(source, self.scenario, request.components)
        load_rows(source, [name for name in self.part.copied if name in source.channels])
        declared = declared_channels(source.channels)
        replaced = {n: declared[n].interface for n in request.swaps if n in declared}
        self._builder = Builder(
            self.part.scenario,
            resources,
            Origins(
                recording=self.part.recording,
                named=named,
                left_out=self.part.left_out,
                fmus_again=fmus_again,
            ),
            problems=problems,
            replaced=replaced,
            beside=self.scenario,
        )
        self.experiment = self._compared(replaced)
        self._finish()

    # --- its scenario ---

    def _check_times(self) -> None:
        """Check that no communication point or action changes, and the end is in the recording.

        Raises
        ------
        UsageError
            If they do, or it is not.
        """
        step = step_value(self._source.step_ns)
        fixed = {
            "scenario.step": f"the recorded {step} s",
            "scenario.start_time": "the recorded one",
        }
        recorded_end = self._source.end_ns / 1e9
        for name, value in self._changes.items():
            if name in fixed:
                raise UsageError(
                    f"{name}: expected {fixed[name]}, got {value} s; run the scenario to change it"
                )
            if name.partition(".")[0] == ACTIONS:
                raise UsageError(
                    f"{option('set', name)}: a replay repeats the recorded actions; run the "
                    "scenario to change them"
                )
            is_end = name == "scenario.stop" and isinstance(value, (int, float))
            if is_end and value > recorded_end:
                raise UsageError(
                    f"{option('set', name)}: expected at most {recorded_end} s (end of the "
                    f"recording), got {value} s"
                )

    def _edited(self, changes: Mapping[str, Any]) -> Document:
        """Return the document with the swaps and some changes."""
        swapped = self._original.with_swaps(self._request.swaps, self._request.maps)
        return swapped.with_changes(changes)

    def _named(self, document: Document) -> set[str]:
        """Return the texts of the request: in changes, and the tables of what is swapped.

        Raises
        ------
        ScenarioError
            If a path is that of no component.
        """
        named = texts_in(self._changes)
        for name in self._request.swaps:
            try:
                named |= texts_in(swapped_table(name, document.swaps[name]))
            except UsageError as error:
                raise ScenarioError(f"{option('swap', name)}: {error}") from error
        return named

    # --- its experiment ---

    def _compared(self, swapped: Mapping[str, object]) -> Experiment:
        """Build, with reports on how swapped components compare with the recorded ones.

        Raises
        ------
        ScenarioError
            With every problem of the scenario, and the ports that may have been meant.
        """
        builder = self._builder
        names = [name for name in swapped if name in builder.components]
        if not names:
            return builder.experiment()
        from cosim.scenario.recordings.swap_comparison import compare_with_recorded
        from cosim.scenario.recordings.swap_report import SwapReports

        source = self._source
        reports = SwapReports(
            {name: compare_with_recorded(builder, source, name) for name in names}
        )
        try:
            return with_reports(builder.experiment(), reports)
        except ScenarioError as error:
            raise ScenarioError("\n".join([str(error), *reports.hints])) from error

    def _finish(self) -> None:
        """Fill in what the recording says of the run, and check that the replay fits it.

        Raises
        ------
        LogError
            If the scenario has not the communication points of the rows; as from the checks.
        """
        source = self._source
        experiment = self.experiment
        part = self.part
        clock = experiment.clock = replace(experiment.clock, block=self._request.block)
        if self._request.rerun:
            self._add_recorded_reports()
        for name, reason in {**part.uncomputed, **part.absent}.items():
            verb = "not in this replay" if name in part.absent else "copied, not computed"
            experiment.built.warn(name, f"{verb}: {reason}")
        if part.recording is not source and self._request.is_as_recorded:
            self._check_held()
        if clock.grid != source.grid:
            raise LogError(
                f"{source.label}: the scenario has steps of {clock.step_ns} ns from "
                f"{clock.start_ns} ns on, but the rows have steps of {source.step_ns} ns from "
                f"{source.grid.start_ns} ns on"
            )
        if "scenario.until" not in self._changes:  # it ends where the recording does
            experiment.until = None
        events = [event for event in source.events() if event.cause != "jump"]
        experiment.events = tuple(filter(self._happens, events))
        experiment.settings = {}
        if any(event.cause == "set" for event in experiment.events):
            from cosim.scenario.building.actions import SettingBuilder, recorded_settings

            builder = self._builder
            making = SettingBuilder(experiment.scenario, builder.context, builder.components)
            experiment.settings = recorded_settings(making, experiment.events, part.copied)

    def _add_recorded_reports(self) -> None:
        """Add the recorded swap reports of what is computed again.

        What a plant of the run had replaced is not there any more to be compared with.
        """
        from cosim.scenario.recordings.swap_report import SWAP_WARNINGS

        built = self.experiment.built
        compared = {name for name, table in built.metadata.items() if "swap_report" in table}
        again = built.metadata.keys() - set(self.part.copied) - compared
        for name in again:
            recorded = component_table(self._source, name)
            if "swap_report" in recorded:
                built.add_metadata(name, {"swap_report": recorded["swap_report"]})
        for name, text in recorded_warnings(self._source):
            if name in again and text.startswith(SWAP_WARNINGS):
                built.warn(name, text)

    def _check_held(self) -> None:
        """Check that what is computed takes its inputs as it did in the run.

        Raises
        ------
        LogError
            If an input is held that was interpolated, or the other way round; or an FMU gets the
            mean of one over a step that had the latest value.
        """
        source = self._source
        graph = self.experiment.graph
        masks = source.held
        all_means = graph.mean_inputs
        for name in self.part.scenario.specs:
            if name in self.part.copied:
                continue
            means = component_metadata(source, name).get(MEANS)  # older logs tell nothing
            own_means = json.dumps(all_means.get(name, []))
            has_other_mask = not np.array_equal(masks[name], graph.held[name])
            if has_other_mask or means not in (None, own_means):
                raise LogError(
                    f"{source.label}: {name!r} cannot be computed as in the run: how its inputs "
                    "change within a step depends on signals that the log does not have"
                )

    def _happens(self, event: SignalEvent) -> bool:
        """Return whether a replay has what an event is about.

        Of a partial log a copied component need not have all of its signals: nothing that is
        computed rests on the others.
        """
        if partial_of(self._source.channels) is None:
            return True
        port = Port.parse(event.signal)
        component = self.experiment.graph.components.get(port.component)
        if component is None:
            return False
        return event.cause in OF_COMPONENTS or port.find(component.interface.by_name) is not None

    # --- what may be changed ---

    def check_changes(self) -> None:
        """Check that no recorded component is changed, or driven by what is changed.

        Raises
        ------
        UsageError
            If a change reaches a recorded component; names the change.
        """
        if not (self._changes or self._request.swaps):
            return
        copied = self.part.copied
        drivers = self.scenario.drivers
        # a recorded one passes nothing on
        free = {name: drivers[name] for name in drivers if name not in copied}
        behind = {name: reached_from(drivers[name], free).keys() for name in copied}
        before = self._original.tables().tree
        for change, document in self._changed_documents():
            after = document.tables().tree
            refusal = self._refusal(_changed_tables(before, after), behind)
            if refusal:
                raise UsageError(f"{change}: {refusal}")
            before = after

    def _changed_documents(self) -> Iterator[tuple[str, Document]]:
        """Yield the name of every change, and the document with it and all before it."""
        document = self._edited({})
        if self._request.swaps:
            yield option("swap", next(iter(self._request.swaps))), document
        for key, value in self._changes.items():
            document = document.with_changes({key: value})
            yield option("set", shown(key)), document

    def _refusal(self, tables: Set[str], behind: Mapping[str, Set[str]]) -> str:
        """Return why tables cannot change: what they reach is recorded, or not here at all.

        Parameters
        ----------
        tables : set of str
        behind : mapping of component name to set of str
            The components that the inputs of each recorded one follow.
        """
        part = self.part
        changed = {table.split(".")[1] for table in tables if table.startswith(_OF_COMPONENTS)}
        reads = self.experiment.built.reads
        changed |= {name for name in reads if not tables.isdisjoint(reads[name])}
        for name, reason in part.absent.items():
            if name in changed:
                return f"{name!r} is not in this replay: {reason}"
        for name in part.copied:
            if name in changed:
                return f"{name!r} is taken from the recording; {self._way_out(name)}"
        for name in part.copied:
            text = ""
            if not changed.isdisjoint(behind[name]):
                text = f"this changes {min(changed & behind[name])!r}, on which {name!r} depends"
            elif behind[name] and not tables.isdisjoint(_OF_ALL_INPUTS):
                text = f"this may change the inputs of {name!r}"
            if text:
                return (
                    f"{text}; {name!r} is taken from the recording and cannot follow: "
                    f"{self._way_out(name)}"
                )
        return ""

    def _way_out(self, name: str) -> str:
        """Return the way out where a recorded component would have to change."""
        spec = self.scenario.specs[name]
        further = self.part.uncomputed.get(name) or way_out(spec)
        if spec.computable:
            return further
        return "run the scenario to change it" + (f", or {further}" if further else "")


def _changed_tables(before: Mapping[str, Any], after: Mapping[str, Any]) -> set[str]:
    """Return the tables that differ, such as ``components.u``, and the keys of [scenario]."""
    changed = set()
    for table in _TABLES:
        first = before.get(table, {})
        second = after.get(table, {})
        for name in {*first, *second}:
            if first.get(name) != second.get(name):
                changed.add(f"{table}.{name}")
    return changed


def prepared_replay(
    source: Log,
    request: ReplayRequest,
    resources: ExitStack,
) -> Experiment:
    """Build the replay of a log, with what it takes from there; parameters as of RebuiltRun.

    Raises
    ------
    LogError
        If the log is no log of a scenario, or does not fit its scenario.
    ScenarioError
        With every problem of the changed scenario.
    UsageError
        If the recording cannot follow what is changed.
    """
    run = RebuiltRun(source, request, resources)
    run.check_changes()
    experiment = run.experiment
    part = run.part
    experiment.graph.take_solutions(source, part.copied)
    if run.window is not None:
        run.window.check_begin(recorded_channels(experiment), source.grid)
    experiment.origin = ReplayOrigin(
        os.path.relpath(source.path),
        source.recorded_hash or source.content_hash(),
        part.copied,
        window=None if run.window is None else run.window.ends,
        left_out=tuple(name for name in part.left_out if name not in part.uncomputed),
        absent=part.absent,
        uncomputed=part.uncomputed,
    )
    # what the run warned of that is not found again: of what is copied, and of the whole
    again = experiment.graph.components.keys() - set(part.copied)
    known = set(experiment.built.warnings)
    for time_ns, _, name, text in source.warnings:
        is_left = name in again or name in part.absent or name == "run"
        if is_left or (name, text) in known:
            continue
        if not text.startswith(_RECORDED):
            text = f"{_RECORDED} at t = {time_ns / NANOSECONDS} s: {text}"
        experiment.built.warn(name, text)
    recorded = source.designs
    kept = [name for name in experiment.scenario.specs if name not in request.swaps]
    kept = [name for name in kept if _keeps_design(run, source, name)]
    experiment.designs = {name: recorded[name] for name in kept}
    if request.is_as_recorded:
        experiment.gains = recorded_loop_gains(source)
    if experiment.settings:
        from cosim.scenario.building.actions import recorded_designs

        of_settings = recorded_designs(source).items()
        taken = {key: design for key, design in of_settings if key.partition(" ")[2] in kept}
        experiment.setting_designs = experiment.prepare_settings(taken)
    return experiment


def _keeps_design(run: RebuiltRun, source: Log, name: str) -> bool:
    """Return whether the recorded design of a component holds: it rests on nothing that changed."""
    experiment = run.experiment
    if name in run.part.copied:
        return True
    current = fingerprint(experiment.scenario, name, experiment.built.reads[name])
    if component_metadata(source, name).get("fingerprint") != current:
        return False
    if experiment.scenario.specs[name].code is not None:
        code = experiment.built.metadata.get(name, {}).get("code")
        recorded = component_record(source, name).code
        if code is None or CodeRecord.model_validate(code) != recorded:
            return False
    mask = source.held.get(name)
    return mask is not None and np.array_equal(mask, experiment.graph.held[name])


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
