"""Samples that arrive some steps after their instants, for a component that takes them at once.

All inputs are held back by as many steps as the last sample may need. By then every sample stands
in the row of the communication point that ends the step of its instant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.core.contracts import Component, Design, Native, Rollback, Stopped, prepare
from cosim.core.signals import SAMPLE_TIMES, Interface, Signal
from cosim.native.blocks.late_samples import HeldRows, LateColumns, late_samples_step
from cosim.native.step import NativeStep

# of instants as far apart as communication points, with a jitter of at most half their distance
MOST_IN_A_STEP: Final = 3
SAMPLES: Final = "samples"


class Repeatable(Component, Rollback[Any], Protocol):
    """A component that can go back."""


@dataclass(frozen=True, slots=True)
class LateState:
    """The state of the component, and the rows that are held back, behind the time ``passed``."""

    component: Any
    passed: float
    t: Vector
    u: Matrix
    y: Vector


class LateSamples:
    """Holds the inputs of a component back until all samples of a step have arrived.

    Its inputs ``samples`` and ``sample_times`` have one sample of each output in a row, at an
    instant of its own; those of the component have ``MOST_IN_A_STEP``. Its outputs are those of the
    component ``steps`` before.

    Parameters
    ----------
    component : Repeatable
        It takes its inputs at the beginning of a step.
    steps : int
        Communication steps from an instant to the row with its sample, at most.

    Raises
    ------
    Stopped
        From ``advance``, where a sample is older.
    """

    def __init__(self, component: Repeatable, *, steps: int) -> None:
        columns = component.interface.input_columns()
        self._component = component
        self._steps = steps
        self._samples = columns[SAMPLES]
        self._times = columns[SAMPLE_TIMES]
        inputs = tuple(_single_sample(signal) for signal in component.interface.inputs)
        self.interface: Interface = replace(
            component.interface,
            inputs=inputs,
            prepares=True,
            linearizable=False,
            substeps=False,
            left_limits=(),
            locates_events=False,
        )
        self._own = self.interface.input_columns()
        self._held = HeldRows(steps, component.interface.n_u, component.interface.n_y)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component, to whose inputs samples add more of their own."""
        of_component = []
        for signal in self._component.interface.inputs:
            first = self._own[signal.name].start
            of_component.append(np.full(signal.size, held[first]))
        return prepare(self._component, h, np.concatenate(of_component), recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget all rows."""
        row = self._without_samples(u[np.newaxis])
        self._held.passed = float(np.nextafter(t, -np.inf))
        self._held.hold(np.zeros(0), row[:0])
        self._held.y[:] = self._component.initialize(t, row[0])
        return self._held.y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the last outputs."""
        return self._held.y.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K rows, and pass on those that have all their samples."""
        count = len(t) - 1
        held = self._held
        held_t, held_u = held.rows()
        times = np.concatenate([held_t, t[:count]])
        rows = np.concatenate([held_u, self._without_samples(u[:count])])
        late = self._place(times, rows, u[:count])
        if late is not None:
            y = np.empty((0, self.interface.n_y))
            if late:
                y = self.advance(t[: late + 1], h, u[: late + 1])
            raise Stopped(
                y,
                f"the sample at {t[late]} s has a time stamp more than {self._steps} "
                "communication steps back; expected at most the sensor's delay and jitter",
            )
        whole = max(len(times) - self._steps, 0)
        y = np.tile(held.y, (count, 1))
        if whole:
            complete = slice(whole + 1)
            held.passed = float(times[whole - 1])
            first = count - whole
            try:
                y[first:] = self._component.advance(times[complete], h, rows[complete])
            except Stopped as stop:
                completed = first + stop.steps
                y[first:completed] = stop.outputs
                raise Stopped(y[:completed], str(stop), failed=stop.failed) from stop
            held.y[:] = y[-1]
        held.hold(times[whole:], rows[whole:])
        return y

    def native(self) -> NativeStep | None:
        """Return the compiled step, if the component has one."""
        step = cast(Native, self._component).native()
        if step is None:
            return None
        source: list[int] = []
        for signal in self._component.interface.inputs:
            if signal.name in (SAMPLES, SAMPLE_TIMES):
                source += [-1] * signal.size
            else:
                shown = self._own[signal.name]
                source += range(shown.start, shown.stop)
        shown_samples = self._own[SAMPLES]
        columns = LateColumns(
            shown_samples=shown_samples.start,
            shown_times=self._own[SAMPLE_TIMES].start,
            samples=self._samples.start,
            times=self._times.start,
            values=shown_samples.stop - shown_samples.start,
            most=MOST_IN_A_STEP,
            source=source,
        )
        return late_samples_step(step, columns, self._held, steps=self._steps)

    def _place(self, times: Vector, rows: Matrix, u: Matrix) -> int | None:
        """Write samples into the rows that end their steps.

        Return the first row whose sample has no place; None: all have.
        """
        before = len(times) - len(u)
        instants = u[:, self._own[SAMPLE_TIMES].start]
        samples = u[:, self._own[SAMPLES]]
        for i in np.flatnonzero(np.isfinite(instants)):
            place = int(np.searchsorted(times, instants[i], side="left"))
            last = before + i - self._steps - 1  # row that was passed on before this sample came
            passed = times[last] if last >= 0 else self._held.passed
            is_in_time = passed < instants[i] <= times[before + i]
            if not is_in_time or not self._write(rows[place], instants[i], samples[i]):
                return int(i)
        return None

    def _write(self, row: Vector, instant: float, values: Vector) -> bool:
        """Write a sample into a row; return whether there is a place for it."""
        free = np.flatnonzero(np.isnan(row[self._times]))
        if not free.size:
            return False
        row[self._times.start + free[0]] = instant
        first_places = np.arange(len(values)) * MOST_IN_A_STEP
        places: NDArray[np.intp] = self._samples.start + first_places
        row[places + free[0]] = values
        return True

    def _without_samples(self, u: Matrix) -> Matrix:
        """Return rows of the component's inputs, with places for samples."""
        parts = []
        for signal in self._component.interface.inputs:
            if signal.name in (SAMPLES, SAMPLE_TIMES):
                parts.append(np.full((len(u), signal.size), NAN))
            else:
                parts.append(u[:, self._own[signal.name]])
        return np.hstack(parts)

    def save(self) -> LateState:
        """Copy the state."""
        held = self._held
        return LateState(self._component.save(), held.passed, *held.rows(), held.y.copy())

    def restore(self, state: LateState) -> None:
        """Go back to a saved state."""
        self._component.restore(state.component)
        self._held.passed = state.passed
        self._held.hold(state.t, state.u)
        self._held.y[:] = state.y


def _single_sample(signal: Signal) -> Signal:
    if signal.name in (SAMPLES, SAMPLE_TIMES):
        return replace(signal, size=signal.size // MOST_IN_A_STEP)
    return signal
