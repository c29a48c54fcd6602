"""Which changes a replay allows: those that no recorded component would have to follow."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Final

from cosim.core.port import Port
from cosim.core.recording import CompleteRecording
from cosim.core.structure.cycles import reached_from
from cosim.errors import UsageError, command, flag, option
from cosim.instants import step_value
from cosim.scenario.building.build import read
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.document import Document, short, shown
from cosim.scenario.document.schema import ACTIONS
from cosim.scenario.document.swaps import PortNames
from cosim.scenario.kinds import Kind

_OF_ALL_INPUTS: Final = frozenset(
    f"scenario.{key}" for key in ("input_interpolation", "coupling", "iterations", "substeps")
)
_TABLES: Final = ("components", "models", "connections", "scenario")


def replay_changes(source: CompleteRecording, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes of a replay: those that are wanted, and the end of the recording.

    Raises
    ------
    UsageError
        If they change the communication points or actions, or go beyond the recording.
    """
    changes = {short(key): value for key, value in wanted.items()}
    fixed = {
        "step": f"the recorded {step_value(source.step_ns)} s",
        "start_time": "the recorded one",
    }
    for name, recorded in fixed.items():
        key = f"scenario.{name}"
        if key in changes:
            raise UsageError(
                f"{key}: expected {recorded}, got {changes[key]} s; run the scenario to change it"
            )
    for key in changes:
        if key.partition(".")[0] == ACTIONS:
            raise UsageError(
                f"{option('set', key)}: a replay repeats the recorded actions; run the scenario "
                "to change them"
            )
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
    swap: Mapping[str, str | Path],
    maps: Mapping[str, PortNames],
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
    swap : mapping of component name to path
    maps : mapping of port to names

    Raises
    ------
    UsageError
        If a change reaches a recorded component; names the change.
    """
    scenario = experiment.scenario
    if experiment.absent:  # which may be changed, too
        scenario = read(scenario.document)
    followers: dict[str, list[str]] = {}
    recorded = set(experiment.recorded)
    for to, connection in scenario.connections.items():
        for source in connection.sources:
            if to.component not in recorded:  # which passes nothing on
                followers.setdefault(source.component, []).append(to.component)
    before = original.tables().tree
    for change, document in _changed_documents(original, changes, swap, maps):
        after = document.tables().tree
        for refusal in _refusals(
            experiment, _changed_tables(before, after), scenario.drivers, followers
        ):
            raise UsageError(f"{change}: {refusal}")
        before = after


def _refusals(
    experiment: Experiment,
    tables: Set[str],
    drivers: Mapping[str, Set[str]],
    followers: Mapping[str, Sequence[str]],
) -> Iterator[str]:
    """Yield why tables cannot change: what they reach is recorded, or not here at all."""
    own = _changed_components(experiment, tables)
    for name, reason in experiment.absent.items():
        if name in own or f"components.{name}" in tables:
            yield f"{name!r} is not in this replay: {reason}"
    for name in experiment.recorded:
        if name in own:
            yield f"{name!r} is taken from the recording; {_remedy(experiment, name)}"
    affected = reached_from(own, followers).keys()
    for name in experiment.recorded:
        text = ""
        causes = sorted(drivers[name] & affected)
        if causes:
            text = f"this changes {causes[0]!r}, which drives {name!r}"
        elif drivers[name] and not tables.isdisjoint(_OF_ALL_INPUTS):
            text = f"this may change the inputs of {name!r}"
        if text:
            yield (
                f"{text}; {name!r} is taken from the recording and cannot follow: "
                f"{_remedy(experiment, name)}"
            )


def _changed_documents(
    document: Document,
    changes: Mapping[str, Any],
    swap: Mapping[str, str | Path],
    maps: Mapping[str, PortNames],
) -> Iterator[tuple[str, Document]]:
    """Yield the name of every change, and the document with it and all before it."""
    if swap:
        document = document.with_swaps(swap, maps)
        yield option("swap", next(iter(swap))), document
    for key, value in changes.items():
        document = document.with_changes({key: value})
        yield option("set", shown(key)), document


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


def _changed_components(experiment: Experiment, tables: Set[str]) -> set[str]:
    """Return the components that are changed themselves, or by a table that they read."""
    changed = set()
    for name in experiment.scenario.specs:
        if f"components.{name}" in tables or experiment.built.reads[name] & tables:
            changed.add(name)
    for table in tables:
        kind, _, name = table.partition(".")
        if kind == "connections":
            changed.add(Port.parse(name).component)
    return changed


def _remedy(experiment: Experiment, name: str) -> str:
    """Return the way out where a recorded component would have to change."""
    spec: Kind = experiment.scenario.specs[name]
    if name in experiment.uncomputed:
        return experiment.uncomputed[name]
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
