"""What of a recording still holds when its scenario runs again with changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.core.contracts import Design
from cosim.errors import UsageError
from cosim.log import Log
from cosim.scenario.build import Experiment, fingerprint
from cosim.scenario.document import short

EVERYWHERE = {"scenario.input_interpolation", "scenario.coupling"}  # keys that matter to all
RECORDED = (
    "is taken from the recording: it does not follow changes upstream; run the scenario for that"
)


def valid_designs(
    experiment: Experiment, source: Log, changed: Mapping[str, Any]
) -> dict[str, Design]:
    """Return the recorded designs that still hold: those that rest on nothing that changed.

    Raises
    ------
    UsageError
        If a component was changed that is taken from the recording.
    """
    designs = {}
    for name, spec in experiment.scenario.specs.items():
        touched = sorted(key for key in changed if _component_of(key) == name)
        if touched and not spec.computable:
            raise UsageError(
                f"--set {touched[0]}: {name!r} is taken from the recording; "
                "run the scenario to change it"
            )
        recorded = source.metadata.get(f"cosim.component.{name}", {})
        current = fingerprint(experiment.scenario, name, experiment.reads[name])
        same_tables = recorded.get("fingerprint") == current
        held = experiment.graph.held[name]
        same_hold = np.array_equal(source.held[name], held)
        if not spec.computable or (same_tables and same_hold):
            designs[name] = source.designs[name]
    return designs


def _component_of(key: str) -> str:
    """Return what the key of a component's parameter begins with."""
    return short(key).split(".")[0]


def unaffected_warnings(
    experiment: Experiment, changed: Mapping[str, Any]
) -> list[tuple[str, str]]:
    """Return warnings of recorded components behind a change: their outputs stay as they were."""
    specs = experiment.scenario.specs
    keys = [short(key) for key in changed]
    rewired = _second_parts(keys, "connections")
    drivers = _drivers(experiment)
    affected = set(specs)
    if EVERYWHERE.isdisjoint(keys):
        affected = _spread(_changed_components(experiment, keys) | rewired, experiment)
    warnings = []
    for name, spec in specs.items():
        if not spec.computable and (name in rewired or drivers[name] & affected):
            warnings.append((name, RECORDED))
    return warnings


def _spread(changed: set[str], experiment: Experiment) -> set[str]:
    """Return changed components and those that they reach; a recorded one passes nothing on."""
    drivers = _drivers(experiment)
    specs = experiment.scenario.specs
    computed = {name for name, spec in specs.items() if spec.computable}
    affected = set(changed)
    reached = affected
    while reached:
        reached = {name for name in computed - affected if drivers[name] & affected}
        affected |= reached
    return affected


def _second_parts(keys: list[str], table: str) -> set[str]:
    """Return what is changed in a table: the second part of the keys that begin with it."""
    prefix = f"{table}."
    return {key.split(".")[1] for key in keys if key.startswith(prefix)}


def _changed_components(experiment: Experiment, keys: list[str]) -> set[str]:
    """Return the components that are changed themselves, or by a model that they read."""
    models = {f"models.{name}" for name in _second_parts(keys, "models")}
    names = {_component_of(key) for key in keys}
    for name in experiment.scenario.specs:
        if experiment.reads[name] & models:
            names.add(name)
    return names


def _drivers(experiment: Experiment) -> dict[str, set[str]]:
    """Return the components that drive each component."""
    scenario = experiment.scenario
    drivers: dict[str, set[str]] = {name: set() for name in scenario.specs}
    for to, connection in scenario.connections.items():
        for source in connection.sources:
            drivers[to.component].add(source.component)
    return drivers
