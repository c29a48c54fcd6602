"""Integrator with limits, where integration stops."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.blocks.control import LARGEST_NUMBER, integrator_step
from cosim.native.step import NativeStep


class LimitedIntegrator:
    """``y' = u`` with ``lower <= y <= upper``: at a limit y stays, as long as u points outwards.

    It leaves the limit as soon as u changes its sign (no windup), also inside a communication step:
    the steps are exact for inputs that are interpolated linearly or held.

    Parameters
    ----------
    lower, upper : float
    initial : float
        y(0).
    size : int
        Number of elements of u and y.
    unit : str, optional
        The unit of y.

    Raises
    ------
    UsageError
        If lower is not below upper, or the initial value not within them.
    """

    def __init__(
        self,
        *,
        lower: float = -LARGEST_NUMBER,
        upper: float = LARGEST_NUMBER,
        initial: float = 0.0,
        size: int = 1,
        unit: str | None = None,
    ) -> None:
        if not lower < upper:
            raise UsageError(
                f"integrator: expected lower < upper, got lower = {lower} and upper = {upper}"
            )
        if not lower <= initial <= upper:
            raise UsageError(
                f"integrator: initial: expected a value from lower = {lower} to upper = {upper}, "
                f"got {initial}"
            )
        self.lower = lower
        self.upper = upper
        self.initial = initial
        u = Signal("u", size)
        y = Signal("y", size, unit, role="state")
        self.interface = Interface(
            (u,),
            (y,),
            prepares=True,
            rollback=True,
            native=True,
            linearizable=True,
            substeps=True,
            continuous=True,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Take which inputs are held; there is nothing to record."""
        self._step = integrator_step(self.lower, self.upper, held)
        return recorded

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Return what is recorded: nothing depends on the length of a step."""
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set y to its initial value."""
        self._step.memory[:] = self.initial
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y; ``u`` does not matter."""
        return self._step.memory.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Integrate over K steps."""
        return self._step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return the integrator; at a limit that u points out of, nothing integrates."""
        y = self._step.memory
        stays_above = (y >= self.upper) & (u > 0.0)
        stays_below = (y <= self.lower) & (u < 0.0)
        n = len(y)
        B = np.diag(np.where(stays_above | stays_below, 0.0, 1.0))
        return Linearized(np.zeros((n, n)), B, np.eye(n), np.zeros((n, n)))

    def save(self) -> Vector:
        """Copy the state."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._step.restore(state)
