"""The identifier: least squares on the regression and the parameters theta (33)-(35)."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped, check_design
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.step import NO_VALUE, LeastSquares, LeastSquaresConstants
from cosim.theory.estimators.least_squares import Recovery, recovery_constants


class LeastSquaresIdentifier:
    """Least squares in information form: input regressor (mu), outputs theta and eta.

    The outputs have no value (NaN) until the data determine them.

    Parameters
    ----------
    recovery : Recovery
        How theta follows from eta.
    start_time : float
        First instant that counts, the identification start time T_id (36) [s].
    P0 : float, optional
        `P(0) = P0 I` (34), with eta(0) = 0; by default no prior.

    Raises
    ------
    UsageError
        If P0 is not positive and finite.
    Stopped
        From ``advance``, where the regressor has no value.
    """

    def __init__(self, recovery: Recovery, *, start_time: float, P0: float | None = None) -> None:
        if P0 is not None and not 0.0 < P0 < np.inf:
            raise UsageError(
                f"P0: found {P0}, needed a positive finite number; leave it out for no prior"
            )
        self.recovery = recovery
        self.start_time = start_time
        self.P0 = P0
        regressor = Signal("regressor", recovery.n_eta + 1, optional=True, role="input")
        theta = Signal("theta", recovery.n_theta, optional=True, role="estimate")
        eta = Signal("eta", recovery.n_eta, optional=True, role="estimate")
        self.interface = Interface((regressor,), (theta, eta), prepares=True, rollback=True)

    def constants(self, start_time: float, *, held: bool) -> LeastSquaresConstants:
        """Return the numbers of the kernel that counts from ``start_time`` [s].

        ``held``: the rows have a zero-order hold.
        """
        recovery = self.recovery
        formulas = recovery_constants(recovery)
        information = 0.0 if self.P0 is None else 1.0 / self.P0
        return LeastSquaresConstants(recovery.n_eta, start_time, information, formulas, held)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Return the start time: it depends on eigenvalues, so it is recorded."""
        design = dict(recorded) or {"start": np.array([self.start_time])}
        check_design(design, {"start": (1,)})
        (start_time,) = design["start"]
        self._counts_from = float(start_time)
        zero_order = bool(held.any())
        constants = self.constants(self._counts_from, held=zero_order)
        self._kernel = LeastSquares(constants)
        return design

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget all data; there is no estimate yet."""
        self._last = self._kernel.initialize()
        return self._last.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the last estimate; the row at this instant does not change it."""
        return self._last.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Accumulate K rows.

        Raises
        ------
        Stopped
            If the regressor has no value at the start time.
        """
        step = self._kernel.step
        y = step.advance(t, h, u)
        if len(y):
            self._last = y[-1].copy()
        if step.status == NO_VALUE:
            raise Stopped(
                y,
                f"the regressor has no value at the start time {self._counts_from} s; "
                "start after the longest delay",
            )
        return y

    def save(self) -> tuple[Vector, Vector]:
        """Copy the information and the estimate."""
        return self._kernel.step.save(), self._last.copy()

    def restore(self, state: tuple[Vector, Vector]) -> None:
        """Return to saved information."""
        memory, last = state
        self._kernel.step.restore(memory)
        self._last = last.copy()
