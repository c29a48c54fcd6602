"""Find out that a unit keeps an inner step of its own and ignores the communication step it is given.

Such a unit's outputs keep their bits over most communication steps and change at every n-th one only, n > 1. What looks alike is
told apart thus:

* at rest: nothing ever changes;
* it follows an input that itself changes at every n-th step only, directly or late: only spells count in which the inputs move in
  every step, or in none;
* rounding, creeping towards a rest: a change counts from ``RELATIVE`` of the value on;
* a switch between two values (a pulse): a change back to the value before the last one does not count.

``REPEATS`` spells in a row that equal the one before are needed, as chance gives a few; ``LIVELY`` changes in successive steps
show that there is nothing to find. A quantized output that moves steadily looks the same: what is found is a suspicion.
"""

from __future__ import annotations

from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector

REPEATS: Final = 8
LIVELY: Final = 20
RELATIVE: Final = 1e-9


class _Seen(NamedTuple):
    """What the last steps showed."""

    outputs: Vector | None = None
    inputs: Vector | None = None
    older: Vector | None = None  # the outputs before their last change
    steps: int = 0  # since the last change
    moves: int = 0  # how many of them had other inputs than the step before
    period: int = 0
    repeats: int = 0


@final
class InnerStep:
    """Watches the outputs of a unit.

    Parameters
    ----------
    columns : array of int
        Which elements of the outputs to watch.
    """

    def __init__(self, columns: NDArray[np.intp]) -> None:
        self._columns = columns
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self.seen: _Seen | None = (
            _Seen() if len(self._columns) else None
        )  # None: nothing to find, or found

    def see(self, outputs: Vector, inputs: Vector) -> int:
        """Look at a step: the outputs after it and the inputs it had. Gives n, once, where the outputs keep to every n-th step.

        The vectors must not be written to afterwards.
        """
        if self.seen is None:
            return 0
        outputs, (last, before, older, steps, moves, period, repeats) = (
            outputs[self._columns],
            self.seen,
        )
        if last is None or before is None:
            self.seen = _Seen(outputs, inputs)
            return 0
        steps, moves = steps + 1, moves + (inputs.tobytes() != before.tobytes())
        if outputs.tobytes() == last.tobytes():
            self.seen = _Seen(outputs, inputs, older, steps, moves, period, repeats)
            return 0
        repeats = (
            repeats + 1
            if steps == period and _counts(outputs, last, older) and moves in (0, steps)
            else 0
        )
        self.seen = _Seen(outputs, inputs, last, period=steps, repeats=repeats)
        if repeats < (LIVELY if steps == 1 else REPEATS):
            return 0
        self.seen = None
        return steps if steps > 1 else 0


def _counts(now: Vector, last: Vector, older: Vector | None) -> bool:
    with np.errstate(all="ignore"):  # what is not finite stops the run elsewhere
        moved = np.abs(now - last) > RELATIVE * np.maximum(np.abs(now), np.abs(last))
    return bool(moved.any()) and (older is None or now.tobytes() != older.tobytes())
