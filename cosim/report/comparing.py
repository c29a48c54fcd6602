"""The same scenario on several plants: errors against the truth, differences of the estimates."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cosim.arguments import mapping_argument, path_argument, swap_argument, truth_argument
from cosim.arrays import Vector
from cosim.core.port import split_element
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorders import Memory
from cosim.core.signals import Interface
from cosim.errors import CosimError, Interrupted, UsageError, flag, nearest, option, quoted
from cosim.files import file_type
from cosim.log import Log
from cosim.report.recorded_rows import difference, has_signal
from cosim.report.summary import Summary, summarize
from cosim.scenario.document.edits import component_in, short
from cosim.scenario.document.swap import (
    PortNames,
    component_table,
    marked_path,
    port_names,
)
from cosim.scenario.parsing import Scenario
from cosim.scenario.record import truth_of
from cosim.scenario.recordings.recording import check_target
from cosim.scenario.running.execution import load, run


@dataclass(frozen=True)
class PlantRun:
    """The run of one plant.

    Parameters
    ----------
    label : str
        Its name in tables and pictures, and of its log.
    recording : Log, Memory or None
        None: the run failed.
    error : str
        Why it failed; empty: it did not.
    """

    label: str
    recording: Log | Memory | None
    error: str = ""


@dataclass(frozen=True)
class EstimateDifference:
    """An estimate of one plant against that of the first.

    Parameters
    ----------
    estimate, label : str
    largest : tuple of float or None
        Largest |difference| of each element where both have a value; None: one never has.
    """

    estimate: str
    label: str
    largest: tuple[float | None, ...]


@dataclass(frozen=True)
class Comparison:
    """Several plants in one scenario, the failed ones included."""

    scenario: str
    component: str
    outcomes: tuple[PlantRun, ...]

    @cached_property
    def recordings(self) -> dict[str, RecordedRun]:
        """The runs that did not fail, by label."""
        recordings: dict[str, RecordedRun] = {}
        for outcome in self.outcomes:
            if outcome.recording is not None:
                recordings[outcome.label] = outcome.recording
        return recordings

    @cached_property
    def estimates(self) -> dict[str, Any]:
        """The estimates with their truth, in the order of the scenario."""
        estimates: dict[str, Any] = {}
        for recording in self.recordings.values():
            for estimate, truth in truth_of(recording).items():
                estimates.setdefault(estimate, truth)  # the names of the first plant that has it
        return estimates

    @cached_property
    def summaries(self) -> dict[str, Summary]:
        """The summary of each run, by label."""
        return {label: summarize(recording) for label, recording in self.recordings.items()}

    @cached_property
    def differences(self) -> list[EstimateDifference]:
        """The distance of every estimate from that of the first run, at their shared instants."""
        if not self.recordings:
            return []
        (_, reference), *others = self.recordings.items()
        differences: list[EstimateDifference] = []
        for estimate in self.estimates:
            for label, recording in others:
                if has_signal(reference, estimate) and has_signal(recording, estimate):
                    _, values = difference(reference, recording, estimate)
                    largest = tuple(_largest(element) for element in values.T)
                    differences.append(EstimateDifference(estimate, label, largest))
        return differences

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        summaries = self.summaries
        plants = []
        for outcome in self.outcomes:
            plant: dict[str, Any] = {"plant": outcome.label, "error": outcome.error or None}
            plant["log"] = plant["summary"] = None
            if isinstance(outcome.recording, Log) and outcome.recording.is_at_its_path:
                plant["log"] = str(outcome.recording.path)
            if outcome.label in summaries:
                plant["summary"] = summaries[outcome.label].to_dict()
            plants.append(plant)
        return {
            "scenario": self.scenario,
            "component": self.component,
            "plants": plants,
            "differences": [asdict(row) for row in self.differences],
        }


@dataclass(frozen=True)
class _Alternative:
    """A plant to run, and what is changed for it."""

    label: str
    path: str | None  # None: the component of the scenario itself
    map: Mapping[str, PortNames] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)


def compare(
    scenario: str | Path | Scenario,
    *,
    swap: Mapping[str, Sequence[str | Path]],
    map: Mapping[str, PortNames] | None = None,
    set: Mapping[str, Any] | None = None,
    base: bool = True,
    out: str | Path | None = None,
    force: bool = False,
) -> Comparison:
    """Run a scenario with each of several plants.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` returned.
    swap : mapping of one component to the paths of its alternatives
        Each an FMU (``x.fmu``, ``x.fmu#me``, ``x.fmu#cs``) or a recorded log.
    map : mapping of port to names, optional
        As for :func:`run`. An entry is for every alternative that has a port of that name; the
        others keep the scenario's.
    set : mapping of dotted key to value, optional
        For all of them, but what is set for the component itself is for its alternatives only.
    base : bool
        Run the scenario as it is too, as the first.
    out : str or Path, optional
        Folder for the logs, ``<label>.mcap``; without it the runs are kept in memory.
    force : bool
        Replace existing logs.

    Raises
    ------
    UsageError
        If there is not one component, fewer than two plants, a path that no plant has, or an entry
        of ``map`` or ``set`` that none of them can use. Other problems of a single plant are its
        outcome.
    """
    force = truth_argument("force", force)
    base = truth_argument("base", base)
    folder = None if out is None else path_argument("out", out)
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    component, paths = _paths(loaded, swap, base=base)
    maps = _maps_by_path(component, paths, mapping_argument("map", map))
    changes = dict(mapping_argument("set", set))
    common = _changes_of_others(changes, component)
    alternatives = []
    if base:
        alternatives.append(_Alternative(loaded.specs[component].kind, None, changes=common))
    for path in paths:
        alternatives.append(_Alternative(_label(path), path, maps[path], changes))
    loaded.edit(set=common)  # a problem of all plants is raised once, before anything runs
    _check_edits(loaded, component, alternatives)
    labels = _distinct([alternative.label for alternative in alternatives])
    logs = _log_paths(labels, folder, force=force)
    outcomes = []
    for label, alternative, log in zip(labels, alternatives, logs, strict=True):
        outcomes.append(_run(loaded, component, label, alternative, log=log, force=force))
    return Comparison(loaded.name, component, tuple(outcomes))


def _log_paths(labels: Sequence[str], folder: Path | None, *, force: bool) -> list[Path | None]:
    """Return where the log of each plant goes; check all of them, before the first run."""
    logs: list[Path | None] = []
    for label in labels:
        log = None if folder is None else folder / f"{label.replace('#', '-')}.mcap"
        check_target(log, force=force)
        logs.append(log)
    return logs


def _check_edits(loaded: Scenario, component: str, alternatives: Sequence[_Alternative]) -> None:
    """Refuse edits that make no scenario with any of the alternatives."""
    problems: dict[str, None] = {}
    for alternative in alternatives:
        if alternative.path is None:
            continue
        swap = {component: alternative.path}
        try:
            loaded.edit(swap=swap, map=alternative.map, set=alternative.changes)
        except CosimError as error:
            problems[str(error)] = None
        else:
            return  # what the others cannot be is their outcome
    raise UsageError("\n".join(problems))


def _changes_of_others(changes: Mapping[str, Any], component: str) -> dict[str, Any]:
    """Return the changes without those of the component."""
    others = {}
    for key, value in changes.items():
        if component_in(short(key)) != component:
            others[key] = value
    return others


def _label(path: str) -> str:
    """Return ``x`` for x.fmu and x.mcap, ``x#cs`` for x.fmu#cs."""
    file, _, interface_type = path.rpartition("#")
    if file_type(file) == "FMU":
        return f"{Path(file).stem}#{interface_type}"
    return Path(path).stem


def _run(
    loaded: Scenario,
    component: str,
    label: str,
    alternative: _Alternative,
    *,
    log: Path | None,
    force: bool,
) -> PlantRun:
    path = alternative.path
    swap: dict[str, str | Path] = {} if path is None else {component: path}
    maps = alternative.map
    changes = alternative.changes
    try:
        recording = run(loaded, swap=swap, map=maps, set=changes, out=log, force=force)
    except Interrupted:
        raise
    except CosimError as error:  # of one plant, whatever it is: the others go on
        return PlantRun(label, None, str(error))
    return PlantRun(label, recording)


def _largest(values: Vector) -> float | None:
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else None


def _paths(
    loaded: Scenario, swap: Mapping[str, Sequence[str | Path]], *, base: bool
) -> tuple[str, list[str]]:
    """Return the component that is swapped, and the paths of its alternatives."""
    swap = swap_argument(swap)
    if len(swap) != 1:
        names = ", ".join(swap) or "none"
        raise UsageError(
            f"{option('swap')}: expected alternatives of one component, such as a.fmu and b.fmu "
            f"of plant, got alternatives of {names}"
        )
    (component, paths), *_ = swap.items()
    if component not in loaded.specs:
        suggestion = nearest(component, loaded.specs)
        raise UsageError(
            f"{option('swap', component)}: unknown component {component!r}; {suggestion}"
        )
    if isinstance(paths, str) or not isinstance(paths, Sequence):
        raise UsageError(
            f"{option('swap', component)}: expected a list of paths, got {quoted(paths)}"
        )
    if len(paths) + base < 2:
        raise UsageError(
            f"{option('swap', component)}: expected two plants to compare, got one; "
            f"give another, or omit {flag('base', False)}"
        )
    listed = [marked_path(str(path_argument("swap", path))) for path in paths]
    _check_paths(component, listed)
    return component, listed


def _check_paths(component: str, paths: Sequence[str]) -> None:
    """Check that each path is that of a file that can take the component's place."""
    problems = []
    for path in paths:
        try:
            component_table(component, path)
        except UsageError as error:
            problems.append(f"{option('swap', component)}: {error}")
    if problems:
        raise UsageError("\n".join(problems))


def _distinct(labels: Sequence[str]) -> list[str]:
    """Append a number to labels that occur before."""
    distinct: list[str] = []
    for label in labels:
        name = label
        number = 1
        while name in distinct:
            number += 1
            name = f"{label}-{number}"
        distinct.append(name)
    return distinct


def _maps_by_path(
    component: str, paths: Sequence[str], maps: Mapping[str, PortNames]
) -> dict[str, dict[str, PortNames]]:
    """Return for each alternative the entries whose names are ports of it."""
    if not maps:
        return {path: {} for path in paths}  # without a look into the files
    maps_by_path: dict[str, dict[str, PortNames]] = {}
    known: dict[str, None] = {}
    for path in paths:
        names = _port_names(component, path, maps)
        known |= dict.fromkeys(names)
        used = [port for port, listed in maps.items() if not _unknown_names(names, listed)]
        maps_by_path[path] = {port: maps[port] for port in used}
    problems = []
    for port, listed in maps.items():
        for name in _unknown_names(known, listed):
            suggestion = nearest(name, known)
            problems.append(
                f"{option('map', port)}: no alternative has a port {name!r}; {suggestion}"
            )
    if problems:
        raise UsageError("\n".join(problems))
    return maps_by_path


def _unknown_names(known: Collection[str], listed: PortNames) -> list[str]:
    """Return the names in an entry of a map that are no known ports or elements of them.

    Raises
    ------
    GraphError
        If the entry is a list that is not closed.
    """
    unknown = []
    for name in port_names(listed):
        signal, _ = split_element(name)
        if name not in known and signal not in known:
            unknown.append(name)
    return unknown


def _port_names(component: str, path: str, maps: Mapping[str, PortNames]) -> list[str]:
    """Return the ports of an alternative; none where it cannot be read: its run says why.

    Of an MCAP of another tool these are the mapped fields of its topics.
    """
    table = component_table(component, path)
    try:
        if table["kind"] == "field-data":
            return _sample_names(Path(table["path"]), maps)
        interface = _interface(component, table)
    except CosimError:
        return []
    return [signal.name for signal in interface.signals]


def _sample_names(path: Path, maps: Mapping[str, PortNames]) -> list[str]:
    from cosim.log.foreign.field_path import FieldProblem, split_field
    from cosim.log.foreign.topics import read_channels
    from cosim.scenario.data_files.field_file import field_data

    if file_type(path) != "log":
        return [signal.name for signal in field_data(path).signals]
    topics = {channel.topic for channel in read_channels(path)}
    found = []
    for name in chain.from_iterable(port_names(listed) for listed in maps.values()):
        try:
            if split_field(name, topics) is not None:
                found.append(name)
        except FieldProblem:
            found.append(name)  # whoever reads it says what is wrong
    return found


def _interface(component: str, table: Mapping[str, Any]) -> Interface:
    from cosim.fmi.reading.model_description import read
    from cosim.log import open_log

    if table["kind"] == "fmu":
        return read(table["path"]).description.interface
    channels = open_log(table["log"]).channels
    return channels[component].interface if component in channels else Interface()
