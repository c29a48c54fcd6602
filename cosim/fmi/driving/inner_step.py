"""Detect an inner step: that an FMU ignores the communication step and keeps one of its own.

The outputs of such an FMU keep their bits over most communication steps and change at every n-th
one only, n > 1. What looks alike is distinguished:

* at rest: nothing ever changes;
* it follows an input that itself changes at every n-th step only, directly or with a delay: only
  intervals count in which the inputs change in every step, or in none;
* rounding, slow decay towards a rest: a change counts from ``RELATIVE`` of the value on;
* a switch between two values (a pulse): a change back to the value before the last one does not
  count.

``REPEATS`` intervals in a row that equal the one before are needed, as chance gives a few;
``CHANGES_IN_A_ROW`` changes in successive steps show that there is no inner step. A quantized
output that changes steadily looks the same: what is detected is an indication, no proof.
"""

from __future__ import annotations

from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector

REPEATS: Final = 8
CHANGES_IN_A_ROW: Final = 20
RELATIVE: Final = 1e-9


class StepHistory(NamedTuple):
    """What the last steps showed."""

    outputs: Vector | None = None
    inputs: Vector | None = None
    outputs_before: Vector | None = None  # their last change
    steps: int = 0  # since the last change
    input_changes: int = 0  # how many of them had other inputs than the step before
    period: int = 0  # steps between the last two changes
    repeats: int = 0  # how often in a row that period came again


@final
class InnerStep:
    """Watches the outputs of an FMU.

    Parameters
    ----------
    columns : array of int
        Which elements of the outputs to watch.

    Attributes
    ----------
    history : StepHistory or None
        None: nothing to watch, or it is decided.
    """

    def __init__(self, columns: NDArray[np.intp]) -> None:
        self._columns = columns
        self.reset()

    def reset(self) -> None:
        """Forget the history."""
        self.history: StepHistory | None = StepHistory() if len(self._columns) else None

    def observe(self, outputs: Vector, inputs: Vector) -> int:
        """Return n, once, where the outputs change at every n-th step only; else 0.

        Parameters
        ----------
        outputs : Vector, shape (n_y,)
            After a step; must not be written to afterwards.
        inputs : Vector, shape (n_u,)
            Of that step; must not be written to afterwards.
        """
        past = self.history
        if past is None:
            return 0
        watched = outputs[self._columns]
        if past.outputs is None or past.inputs is None:
            self.history = StepHistory(watched, inputs)
            return 0
        steps = past.steps + 1
        input_changes = past.input_changes + (inputs.tobytes() != past.inputs.tobytes())
        if watched.tobytes() == past.outputs.tobytes():
            self.history = past._replace(inputs=inputs, steps=steps, input_changes=input_changes)
            return 0
        repeats = 0
        if steps == past.period and input_changes in (0, steps):
            significant = _is_significant(watched, past.outputs, past.outputs_before)
            repeats = past.repeats + significant
        self.history = StepHistory(
            watched, inputs, outputs_before=past.outputs, period=steps, repeats=repeats
        )
        if repeats < (CHANGES_IN_A_ROW if steps == 1 else REPEATS):
            return 0
        self.history = None
        return steps if steps > 1 else 0


def _is_significant(outputs: Vector, last: Vector, before_last: Vector | None) -> bool:
    """Return whether a change is more than rounding, and no switch back."""
    with np.errstate(all="ignore"):  # what is not finite stops the run elsewhere
        scale = np.maximum(np.abs(outputs), np.abs(last))
        changed = np.abs(outputs - last) > RELATIVE * scale
    switched_back = before_last is not None and outputs.tobytes() == before_last.tobytes()
    return bool(changed.any()) and not switched_back
