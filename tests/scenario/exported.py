"""The components of the shipped scenarios as FMUs, beside what they did in a run."""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.contracts import Component, prepare
from cosim.core.linear import LinearModel
from cosim.scenario.building.build import Builder
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.running.execution import load
from tests.scenario.signals import signals

H = 1e-3
STOP = 4.2  # s
# theta is there at the end, and the log has every row
START = {"scenario.stop": STOP, "identifier.start": 3.5, "identifier.period": H}
LEAST_SQUARES = {"identifier.method": "least-squares"}
SAMPLED = {"controller.period": 0.01}
ACADEMIC = [("academic", name) for name in ("plant", "observer", "regressor", "identifier")]
LOOP = [("closed-loop", name) for name in ("feedback", "error", "controller")]
# the same kinds with other signals
AGAIN = [
    *[("closed-loop", name) for name in ("plant", "observer", "regressor", "identifier")],
    ("held-online", "identifier"),
]
SAMPLED_COMPONENTS = [
    ("sampled", "controller"),
    ("step", "controller"),
    ("slow", "identifier"),
    ("held", "identifier"),
    ("online", "identifier"),
]
COMPONENTS = [
    ACADEMIC[0],
    *(
        pytest.param(*component, marks=pytest.mark.slow)
        for component in (*ACADEMIC[1:], *LOOP, *SAMPLED_COMPONENTS)
    ),
    *(pytest.param(*component, marks=pytest.mark.campaign) for component in AGAIN),
]
# linear models that have states
STATES = [("academic", "plant"), ("academic", "observer"), ("closed-loop", "controller")]
DRIVERS = {
    "sampled": ("error.y",),
    "slow": ("regressor.mu",),
    "online": ("regressor.mu", "observer.delta", "sensor.y", "u.y"),
}
NOISY = ("online", "held-online")
CHANGES = {
    "sampled": SAMPLED,
    "step": {"controller.period": H},
    "slow": {**LEAST_SQUARES, "identifier.period": 0.1},
    "held": {**LEAST_SQUARES, "scenario.input_interpolation": "zero-order"},
    "online": {"identifier.period": 0.1},
    "held-online": {"scenario.input_interpolation": "zero-order"},
}


@dataclass(frozen=True)
class Case:
    """A component with its inputs and outputs in a run."""

    scenario: str
    name: str
    component: Component
    model: LinearModel | None
    held: Any
    t: Any
    u: Any
    y: Any


def scenario_of(key: str) -> tuple[str, dict[str, Any]]:
    name = "closed-loop"
    if key in ("academic", "slow", "held"):
        name = "academic"
    if key in NOISY:
        name = "academic-noisy"
    return name, {**START, **CHANGES.get(key, {})}


@cache
def recorded(key: str) -> Any:
    name, changes = scenario_of(key)
    return signals(name, set=changes)


@cache
def case(key: str, name: str) -> Case:
    """Return a component, built for a run, with its recorded inputs and outputs."""
    scenario, changes = scenario_of(key)
    loaded = load(scenario).set(changes)
    run = recorded(key)
    with ExitStack() as resources:
        graph = Builder(loaded, resources).experiment().graph
        context = BuildContext(loaded, resources)
        model = loaded.specs[name].linear_model(name, context) if (key, name) in STATES else None
    component = graph.components[name]
    t = np.arange(round(STOP / H) + 1) * 1_000_000 / 1e9
    if key in DRIVERS:
        # the log keeps only the rows at its period, so it runs here on what drove it
        prepare(component, H, graph.held[name], {})
        driving = [np.reshape(run[port], (len(t), -1)) for port in DRIVERS[key]]
        u = np.ascontiguousarray(np.hstack(driving))
        y = np.vstack([component.initialize(0.0, u[0]), component.advance(t, H, u)])
    else:
        u = columns(run, name, component.interface.inputs)
        y = columns(run, name, component.interface.outputs)
    return Case(scenario, name, component, model, graph.held[name], t, u, y)


def columns(run: Any, name: str, ports: Any) -> Any:
    """Return the signals of a component side by side, at every communication point."""
    arrays = []
    for signal in ports:
        rows = run[f"{name}.{signal.name}"]
        arrays.append(np.reshape(rows, (-1, signal.size)))
    return np.ascontiguousarray(np.hstack(arrays))


def export(key: str, name: str, fmi: str, folder: Path) -> Path:
    scenario, changes = scenario_of(key)
    path = folder / f"{key}-{name}-{fmi}.fmu"
    if not path.exists():
        export_component(load(scenario).set(changes), name, path, fmi=fmi)
    return path


def drive(component: Any, original: Case, held: Any = None) -> Any:
    """Run a component on recorded inputs; return its outputs in the order of the original."""
    prepare(component, H, original.held if held is None else held, {})
    first = component.initialize(0.0, original.u[0])
    y = np.vstack([first, component.advance(original.t, H, original.u)])
    columns_of = component.interface.output_columns()
    outputs = original.component.interface.outputs
    return np.hstack([y[:, columns_of[signal.name]] for signal in outputs])
