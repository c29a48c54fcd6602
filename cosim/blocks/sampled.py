"""A component that lives on a larger step of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Component, Design, Stopped
from cosim.core.signals import Interface
from cosim.errors import ClockError


class Sampled:
    """Advances a component by steps of n communication steps; its outputs change when such a step has ended, and hold between.

    Parameters
    ----------
    component : Component
    n : int
        Communication steps in one of its own.
    """

    def __init__(self, component: Component, n: int) -> None:
        if n < 1:
            raise ClockError(f"period: found {n} communication steps, needed at least 1")
        self._component, self._n = component, n
        found = component.interface
        outputs = tuple(replace(signal, variability="discrete") for signal in found.outputs)
        self.interface = Interface(found.inputs, outputs, found.feedthrough)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component for its own step."""
        return self._component.prepare(h * self._n, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start the component; its first own step begins here."""
        self._count, self._t, self._u = 0, t, u.copy()
        self._y = self._component.initialize(t, u)
        return self._y

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs of the last own step; at its instant they follow the inputs."""
        return self._component.outputs(t, u) if self._count == 0 else self._y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Buffer K rows; advance the component wherever one of its own steps ends."""
        rows = np.empty((len(t) - 1, len(self._y)))
        for k in range(len(t) - 1):
            self._count += 1
            if self._count == self._n:
                try:
                    own = np.array([self._t, t[k + 1]]), np.vstack([self._u, u[k + 1]])
                    self._y = self._component.advance(own[0], h * self._n, own[1])[0]
                except Stopped as stop:
                    raise Stopped(rows[:k], str(stop), failed=stop.failed) from stop
                self._count, self._t, self._u = 0, float(t[k + 1]), u[k + 1].copy()
            rows[k] = self._y
        return rows
