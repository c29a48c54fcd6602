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

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.numerics.linear import first_order_hold
from cosim.theory.disturbed_plant import DisturbedPlant, NoiseModel


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


def first_spread(states: int, size: float) -> Vector:
    """Return the deviations at first of x, delta and its derivative, shape (n + 2,)."""
    return np.full(states + 2, size)
