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


def designs_that_hold(
    experiment: Experiment, source: Log, changed: Mapping[str, Any]
) -> dict[str, Design]:
    """Give the recorded designs that still hold: nothing that they rest on has changed, nor which inputs are held."""
    designs = {}
    for name, spec in experiment.scenario.specs.items():
        touched = sorted(key for key in changed if short(key).split(".")[0] == name)
        if touched and not spec.computable:
            raise UsageError(
                f"--set {touched[0]}: {name!r} is taken from the recording; run the scenario to change it"
            )
        recorded = source.metadata.get(f"cosim.component.{name}", {}).get("fingerprint")
        same = recorded == fingerprint(experiment.scenario, name, experiment.reads[name])
        if not spec.computable or (
            same and np.array_equal(source.held[name], experiment.graph.held[name])
        ):
            designs[name] = source.designs[name]
    return designs


def cut_off(experiment: Experiment, changed: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Warn of recorded components behind something that was changed: their inputs change, their outputs do not."""
    scenario, keys = experiment.scenario, [short(key).split(".") for key in changed]
    rewired = {parts[1] for parts in keys if parts[0] == "connections"}
    models = {".".join(parts[:2]) for parts in keys if parts[0] == "models"}
    behind = (
        rewired
        | {parts[0] for parts in keys}
        | {name for name in scenario.specs if experiment.reads[name] & models}
    )
    drivers: dict[str, set[str | None]] = {name: set() for name in scenario.specs}
    for to in scenario.connections:
        drivers[to.partition(".")[0]].add(scenario.driver(to))
    recorded = {name for name, spec in scenario.specs.items() if not spec.computable}
    while more := {name for name in drivers.keys() - behind - recorded if drivers[name] & behind}:
        behind |= more
    if {"scenario.input_interpolation", "scenario.coupling"} & {".".join(parts) for parts in keys}:
        behind |= set(scenario.specs)
    text = "is taken from the recording: it does not answer to what was changed before it; run the scenario for that"
    return [
        (name, text)
        for name in scenario.specs
        if name in recorded and (name in rewired or drivers[name] & behind)
    ]
