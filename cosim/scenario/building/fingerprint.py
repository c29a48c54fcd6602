"""The hash of what the design of a component rests on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from cosim.core.clock import exact_nanoseconds
from cosim.instants import step_value
from cosim.scenario.building.parsing import Scenario


def fingerprint(scenario: Scenario, name: str, reads: frozenset[str]) -> str:
    """Hash everything that the design of a component rests on.

    This is its table, the tables that it read, communication step and substeps, input interpolation
    and coupling.
    """
    settings = scenario.file.scenario
    names = sorted({f"components.{name}", *reads})
    tables = {dotted: _table(scenario.tree, dotted) for dotted in names}
    method: list[Any] = [settings.coupling, settings.iterations]
    if settings.substeps is not None:
        method.append(settings.substeps.model_dump())
    step = step_value(exact_nanoseconds(settings.step))
    values = [tables, step, settings.input_interpolation or "linear", *method]
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _table(tree: Mapping[str, Any], dotted: str) -> Any:
    table, _, name = dotted.partition(".")
    return tree.get(table, {}).get(name)
