"""Components that answer less often than every communication step."""

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
        self._count = 0
        self._y = self._component.initialize(t, u)
        return self._y

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs of the last own step; at its instant they follow the inputs."""
        return self._component.outputs(t, u) if self._count == 0 else self._y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Buffer K rows; advance the component wherever one of its own steps ends."""
        rows = np.empty((len(t) - 1, len(self._y)))
        for k in range(len(t) - 1):
            if self._count == 0:
                self._start = float(t[k]), u[k].copy()
            self._count += 1
            if self._count == self._n:
                try:
                    begin, u0 = self._start
                    self._y = self._component.advance(np.array([begin, t[k + 1]]), h * self._n, np.vstack([u0, u[k + 1]]))[0]
                except Stopped as stop:
                    raise Stopped(rows[:k], str(stop), failed=stop.failed) from stop
                self._count = 0
            rows[k] = self._y
        return rows


class Decimated:
    """Advances a component at every communication step; its outputs are passed on at every n-th only, and hold between.

    Parameters
    ----------
    component : Component
    n : int
        Communication steps between two answers.
    """

    def __init__(self, component: Component, n: int) -> None:
        if n < 1:
            raise ClockError(f"period: found {n} communication steps, needed at least 1")
        self._component, self._n = component, n
        found = component.interface
        self.interface = Interface(found.inputs, tuple(replace(signal, variability="discrete") for signal in found.outputs))

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component."""
        return self._component.prepare(h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start the component; the first answer is the one at the start."""
        self._count = 0
        self._y = self._component.initialize(t, u)
        return self._y

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the last answer."""
        return self._y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance K steps; pass on the answers that are due."""
        steps = len(t) - 1
        stopped = None
        try:
            y = self._component.advance(t, h, u)
        except Stopped as stop:
            y, stopped = stop.outputs, stop
        known = np.vstack([self._y, y])
        count = self._count + np.arange(1, len(y) + 1)
        last_due = np.arange(1, len(y) + 1) - count % self._n
        rows = known[np.maximum(last_due, 0)]
        if len(y):
            self._y, self._count = rows[-1].copy(), int(count[-1] % self._n)
        if stopped is not None:
            raise Stopped(rows, str(stopped), failed=stopped.failed) from stopped
        assert len(rows) == steps
        return rows
