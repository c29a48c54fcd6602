"""Components that answer less often than every communication step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.clock import NANOSECONDS
from cosim.core.contracts import Component, Design, Stopped, prepare
from cosim.core.signals import Interface
from cosim.errors import ClockError, RunError


def _held_between(interface: Interface, n: int) -> Interface:
    """Give the interface of a component that answers at every n-th step: its outputs hold between.

    Raises
    ------
    ClockError
        If n is less than 1.
    """
    if n < 1:
        raise ClockError(f"period: found {n} communication steps, needed at least 1")
    return replace(
        interface,
        outputs=tuple(replace(signal, variability="discrete") for signal in interface.outputs),
        prepares=True,
        rollback=False,
    )


class Sampled:
    """Advances a component by steps of n communication steps; its outputs change when such a step has ended, and hold between.

    What holds are the outputs for the inputs at the end of such a step, also where a loop knew these only afterwards.

    Parameters
    ----------
    component : Component
    n : int
        Communication steps in one of its own.
    hold : bool
        It samples its inputs at the start of its own step and holds them, as a digital controller does; else those that are not
        held anyway move in straight lines from there to the end of its own step.
    """

    def __init__(self, component: Component, n: int, *, hold: bool = False) -> None:
        self.interface = _held_between(component.interface, n)
        self._component, self._n, self._hold = component, n, hold

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component for its own step."""
        return prepare(self._component, self._own(h), held | self._hold, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start the component; its first own step begins here."""
        self._count = 0
        self._y = self._component.initialize(t, u).copy()
        return self._y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs of the last own step; at its instant they follow the inputs."""
        return self._component.outputs(t, u) if self._count == 0 else self._y.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Buffer K rows; advance the component wherever one of its own steps ends."""
        rows = np.empty((len(t) - 1, len(self._y)))
        for k in range(len(t) - 1):
            try:
                rows[k] = self._step(t[k : k + 2], h, u[k : k + 2])
            except Stopped as stop:
                rows[k : k + stop.steps] = (
                    stop.outputs
                )  # it may have completed its step before it ends
                raise Stopped(rows[: k + stop.steps], str(stop), failed=stop.failed) from stop
            except RunError as error:
                raise Stopped(rows[:k], str(error)) from error
        return rows

    def _step(self, t: Vector, h: float, u: Matrix) -> Vector:
        if self._count == 0:
            self._start = float(t[0]), u[0].copy()
            self._y = self._component.outputs(float(t[0]), u[0])
        self._count += 1
        if self._count == self._n:
            begin, u0 = self._start
            self._y = self._component.advance(
                np.array([begin, t[1]]), self._own(h), np.vstack([u0, u[1]])
            )[0].copy()
            self._count = 0
        return self._y

    def _own(self, h: float) -> float:
        """Give its own step [s], from whole nanoseconds."""
        return round(h * NANOSECONDS) * self._n / NANOSECONDS


class Decimated:
    """Advances a component at every communication step; its outputs are passed on at every n-th only, and hold between.

    Parameters
    ----------
    component : Component
    n : int
        Communication steps between two answers.
    """

    def __init__(self, component: Component, n: int) -> None:
        self.interface = _held_between(component.interface, n)
        self._component, self._n = component, n

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component."""
        return prepare(self._component, h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start the component; the first answer is the one at the start."""
        self._count = 0
        self._y = self._component.initialize(t, u).copy()
        return self._y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the last answer; at its instant it follows the inputs."""
        return self._component.outputs(t, u) if self._count == 0 else self._y.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance K steps; pass on the answers that are due."""
        stopped: Stopped | None = None
        y = np.empty((0, len(self._y)))
        try:
            if self._count == 0:  # what a loop knew late is known now
                self._y = self._component.outputs(float(t[0]), u[0])
            y = self._component.advance(t, h, u)
        except Stopped as stop:
            y, stopped = stop.outputs, stop
        except RunError as error:
            stopped = Stopped(y, str(error))
        known = np.vstack([self._y, y])
        count = self._count + np.arange(1, len(y) + 1)
        last_due = np.arange(1, len(y) + 1) - count % self._n
        rows: Matrix = known[np.maximum(last_due, 0)]
        if len(y):
            self._y, self._count = rows[-1].copy(), int(count[-1] % self._n)
        if stopped is not None:
            raise Stopped(rows, str(stopped), failed=stopped.failed) from stopped
        return rows
