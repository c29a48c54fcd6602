"""The identifier: least squares on the regression and the parameters theta (33)-(35)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.blocks.estimator import Estimator, estimate, optional_input
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import UsageError
from cosim.native.estimation.regression import LeastSquares, LeastSquaresConstants
from cosim.theory.estimators.least_squares import Recovery, recovery_constants


class LeastSquaresIdentifier(Estimator[Vector]):
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
        method = LeastSquaresMethod(recovery=recovery, start_time=start_time, P0=P0)
        super().__init__(
            method,
            no_value=f"the regressor has no value at the start time {start_time} s; "
            "start after the longest delay",
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class LeastSquaresMethod:
    """The method of :class:`LeastSquaresIdentifier`, which describes it."""

    recovery: Recovery
    start_time: float
    P0: float | None

    def __post_init__(self) -> None:
        if self.P0 is not None and not 0.0 < self.P0 < np.inf:
            raise UsageError(
                f"P0: expected a finite number > 0, got {self.P0}; omit it for no prior"
            )

    @property
    def interface(self) -> Interface:
        """Input regressor, outputs theta and eta."""
        return regression_interface(self.recovery)

    def design(self, h: float, held: Mask) -> Design:
        """Return the start time: it depends on eigenvalues, so it is recorded."""
        return {"start": np.array([self.start_time])}

    def kernel(self, h: float, held: Mask, design: Design) -> LeastSquaresKernel:
        """Return the kernel without samples."""
        return LeastSquaresKernel(self.constants(held, design))

    def constants(self, held: Mask, design: Design) -> LeastSquaresConstants:
        """Return the numbers of its kernel."""
        recovery = self.recovery
        (start,) = design["start"]
        return LeastSquaresConstants(
            unknowns=recovery.n_eta,
            start_time=float(start),
            information=0.0 if self.P0 is None else 1.0 / self.P0,
            recovery=recovery_constants(recovery),
            held=bool(held.any()),
        )


class LeastSquaresKernel:
    """Least squares bound to its memory, which can go back."""

    def __init__(self, constants: LeastSquaresConstants) -> None:
        kernel = LeastSquares(constants)
        self.step = kernel.step
        self.initialize = kernel.initialize
        self.save = kernel.step.save
        self.restore = kernel.step.restore


def regression_interface(recovery: Recovery) -> Interface:
    """Return the interface of a method on the regression: from mu to theta and eta."""
    regressor = optional_input("regressor", recovery.n_eta + 1)
    theta = estimate("theta", recovery.n_theta)
    eta = estimate("eta", recovery.n_eta)
    return Interface(
        (regressor,), (theta, eta), prepares=True, rollback=True, native=True, continuous=True
    )
