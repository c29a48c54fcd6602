"""Which changes a replay allows: those that no recorded component would have to follow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cosim.core.port import Port
from cosim.core.recording import CompleteRecording
from cosim.errors import ScenarioError, UsageError, command, flag, option
from cosim.instants import step_value
from cosim.scenario.building.build import parse
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.parsing import Scenario, read
from cosim.scenario.document.document import ACTIONS, Document, short
from cosim.scenario.document.swaps import PortNames, component_table
from cosim.scenario.kinds import Kind
from cosim.scenario.recordings.recorded_span import check_end

EVERYWHERE = {  # what matters to all inputs
    "scenario.input_interpolation",
    "scenario.coupling",
    "scenario.iterations",
    "scenario.substeps",
}
_TABLES = ("components", "models", "connections")


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
        """Return the tables of the components that take the places of others in a document.

        Raises
        ------
        ScenarioError
            If a path is that of no component.
        """
        tables = {}
        for name in self.paths:
            try:
                tables[name] = component_table(name, document.swaps[name])
            except UsageError as error:
                raise ScenarioError(f"{option('swap', name)}: {error}") from error
        return tables


NO_SWAPS: Final = Swaps({}, {})


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
        recorded_step = step_value(source.step_ns)
        raise UsageError(
            f"scenario.step: expected the recorded {recorded_step} s, got "
            f"{changes['scenario.step']} s; run the scenario to change it"
        )
    if "scenario.start_time" in changes:
        raise UsageError(
            "scenario.start_time: expected the recorded one, got "
            f"{changes['scenario.start_time']} s; run the scenario to change it"
        )
    for key in changes:
        if key.partition(".")[0] == ACTIONS:
            raise UsageError(
                f"{option('set', key)}: a replay repeats the recorded actions; run the scenario "
                "to change them"
            )
    check_end(source)
    recorded_end = source.end_ns / 1e9
    stop = changes.setdefault("scenario.stop", recorded_end)
    if isinstance(stop, (int, float)) and stop > recorded_end:
        raise UsageError(
            f"{option('set', 'scenario.stop')}: expected at most {recorded_end} s (end of the "
            f"recording), got {stop} s"
        )
    return changes


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
        return "compute this component, too"
    if spec.code is not None:
        return f"run the scenario to change it, or allow its code to run with {flag('allow_code')}"
    if not spec.is_rerun:
        return "run the scenario to change it"
    return (
        f"run the scenario to change it, or compute it, too: {command('replay')} with "
        f"{flag('rerun')}"
    )


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
        if f"components.{name}" in changed or experiment.built.reads[name] & changed:
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


def _drivers(scenario: Scenario) -> dict[str, set[str]]:
    """Return the components that drive each component."""
    drivers: dict[str, set[str]] = {name: set() for name in scenario.specs}
    for to, connection in scenario.connections.items():
        for source in connection.sources:
            drivers[to.component].add(source.component)
    return drivers
