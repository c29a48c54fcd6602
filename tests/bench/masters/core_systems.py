"""What runs without FMUs: lags in a loop, shipped scenarios, components written in Python."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.blocks.dynamics import lag
from cosim.blocks.source import sine
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.signals import Interface, Signal
from cosim.scenario.building.build import Builder
from cosim.scenario.running.execution import load
from tests.bench.masters.systems import Lag, System

GAIN = -0.9  # of the connection from the last lag of a loop to the first one
OFFSET = 1.0
WITHOUT_IDENTIFIER = " - identifier"  # end of the name of a scenario


def loop_of_lags(count: int) -> System:
    """Return lags in a loop, as :func:`lags` builds them."""
    described = [Lag(gain=GAIN, bias=OFFSET, source=count - 1)]
    for i in range(1, count):
        described.append(Lag(gain=1.0, bias=0.0, source=i - 1))
    return System(f"lags-{count}", tuple(described))


def lags(count: int) -> Graph:
    """Build lags in a loop."""
    components = {}
    connections = {"lag0.u": Connection(f"lag{count - 1}.y", gain=GAIN, offset=OFFSET)}
    for i in range(count):
        components[f"lag{i}"] = Linear(lag(time_constant=1.0, initial=0.0))
        if i:
            connections[f"lag{i}.u"] = Connection(f"lag{i - 1}.y")
    return Graph(components, connections)


def scenario(name: str, stop: float, resources: ExitStack, **changes: list[float]) -> Graph:
    """Build a shipped scenario; some of its components keep as many samples as it lasts, [s]."""
    changed = load(name).set({"scenario.stop": stop, **changes})
    return Builder(changed, resources, block=None).experiment().graph


def academic_member(number: int, stop: float, resources: ExitStack) -> Graph:
    """Build ``academic`` without its identifier from another initial state for each number."""
    changes = {"plant.x_a0": [1.0 + 0.01 * number, -1.0]}
    return without_identifier(scenario("academic", stop, resources, **changes))


def without_identifier(graph: Graph) -> Graph:
    """Build a graph anew without its identifier, which drives nothing."""
    components = dict(graph.components)
    del components["identifier"]
    connections = {}
    for to, connection in graph.connections.items():
        if to.component in components:
            connections[to] = connection
    return Graph(components, connections)


class PythonLag:
    """A lag ``y' = u - y`` from y = 0, by the trapezoidal rule for u, as a user writes one."""

    def __init__(self) -> None:
        self.interface = Interface((Signal("u"),), (Signal("y"),))
        self._y = 0.0

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at 0."""
        self._y = 0.0
        return np.zeros(1)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y."""
        return np.array([self._y])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step row by row."""
        y = np.empty((len(u) - 1, 1))
        value = self._y
        values = u[:, 0].tolist()
        before = values[0]
        for k, after in enumerate(values[1:]):
            value += h * (0.5 * (before + after) - value)
            y[k, 0] = value
            before = after
        self._y = value
        return y


def python_cascade() -> Graph:
    """Build a lag in Python behind a source."""
    components: dict[str, Component] = {"source": sine(rate=1.0), "python": PythonLag()}
    return Graph(components, {"python.u": "source.y"})


def python_loop() -> Graph:
    """Build a lag in Python in a loop with another."""
    native = Linear(lag(time_constant=1.0, initial=0.0))
    components: dict[str, Component] = {"python": PythonLag(), "lag": native}
    back = Connection("lag.y", gain=GAIN, offset=OFFSET)
    return Graph(components, {"python.u": back, "lag.u": Connection("python.y")})


def graph_of(name: str, stop: float, resources: ExitStack) -> Graph:
    """Build what a case names; ``stop`` is the end of its run [s]."""
    if name.startswith("lags-"):
        return lags(int(name.removeprefix("lags-")))
    if name == "python-cascade":
        return python_cascade()
    if name == "python-loop":
        return python_loop()
    if name.endswith(WITHOUT_IDENTIFIER):
        return without_identifier(scenario(name.removesuffix(WITHOUT_IDENTIFIER), stop, resources))
    return scenario(name, stop, resources)
