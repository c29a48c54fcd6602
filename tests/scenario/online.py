"""The example with its identifier by output error, at a step of 10 ms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from cosim.arrays import Matrix
from cosim.core.contracts import Component
from cosim.scenario.building.build import Builder
from cosim.scenario.document.document import find
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.running.execution import load

H = 0.01
ONLINE = {"identifier.method": "output-error", "identifier.period": 0.1}
THETA = np.array([-0.1, -0.3])
# the filter does not lag by more than the step, and mu counts once its delays have passed
COARSE = {
    "scenario.step": H,
    "scenario.stop": 20.0,
    "observer.filter_rate": 100.0,
    "identifier.start": 3.5,
    **ONLINE,
}
# of academic-noisy: two outputs, the second one a hundred times less noisy
TWO_OUTPUTS = {
    "scenario.step": H,
    "scenario.stop": 20.0,
    "models.academic.C": [[2.0, 0.0, 1.0], [1.0, 0.5, 0.0]],
    "sensor.size": 2,
    "sensor.noise": [0.1, 1e-3],
    "observer.L": [[4.25, 1.0], [-5.0, 4.0]],  # poles at -4 and -5
    "observer.filter_rate": 100.0,
}
SENSOR = """
[components.sensor]
kind = "sensor"
noise = 1e-3
seed = 1

[connections]
"sensor.u" = "plant.y"
"""


def noisy(folder: Path) -> str:
    """Write the example with noise of deviation 1e-3 on y; return its path."""
    text = find("academic").text
    text = text.replace("[connections]", SENSOR, 1)
    text = text.replace('"observer.y" = "plant.y"', '"observer.y" = "sensor.y"')
    path = folder / "noisy.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def run(scenario: str = "academic", **changes: Any) -> Any:
    """Run with changes of the identifier, in memory."""
    own = {f"identifier.{key}": value for key, value in changes.items()}
    return cosim.run(scenario, set={**COARSE, **own})


def identifier(scenario: str, settings: dict[str, Any]) -> Component:
    """Return the identifier of a scenario, not prepared."""
    with ExitStack() as resources:
        graph = Builder(load(scenario).set(settings), resources).experiment().graph
    return graph.components["identifier"]


def identifiers(scenario: str | Scenario, settings: dict[str, Any]) -> Callable[[], Component]:
    """Return what makes the identifier of a scenario, not prepared, beside the rest of it.

    A check of the contract takes some 60 of them.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    builder = Builder(loaded.set(settings), ExitStack())
    spec = builder.scenario.specs["identifier"]
    context = builder.context
    period = spec.period_steps("identifier", context.step_ns)
    return lambda: spec.with_period(spec.build("identifier", context), period)


def inputs(log: Any) -> Matrix:
    """Return what the identifier of a run took, at every communication point."""
    signals = ("regressor.mu", "observer.delta", "plant.y", "u.y")
    columns = []
    for signal in signals:
        rows = log[signal]
        columns.append(np.reshape(rows, (len(rows), -1)))
    return np.ascontiguousarray(np.hstack(columns))
