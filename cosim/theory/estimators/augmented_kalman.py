"""A Kalman filter of x, delta and its derivative, smoothing, and projection on it: a baseline.

The filter knows nothing of the class of delta: its second derivative is white noise,

    x' = A x + B u + Bd delta,   delta'' = w,   y = C x + D u + Dd delta + v,

so delta is reconstructed from y with the lag and the attenuation that ``intensity``, the spectral
density of w, buys for the noise v. The noise of a step enters delta and its derivative at the end
of the step. Fixed-interval smoothing (H. Rauch, F. Tung and C. Striebel, AIAA Journal 3, 1965; here
in the form of Bryson and Frazier, which inverts no covariance) removes the lag: it needs the
samples that come after. theta is then estimated by variable projection on the smoothed delta,
started by the Rayleigh quotient of its regression (25).

**Online and after the run.** The filter takes every sample once. Smoother and projection go over
all samples again, whenever there are a tenth more of them and at the end of the run: theta at an
instant rests on samples before it alone, but it is an old estimate, of up to a tenth of the time
ago. Only the last estimate rests on the whole record.

Delta has transients: an invariant zero of the plant is a mode of delta that y does not see, and
what is assumed of x(0) decides it. They are those of the observer, and the projection eliminates
them with the amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.estimation.kalman import AugmentedKalmanConstants, AugmentedKalmanStep
from cosim.native.numerics.linear import first_order_hold
from cosim.theory.disturbances.families import Family
from cosim.theory.disturbed_plant import DisturbedPlant, NoiseModel, white_noise
from cosim.theory.estimators.defaults import (
    AUGMENTED_DEVIATION,
    AUGMENTED_INTENSITY,
    KALMAN_SIZE,
)
from cosim.theory.estimators.output_error import OutputErrorFit
from cosim.theory.estimators.projection import project
from cosim.theory.sampling import equal_step


def augmented_model(
    plant: DisturbedPlant, h: float, *, noise: NoiseModel, intensity: float, held: Mask
) -> dict[str, Matrix]:
    """Discretize the plant with delta and its derivative as states.

    Parameters
    ----------
    plant : DisturbedPlant
        All components of its disturbance enter alike.
    h : float
        Step [s].
    noise : NoiseModel
        Of y.
    intensity : float
        Spectral density of the second derivative of delta.
    held : Mask, shape (n_u,)
        Inputs with a zero-order hold.

    Returns
    -------
    dict of Matrix
        ``Phi (n + 2, n + 2)``, ``B0``, ``B1 (n + 2, n_u)``, ``C (n_y, n + 2)`` and ``D (n_y, n_u)``
        of the outputs made white by ``W (n_y, n_y)``, and ``noise (2, n + 2)``.
    """
    n, n_u = plant.B.shape
    A = np.zeros((n + 2, n + 2))
    A[:n, :n] = plant.A
    A[:n, n] = plant.Bd[:, 0]
    A[n, n + 1] = 1.0
    B = np.zeros((n + 2, n_u))
    B[:n] = plant.B
    discrete = first_order_hold(A, B, h, held)
    W = noise.whitening
    rows = np.zeros((2, n + 2))
    # [h^3 / 3, h^2 / 2; h^2 / 2, h] as a product
    root = np.sqrt(intensity * h)
    rows[0, n] = root * (h / np.sqrt(3.0))
    rows[0, n + 1] = root * (np.sqrt(3.0) / 2.0)
    rows[1, n + 1] = root / 2.0
    of_delta = plant.Dd[:, :1]
    of_derivative = np.zeros((len(plant.C), 1))
    C = np.hstack([plant.C, of_delta, of_derivative])
    return {
        "Phi": discrete.Ad,
        "B0": discrete.B0,
        "B1": discrete.B1,
        "C": W @ C,
        "D": W @ plant.D,
        "W": W,
        "noise": rows,
    }


def smoothed_disturbance(
    t: Vector,
    y: Matrix,
    u: Matrix,
    plant: DisturbedPlant,
    *,
    deviation: float = AUGMENTED_DEVIATION,
    size: float = KALMAN_SIZE,
    intensity: float = AUGMENTED_INTENSITY,
) -> Vector:
    """Reconstruct delta from all samples of y and u, shape (N,).

    Where the plant has an invariant zero in the left half plane, delta has its mode as a transient.

    Parameters
    ----------
    t : Vector, shape (N,)
        Equally spaced instants [s].
    y : Matrix, shape (N, n_y)
    u : Matrix, shape (N, n_u)
    plant : DisturbedPlant
    deviation : float
        Of the noise of y.
    size : float
        Deviation of x, delta and its derivative at first.
    intensity : float
        Spectral density of the second derivative of delta.
    """
    h = equal_step(t)
    n_y, n = plant.C.shape
    free = np.zeros(u.shape[1], np.bool_)
    model = augmented_model(plant, h, noise=white_noise(n_y), intensity=intensity, held=free)
    constants = AugmentedKalmanConstants(
        **model,
        first_spread=first_spread(n, size),
        deviation=deviation,
        capacity=len(t),
        projection=None,
    )
    kernel = AugmentedKalmanStep(constants)
    kernel.initialize()
    ends = np.append(t, t[-1] + h)  # a step takes the sample at its beginning
    rows = np.hstack([y, u])
    kernel.step.advance(ends, h, np.vstack([rows, rows[-1]]))
    return kernel.smooth(len(t))


def augmented_kalman(
    t: Vector,
    y: Matrix,
    u: Matrix,
    alpha: Matrix,
    plant: DisturbedPlant,
    families: Sequence[Family],
    theta: Vector,
    *,
    A: Matrix | None = None,
    c: Vector | None = None,
    deviation: float = AUGMENTED_DEVIATION,
    size: float = KALMAN_SIZE,
    intensity: float = AUGMENTED_INTENSITY,
) -> OutputErrorFit:
    """Estimate theta by variable projection on the smoothed delta, from a start.

    Parameters
    ----------
    t, y, u, plant, deviation, size, intensity
        As of :func:`smoothed_disturbance`.
    alpha : Matrix, shape (N, components)
        The known factors.
    families : sequence of Family
    theta : Vector, shape (P,)
        Start.
    A, c : optional
        Modes that delta has as transients, as for :func:`project`.
    """
    delta = smoothed_disturbance(
        t, y, u, plant, deviation=deviation, size=size, intensity=intensity
    )
    return project(t, delta, alpha, families, theta, A=A, c=c)


def first_spread(states: int, size: float) -> Vector:
    """Return the deviations at first of x, delta and its derivative, shape (n + 2,)."""
    return np.full(states + 2, size)
