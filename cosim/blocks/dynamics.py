"""Small dynamic parts: first-order lag, integrator, delay."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.linear import LinearModel
from cosim.core.linearization import Linearized, static
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.numerics.linear import delay_step
from cosim.native.step import LARGEST_MEMORY, NativeStep

AUGMENTED = 6  # the discretization of n states works on 4 matrices of 3 n rows: (6 n)^2 values


def lag(
    *, time_constant: float, initial: float | None = None, size: int = 1, unit: str | None = None
) -> LinearModel:
    """Build a first-order lag ``T y' = u - y``.

    Parameters
    ----------
    time_constant : float
        T [s].
    initial : float, optional
        y(0); by default u(0), without a transient.
    size : int
        Number of elements of u and y.
    unit : str, optional
        The unit of u and y.

    Raises
    ------
    UsageError
        If the time constant is not positive, or the size makes matrices that are too large.
    """
    if (AUGMENTED * size) ** 2 > LARGEST_MEMORY:
        most = math.isqrt(LARGEST_MEMORY) // AUGMENTED
        raise UsageError(f"lag: size: expected at most {most}, got {size}")
    if not time_constant > 0.0:
        raise UsageError(f"lag: time_constant: expected a time > 0, got {time_constant} s")
    rate = 1.0 / time_constant
    u = Signal("u", size, unit)
    y = Signal("y", size, unit, role="state")
    states = tuple(y.elements)
    C = np.eye(size)
    D = np.zeros((size, size))
    A = -rate * C
    B = rate * C
    if initial is None:
        interface = Interface((u,), (y,), initial={"y": ("u",)})
        X0 = np.zeros(size)
        Xu = np.eye(size)
    else:
        interface = Interface((u,), (y,))
        X0 = np.full(size, initial)
        Xu = np.zeros((size, size))
    return LinearModel(interface, states, A, B, C, D, X0, Xu)


def integrator(*, initial: float = 0.0, size: int = 1, unit: str | None = None) -> LinearModel:
    """Build ``y' = u`` from ``y(0) = initial``; ``unit`` is that of y."""
    u = Signal("u", size)
    y = Signal("y", size, unit, role="state")
    states = tuple(y.elements)
    zero = np.zeros((size, size))
    identity = np.eye(size)
    X0 = np.full(size, initial)
    interface = Interface((u,), (y,))
    return LinearModel(interface, states, zero, identity, identity, zero, X0, zero)


class Delay:
    """``y(t) = u(t - n h)``; before that ``initial``.

    Parameters
    ----------
    steps : int
        Number of communication steps n.
    initial : float, optional
        y until the first sample arrives; by default u(0).
    size : int
        Number of elements of u and y.
    unit : str, optional
        The unit of u and y.

    Raises
    ------
    UsageError
        If there is no step, or the line is too long.
    """

    def __init__(
        self, steps: int, *, initial: float | None = None, size: int = 1, unit: str | None = None
    ) -> None:
        if steps < 1:
            raise UsageError(f"delay: expected at least 1 communication step, got {steps}")
        if steps * size > LARGEST_MEMORY:
            raise UsageError(
                f"delay: {steps} communication steps of {size} values are too many; expected at "
                f"most {LARGEST_MEMORY} values"
            )
        self.initial = initial
        u = Signal("u", size, unit)
        y = Signal("y", size, unit, "inherited")
        initial_feedthrough = {"y": ("u",)} if initial is None else {}
        self.interface = Interface(
            (u,),
            (y,),
            initial=initial_feedthrough,
            delayed=("u",),
            rollback=True,
            native=True,
            linearizable=True,
        )
        self._size = size
        self._steps = steps
        self._step = delay_step(steps, size)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Fill the line."""
        self._step.memory[0] = 0.0
        self._ring[:] = u if self.initial is None else self.initial
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the oldest sample; ``u`` does not matter."""
        due = int(self._step.memory[0])
        y: Vector = self._ring[due].copy()
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Shift K samples through the line."""
        return self._step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return the delay."""
        return replace(static(np.eye(self._size)), delay=self._steps)

    def save(self) -> Vector:
        """Copy the line."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved line."""
        self._step.restore(state)

    @property
    def _ring(self) -> Matrix:
        return self._step.memory[1:].reshape(-1, self._size)
