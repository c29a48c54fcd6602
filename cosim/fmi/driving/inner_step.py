"""Detect an inner step: that an FMU ignores the communication step and keeps one of its own.

The outputs of such an FMU keep their bits over most communication steps and change at every n-th
one only, n > 1; where n is no whole number, at the first ones at or behind its multiples, as after
3, 2, 3, 2 steps for n = 2.5. What looks alike is distinguished:

* at rest: nothing ever changes;
* it follows an input that itself changes at every n-th step only, directly or with a delay: only
  intervals count in which the inputs change in every step, or in none. Those from a loop of its own
  without any discrete output need not: what moves nobody but each other has no such reason, so one
  component of the loop keeps an inner step at least;
* rounding, slow decay towards a rest: a change counts from ``RELATIVE`` of the value on;
* a switch between two values (a pulse): a change back to the value before the last one does not
  count.

* a quantized ramp, where n is no whole number: changes that are all the same do not count.

``REPEATS`` intervals in a row that equal the one before are needed, as chance gives a few, or
``UNEVEN`` in a row that one n explains (of random ones of n and n + 1 less than one in a million);
``CHANGES_IN_A_ROW`` changes in successive steps show that there is no inner step. A quantized
output that changes steadily looks the same: what is detected is an indication, no proof.
``inner_step.c`` does it, as steps in compiled code are watched too.
"""

from __future__ import annotations

import math
from ctypes import addressof
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.native.fmi.co_simulation import InnerStepStruct
from cosim.native.library import library
from cosim.native.memory import place, place_struct


class StepHistory(NamedTuple):
    """What the last steps showed."""

    outputs: Vector | None = None
    inputs: Vector | None = None
    outputs_before: Vector | None = None  # their last change
    steps: int = 0  # since the last change
    input_changes: int = 0  # how many of them had other inputs than the step before
    outside_changes: int = 0  # and how many had others that are not from its own loop
    period: int = 0  # steps between the last two changes
    repeats: int = 0  # how often in a row that period came again
    ends: tuple[int, ...] = (0,)  # of the intervals in a row that one n explains [steps]
    least: float = 0.0  # what n is above by these
    most: float = math.inf  # and below
    is_shared: bool = False  # inputs from the loop changed with the outputs then


@final
class InnerStep:
    """Watches the outputs of an FMU.

    Parameters
    ----------
    columns : array of int
        Which elements of the outputs to watch.
    n_u : int
        Number of input elements.

    Attributes
    ----------
    columns : array of int
    in_loop : Mask, shape (n_u,)
        The inputs that are driven from a loop of its own without any discrete output; to be filled.
    """

    def __init__(self, columns: NDArray[np.intp], n_u: int) -> None:
        self.columns = columns
        self._outputs = np.zeros(len(columns))
        self._inputs = np.zeros(n_u)
        self._outputs_before = np.zeros(len(columns))
        self.in_loop = place(np.zeros(n_u, np.bool_))
        self._struct = place_struct(InnerStepStruct)
        self._struct.columns = columns.ctypes.data
        self._struct.n = len(columns)
        self._struct.n_u = n_u
        self._struct.in_loop = self.in_loop.ctypes.data
        self._struct.outputs = self._outputs.ctypes.data
        self._struct.inputs = self._inputs.ctypes.data
        self._struct.outputs_before = self._outputs_before.ctypes.data
        self.address = addressof(self._struct)
        self.reset()

    def reset(self) -> None:
        """Forget the history."""
        self.history = StepHistory() if len(self.columns) else None

    @property
    def history(self) -> StepHistory | None:
        """What the last steps showed, as a copy; None: nothing to watch, or it is decided."""
        struct = self._struct
        if not struct.watches:
            return None
        return StepHistory(
            self._outputs.copy() if struct.begun else None,
            self._inputs.copy() if struct.begun else None,
            self._outputs_before.copy() if struct.changed else None,
            struct.steps,
            struct.input_changes,
            struct.outside_changes,
            struct.period,
            struct.repeats,
            tuple(struct.ends[: struct.uneven + 1]),
            struct.least,
            struct.most,
            bool(struct.is_shared),
        )

    @history.setter
    def history(self, history: StepHistory | None) -> None:
        struct = self._struct
        struct.watches = history is not None
        if history is None:
            return
        struct.begun = _restore(self._outputs, history.outputs)
        _restore(self._inputs, history.inputs)
        struct.changed = _restore(self._outputs_before, history.outputs_before)
        struct.steps = history.steps
        struct.input_changes = history.input_changes
        struct.outside_changes = history.outside_changes
        struct.period = history.period
        struct.repeats = history.repeats
        struct.uneven = len(history.ends) - 1
        struct.ends[: len(history.ends)] = history.ends
        struct.least = history.least
        struct.most = history.most
        struct.is_shared = history.is_shared

    @property
    def is_shared(self) -> bool:
        """Whether what was detected may be of another component of its loop."""
        return bool(self._struct.is_shared)

    def observe(self, outputs: Vector, inputs: Vector) -> float:
        """Return n, once, where the outputs change at every n-th step on average; else 0.

        Parameters
        ----------
        outputs : Vector, shape (n_y,)
            After a step.
        inputs : Vector, shape (n_u,)
            Of that step.
        """
        vectors = (outputs.ctypes.data, inputs.ctypes.data)
        period: float = library.cosim_inner_step_observe(self.address, *vectors)
        return period


def _restore(memory: Vector, saved: Vector | None) -> bool:
    """Copy what was saved into the memory; return whether there is any."""
    if saved is None:
        return False
    memory[:] = saved
    return True
