"""Small components to build graphs from."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from cosim.blocks.arithmetic import gain
from cosim.blocks.dynamics import lag
from cosim.blocks.state_space import controller
from cosim.core.contracts import InputWiring, Stopped, Wired
from cosim.core.linear import Linear, LinearModel
from cosim.core.signals import Interface, Signal


def integrator(rate: float = 1.0, start: float = 0.0) -> Linear:
    """Return x' = rate (u - x), y = x: no feedthrough."""
    return Linear(lag(time_constant=1.0 / rate, initial=start))


def through(D: float = 0.5) -> Linear:
    """Return x' = -2 x + u, y = x + D u, x."""
    return Linear(
        controller(
            A=np.array([[-2.0]]), B=np.eye(1), C=np.eye(1), D=np.array([[D]]), x0=np.array([0.3])
        )
    )


def driven(component: Wired, held: Collection[bool] | None = None):
    """Return a component, all of whose inputs are driven; held ones by discrete signals."""
    none = np.zeros(component.interface.n_u, np.bool_)
    component.take_wiring(InputWiring(~none, none if held is None else np.array(held), none, none))
    return component


def times(K: float):
    """Return y = K u."""
    return gain(np.array([[K]]))


def half_through() -> Linear:
    """Return a plant x' = -3 x + u with v = x, and y = 2 x + 0.5 u, which feeds through."""
    interface = Interface((Signal("u"),), (Signal("v"), Signal("y")), {"v": (), "y": ("u",)})
    C = np.array([[1.0], [2.0]])
    D = np.array([[0.0], [0.5]])
    return Linear(
        LinearModel(
            interface, ("x",), -3.0 * np.eye(1), np.eye(1), C, D, np.array([1.0]), np.zeros((1, 1))
        )
    )


class Scripted:
    """A component with the output ``values[k]`` at step k, whatever its inputs.

    It raises the value of a step if that is an exception.
    """

    def __init__(self, values, *, optional=False, inputs=0):
        self.values = values
        self.interface = Interface(
            tuple(Signal(f"u{i}") for i in range(inputs)), (Signal("y", optional=optional),)
        )

    def initialize(self, t, u):
        self.k = 0
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.values[self.k]], np.float64)

    def advance(self, t, h, u):
        assert len(t) > 1, "asked to advance over no step"
        rows = []
        for _ in range(len(t) - 1):
            value = self.values[self.k + 1]
            if isinstance(value, Stopped):
                raise Stopped(
                    np.array([*rows, *value.outputs], np.float64).reshape(-1, 1),
                    str(value),
                    failed=value.failed,
                )
            if isinstance(value, Exception):
                raise value
            self.k += 1
            rows.append([value])
        return np.array(rows, np.float64).reshape(-1, 1)


class Starter:
    """A component that stays at its initial ``y = function(u1, u2, ...)``, without feedthrough.

    It records the inputs of every initialization.
    """

    def __init__(
        self, function, inputs=("u",), *, declared=..., size=1, signal_type="real", start=()
    ):
        self.function = function
        self.calls = []
        signals = tuple(Signal(name, size, type=signal_type, start=start) for name in inputs)
        initial = {"y": tuple(inputs) if declared is ... else declared}
        self.interface = Interface(
            signals, (Signal("y", size, type=signal_type),), {"y": ()}, initial
        )

    def initialize(self, t, u):
        self.calls.append(u.tolist())
        self.y = np.atleast_1d(
            np.asarray(self.function(*np.split(u, len(self.interface.inputs))), np.float64)
        ).copy()
        return self.y.copy()

    def outputs(self, t, u):
        return self.y.copy()

    def advance(self, t, h, u):
        return np.tile(self.y, (len(t) - 1, 1))


class InPython:
    """A component without its compiled step."""

    def __init__(self, component):
        self.interface = replace(component.interface, native=False, linearizable=False)
        self._component = component
        self.prepare = component.prepare
        self.initialize = component.initialize
        self.outputs = component.outputs
        self.advance = component.advance
        self.save = component.save
        self.restore = component.restore
