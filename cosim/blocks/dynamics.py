"""Small dynamic parts: first-order lag, delay."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.step import delay_step


def lag(
    *, time_constant: float, start: float | None = None, size: int = 1, unit: str | None = None
) -> LinearModel:
    """First-order lag ``T y' = u - y`` as a model; ``start`` left out: y(0) = u(0), without a transient.

    Raises
    ------
    UsageError
        If the time constant [s] is not positive.
    """
    if not time_constant > 0.0:
        raise UsageError(f"lag: found time_constant = {time_constant} s, needed a positive time")
    eye, rate = np.eye(size), 1.0 / time_constant
    follow = eye if start is None else np.zeros((size, size))
    initial = {"y": ("u",)} if start is None else {}
    signals = Interface(
        (Signal("u", size, unit),), (Signal("y", size, unit, role="state"),), initial=initial
    )
    states = tuple(signals.outputs[0].elements)
    X0 = np.full(size, 0.0 if start is None else start)
    return LinearModel(
        signals, states, -rate * eye, rate * eye, eye, np.zeros((size, size)), X0, follow
    )


LARGEST = 2**27  # values in a delay line, 1 GiB


class Delay:
    """``y(t) = u(t - n h)``; before that ``initial``.

    Parameters
    ----------
    steps : int
        Number of communication steps n.
    initial : float or None
        y until the first sample arrives; None: u(0).
    """

    def __init__(
        self, steps: int, *, initial: float | None = None, size: int = 1, unit: str | None = None
    ) -> None:
        if steps < 1:
            raise UsageError(f"delay: found {steps} communication steps, needed at least 1")
        if steps * size > LARGEST:
            raise UsageError(
                f"delay: {steps} communication steps of {size} values do not fit; at most {LARGEST} values"
            )
        self.initial = initial
        follows = {"y": ("u",)} if initial is None else {}
        self.interface = Interface(
            (Signal("u", size, unit),),
            (Signal("y", size, unit, "inherited"),),
            initial=follows,
            rollback=True,
        )
        self._size = size
        self._step = delay_step(steps, size)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Fill the line."""
        self._step.memory[0] = 0.0
        self._ring[:] = u if self.initial is None else self.initial
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the oldest sample; ``u`` does not matter."""
        y: Vector = self._ring[int(self._step.memory[0])].copy()
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Shift K samples through the line."""
        return self._step.advance(t, h, u)

    def save(self) -> Vector:
        """Copy the line."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved line."""
        self._step.restore(state)

    @property
    def _ring(self) -> Matrix:
        return self._step.memory[1:].reshape(-1, self._size)
