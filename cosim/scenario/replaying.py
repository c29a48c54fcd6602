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

RECORDED = (
    "is taken from the recording: it does not answer to what was changed before it; "
    "run the scenario for that"
)


def valid_designs(
    experiment: Experiment, source: Log, changed: Mapping[str, Any]
) -> dict[str, Design]:
    """Return the recorded designs that still hold.

    Nothing that they rest on has changed, nor which inputs have a zero-order hold.

    Raises
    ------
    UsageError
        If a component was changed that is taken from the recording.
    """
    designs = {}
    for name, spec in experiment.scenario.specs.items():
        touched = sorted(key for key in changed if short(key).split(".")[0] == name)
        if touched and not spec.computable:
            raise UsageError(
                f"--set {touched[0]}: {name!r} is taken from the recording; "
                "run the scenario to change it"
            )
        recorded = source.metadata.get(f"cosim.component.{name}", {}).get("fingerprint")
        same_tables = recorded == fingerprint(experiment.scenario, name, experiment.reads[name])
        same_hold = np.array_equal(source.held[name], experiment.graph.held[name])
        if not spec.computable or (same_tables and same_hold):
            designs[name] = source.designs[name]
    return designs


def unaffected_warnings(
    experiment: Experiment, changed: Mapping[str, Any]
) -> list[tuple[str, str]]:
    """Return warnings of recorded components behind a change: their outputs stay as they were."""
    specs = experiment.scenario.specs
    recorded = {name for name, spec in specs.items() if not spec.computable}
    keys = [short(key).split(".") for key in changed]
    rewired = {parts[1] for parts in keys if parts[0] == "connections"}
    affected = _affected(experiment, keys) | rewired
    drivers = _drivers(experiment)
    newly_affected = affected
    while newly_affected:
        newly_affected = {
            name for name in specs if name not in affected | recorded and drivers[name] & affected
        }
        affected = affected | newly_affected
    if any(
        parts in (["scenario", "input_interpolation"], ["scenario", "coupling"]) for parts in keys
    ):
        affected = affected | set(specs)
    return [
        (name, RECORDED)
        for name in specs
        if name in recorded and (name in rewired or drivers[name] & affected)
    ]


def _affected(experiment: Experiment, keys: list[list[str]]) -> set[str]:
    """Return the components that are changed themselves, or by a model that they read."""
    models = {".".join(parts[:2]) for parts in keys if parts[0] == "models"}
    names = {parts[0] for parts in keys}
    for name in experiment.scenario.specs:
        if experiment.reads[name] & models:
            names.add(name)
    return names


def _drivers(experiment: Experiment) -> dict[str, set[str]]:
    """Return the components that drive each component."""
    drivers: dict[str, set[str]] = {name: set() for name in experiment.scenario.specs}
    for to, connection in experiment.scenario.connections.items():
        drivers[to.component].update(source.component for source in connection.sources)
    return drivers
