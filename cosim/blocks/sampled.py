"""Components whose outputs change less often than at every communication step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import (
    Component,
    Design,
    InputWiring,
    Native,
    Rollback,
    Stopped,
    linearized,
    prepare,
    take_wiring,
)
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface
from cosim.errors import ClockError, RunError, steps_text
from cosim.instants import step_of, step_seconds
from cosim.native.blocks.wrapping import (
    DecimatedMemory,
    SampledMemory,
    decimated_step,
    sampled_step,
)
from cosim.native.step import NativeStep


class SampledState(NamedTuple):
    """The state of a sampled component.

    Parameters
    ----------
    component : object
        Its own.
    steps : int
        Communication steps since its own step began; negative before the first one.
    y : Vector, shape (n_y,)
        The outputs that are held.
    begin : (float, Vector) or None
        Time [s] and inputs where its own step began; None: none has.
    """

    component: object
    steps: int
    y: Vector
    begin: tuple[float, Vector] | None


class DecimatedState(NamedTuple):
    """The state of a component whose outputs are sampled; see :class:`SampledState`."""

    component: object
    steps: int
    y: Vector


class Sampled:
    """Advances a component by steps of n communication steps.

    Its outputs change when such a step has ended, and hold between. They are the outputs for the
    inputs at the end of such a step, also where a loop first extrapolated these.

    Parameters
    ----------
    component : Component
    n : int
        Communication steps in a step of its own.
    hold : bool
        It samples its inputs at the start of its own step and holds them, as a digital controller
        does; else those without a zero-order hold are interpolated linearly over its own step.
    offset : int
        Communication steps until its first step begins, fewer than n; until then its outputs are
        the initial ones.

    Raises
    ------
    ClockError
        If n is less than 1, or the offset negative or not less than n.
    """

    def __init__(
        self, component: Component, n: int, *, hold: bool = False, offset: int = 0
    ) -> None:
        interface = _held_between(component.interface, n)
        if not 0 <= offset < n:
            raise ClockError(
                f"offset: expected 0 or more, and less than the period of {steps_text(n)}, got "
                f"{steps_text(offset)}"
            )
        self._offset = offset
        if hold:
            names = tuple(signal.name for signal in interface.inputs)
            interface = replace(interface, delayed=names)
        self.interface = interface
        self._component = component
        self._n = n
        self._hold = hold
        self._own_h = 0.0
        self._memory = SampledMemory(interface.n_u, interface.n_y)

    def take_wiring(self, wiring: InputWiring) -> None:
        """Say it to the component."""
        take_wiring(self._component, replace(wiring, held=wiring.held | self._hold))

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component for its own step."""
        held_inputs = held | self._hold
        self._own_h = self._own_step(h)
        return prepare(self._component, self._own_step(h), held_inputs, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the component; its first own step begins here, or after the offset."""
        self._memory.steps = -self._offset
        self._memory.y[:] = self._component.initialize(t, u)
        if self._offset:
            self._memory.y[:] = self._component.outputs(t, u)
        return self._memory.y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs of the last own step; at its instant they follow the inputs."""
        if self._memory.steps == 0:
            return self._component.outputs(t, u)
        return self._memory.y.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Buffer K rows; advance the component wherever one of its own steps ends."""
        steps = len(t) - 1
        rows = np.empty((steps, self.interface.n_y))
        for k in range(steps):
            ends = slice(k, k + 2)
            try:
                rows[k] = self._step(t[ends], h, u[ends])
            except Stopped as stop:
                completed = k + stop.steps  # it may have completed its step before it stopped
                rows[k:completed] = stop.outputs
                y = rows[:completed]
                raise Stopped(y, str(stop), failed=stop.failed) from stop
            except RunError as error:
                raise Stopped(rows[:k], str(error)) from error
        return rows

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize the component, with steps of its own."""
        inner = linearized(self._component, t, u)
        return (
            None if inner is None else inner.sampled(self._n, hold=self._hold, offset=self._offset)
        )

    def save(self) -> SampledState:
        """Copy the state, and that of the component, which can go back too."""
        component = cast(Rollback[Any], self._component).save()
        memory = self._memory
        begin = (memory.begin, memory.u_begin.copy()) if memory.steps else None
        return SampledState(component, memory.steps, memory.y.copy(), begin)

    def restore(self, state: SampledState) -> None:
        """Go back to a saved state."""
        cast(Rollback[Any], self._component).restore(state.component)
        memory = self._memory
        memory.steps = state.steps
        memory.y[:] = state.y
        if state.begin is not None:
            begin, u_begin = state.begin
            memory.begin = begin
            memory.u_begin[:] = u_begin

    def native(self) -> NativeStep | None:
        """Return the compiled step, if the component has one."""
        step = cast(Native, self._component).native()
        if step is None:
            return None
        return sampled_step(step, self._memory, steps=self._n, h=self._own_h)

    def _step(self, t: Vector, h: float, u: Matrix) -> Vector:
        """Take one communication step, ``t`` (2,) and ``u`` (2, n_u); return the outputs held."""
        memory = self._memory
        if memory.steps < 0:
            if memory.steps == -1:
                memory.y[:] = self._component.outputs(float(t[1]), u[1])
            memory.steps += 1
            return memory.y
        if memory.steps == 0:
            memory.begin = float(t[0])
            memory.u_begin[:] = u[0]
            # an input that was extrapolated before is corrected now
            memory.y[:] = self._component.outputs(memory.begin, u[0])
        if memory.steps + 1 < self._n:
            memory.steps += 1
            return memory.y
        own_t = np.array([memory.begin, t[1]])
        own_u = np.vstack([memory.u_begin, u[1]])
        y = self._component.advance(own_t, self._own_step(h), own_u)
        memory.y[:] = y[0]
        memory.steps = 0
        return memory.y

    def _own_step(self, h: float) -> float:
        """Return its own step [s], computed from whole nanoseconds."""
        return step_seconds(step_of(h) * self._n)


class Decimated:
    """Advances a component at every communication step and passes on every n-th of its outputs.

    The outputs hold between.

    Parameters
    ----------
    component : Component
    n : int
        Communication steps between two samples of the outputs.

    Raises
    ------
    ClockError
        If n is less than 1.
    """

    def __init__(self, component: Component, n: int) -> None:
        self.interface = _held_between(component.interface, n)
        self._component = component
        self._n = n
        self._memory = DecimatedMemory(self.interface.n_y)

    def take_wiring(self, wiring: InputWiring) -> None:
        """Say it to the component."""
        take_wiring(self._component, wiring)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component."""
        return prepare(self._component, h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the component; the first sample is its initial output."""
        self._memory.steps = 0
        self._memory.y[:] = self._component.initialize(t, u)
        return self._memory.y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the last sample; at its instant it follows the inputs."""
        if self._memory.steps == 0:
            return self._component.outputs(t, u)
        return self._memory.y.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance K steps; pass on the samples that are due."""
        stopped: Stopped | None = None
        y = np.empty((0, self.interface.n_y))
        try:
            if self._memory.steps == 0:
                # an input that was extrapolated before is corrected now
                self._memory.y[:] = self._component.outputs(float(t[0]), u[0])
            y = self._component.advance(t, h, u)
        except Stopped as stop:
            stopped = stop
            y = stop.outputs
        except RunError as error:
            stopped = Stopped(y, str(error))
        rows = self._held_samples(y)
        if stopped is not None:
            raise Stopped(rows, str(stopped), failed=stopped.failed) from stopped
        return rows

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize the component, with outputs that hold."""
        inner = linearized(self._component, t, u)
        return None if inner is None else inner.decimated(self._n)

    def save(self) -> DecimatedState:
        """Copy the state, and that of the component, which can go back too."""
        component = cast(Rollback[Any], self._component).save()
        return DecimatedState(component, self._memory.steps, self._memory.y.copy())

    def restore(self, state: DecimatedState) -> None:
        """Go back to a saved state."""
        cast(Rollback[Any], self._component).restore(state.component)
        self._memory.steps = state.steps
        self._memory.y[:] = state.y

    def native(self) -> NativeStep | None:
        """Return the compiled step, if the component has one."""
        step = cast(Native, self._component).native()
        if step is None:
            return None
        return decimated_step(step, self._memory, steps=self._n)

    def _held_samples(self, y: Matrix) -> Matrix:
        """Return for each of the rows ``y``, shape (K, n_y), the sample that is held there."""
        if not len(y):
            return y
        memory = self._memory
        known = np.vstack([memory.y, y])  # row 0: the sample before these steps
        row = np.arange(1, len(y) + 1)
        since_sample = (memory.steps + row) % self._n
        rows: Matrix = known[np.maximum(row - since_sample, 0)]
        memory.y[:] = rows[-1]
        memory.steps = int(since_sample[-1])
        return rows


def _held_between(interface: Interface, n: int) -> Interface:
    """Return the interface of a component whose outputs change at every n-th step only."""
    if n < 1:
        raise ClockError(f"period: expected at least 1 communication step, got {n}")
    outputs = tuple(replace(signal, variability="discrete") for signal in interface.outputs)
    return replace(
        interface,
        outputs=outputs,
        prepares=True,
        substeps=False,
        left_limits=(),
        locates_events=False,
    )
