"""The gradient on the linear regression (26), normalized: a baseline.

    eta' = gain m (p - m'eta) / m'm,   eta(0) = 0,

as in S. Sastry and M. Bodson, Adaptive Control, 1989, section 2.2. The normalization makes it
independent of the unit of delta, and stable for every gain: eta goes towards the plane of the
present row at the rate ``gain``. It converges at the rate of the weakest direction of the
regressor, which is 3e4 times slower than the strongest in the paper's example.
"""

from __future__ import annotations

from cosim.arrays import Matrix, Vector
from cosim.theory.estimators.adaptive import AdaptiveEstimate, adapt
from cosim.theory.estimators.defaults import GRADIENT_GAIN
from cosim.theory.estimators.least_squares import Recovery


def gradient(
    t: Vector, mu: Matrix, recovery: Recovery, *, gain: float = GRADIENT_GAIN
) -> AdaptiveEstimate:
    """Follow the gradient over rows of the regression, straight lines between them.

    Parameters
    ----------
    t : Vector, shape (N,)
        Equally spaced instants [s].
    mu : Matrix, shape (N, q + 1)
        Rows of (25).
    recovery : Recovery
        How theta follows from eta.
    gain : float
        [1/s]
    """
    return adapt("gradient", recovery, t, mu, gain=gain)
