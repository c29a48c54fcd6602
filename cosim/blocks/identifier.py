"""The identifier: least squares on the regression and the parameters theta (33)-(35)."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.step import NO_VALUE, LeastSquares, LeastSquaresConstants, RecoveryConstants
from cosim.theory.estimators import Recovery


class LeastSquaresIdentifier:
    """Least squares in information form: input regressor (mu), outputs theta and eta, without a value before there is one.

    Parameters
    ----------
    recovery : Recovery
        How theta follows from eta.
    start : float
        First instant that counts, T_id (36) [s].
    P0 : float or None
        `P(0) = P0 I` (34), with eta(0) = 0; None: no prior.
    """

    def __init__(self, recovery: Recovery, *, start: float, P0: float | None = None) -> None:
        if P0 is not None and not 0.0 < P0 < np.inf:
            raise UsageError(
                f"P0: found {P0}, needed a positive finite number; leave it out for no prior"
            )
        self.recovery, self.start, self.P0 = recovery, start, P0
        self.interface = Interface(
            (Signal("regressor", recovery.n_eta + 1, optional=True, role="input"),),
            (
                Signal("theta", recovery.n_theta, optional=True, role="estimate"),
                Signal("eta", recovery.n_eta, optional=True, role="estimate"),
            ),
            prepares=True,
            rollback=True,
        )

    def constants(self, start: float, *, held: bool) -> LeastSquaresConstants:
        """Give the numbers of the kernel that counts from ``start`` [s]; ``held``: the rows hold over a step."""
        return LeastSquaresConstants(
            unknowns=self.recovery.n_eta,
            start_time=start,
            information=0.0 if self.P0 is None else 1.0 / self.P0,
            recovery=[
                RecoveryConstants(
                    int(block.kind), block.terms, block.theta, block.signs, block.spacing
                )
                for block in self.recovery.groups
            ],
            held=held,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Give the start time: it rests on eigenvalues, so it is recorded."""
        design = dict(recorded) or {"start": np.array([self.start])}
        self._counts_from = float(design["start"][0])
        self._kernel = LeastSquares(self.constants(self._counts_from, held=bool(held.any())))
        return design

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget all data; there is no estimate yet."""
        self._last = self._kernel.initialize()
        return self._last.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the last estimate; the rows at this instant do not move it."""
        return self._last.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K rows."""
        y = self._kernel.step.advance(t, h, u)
        if len(y):
            self._last = y[-1].copy()
        if self._kernel.step.status == NO_VALUE:
            raise Stopped(
                y,
                f"the regressor has no value at the start time {self._counts_from} s; start after the longest delay",
            )
        return y

    def save(self) -> tuple[Vector, Vector]:
        """Copy the information and the estimate."""
        return self._kernel.step.save(), self._last.copy()

    def restore(self, state: tuple[Vector, Vector]) -> None:
        """Go back to saved information."""
        memory, last = state
        self._kernel.step.restore(memory)
        self._last = last.copy()
