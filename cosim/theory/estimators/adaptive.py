"""What the adaptive laws share: their constants, and a pass over all rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.adaptive import AdaptiveConstants, AdaptiveLaw, AdaptiveStep
from cosim.theory.estimators.least_squares import Recovery, recovery_constants
from cosim.theory.sampling import equal_step


@dataclass(frozen=True, eq=False)
class AdaptiveEstimate:
    """The path of an adaptive law: its estimates after every row but the first.

    Parameters
    ----------
    theta : Matrix, shape (N - 1, P)
        NaN: no value.
    eta : Matrix, shape (N - 1, q)
    """

    theta: Matrix
    eta: Matrix


def adaptive_constants(
    recovery: Recovery, *, start_time: float, gain: float, forgetting: float, held: bool
) -> AdaptiveConstants:
    """Return the numbers of the kernel; they are described there."""
    return AdaptiveConstants(
        unknowns=recovery.n_eta,
        recovery=recovery_constants(recovery),
        start_time=start_time,
        gain=gain,
        forgetting=forgetting,
        held=held,
    )


def adapt(
    law: AdaptiveLaw,
    recovery: Recovery,
    t: Vector,
    mu: Matrix,
    *,
    gain: float,
    forgetting: float = np.inf,
) -> AdaptiveEstimate:
    """Pass over rows of the regression (25), straight lines between them.

    Parameters
    ----------
    law : AdaptiveLaw
    recovery : Recovery
        How theta follows from eta.
    t : Vector, shape (N,)
        Equally spaced instants [s].
    mu : Matrix, shape (N, q + 1)
    gain, forgetting
        As of :func:`adaptive_constants`.
    """
    constants = adaptive_constants(
        recovery, start_time=float(t[0]), gain=gain, forgetting=forgetting, held=False
    )
    kernel = AdaptiveStep(law, constants)
    kernel.initialize()
    step = equal_step(t)
    y = kernel.step.advance(np.ascontiguousarray(t), step, mu)
    n_theta = recovery.n_theta
    return AdaptiveEstimate(y[:, :n_theta], y[:, n_theta:])
