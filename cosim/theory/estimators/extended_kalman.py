"""A joint extended Kalman filter of x, the basis beta(t), and theta: a baseline.

    x' = A x + B u + sum_i Bd_i alpha_i c_i'beta_i,   beta_i' = G_i(theta) beta_i,   theta' = 0,

linear in x and beta, bilinear in theta and beta. Over a step the transition is exact at the present
theta, with straight lines for u and the disturbance; its derivative is that of the exact
transition. There is no noise but that of y, so that where the linearization is right the filter is
the recursive least squares of theta. Where it is not, in the first seconds, the covariance shrinks
about a wrong theta, and what was learned there is never taken back: that is the price of one pass
(A. Jazwinski, Stochastic Processes and Filtering Theory, 1970, chapter 8; L. Ljung, IEEE Trans.
Automatic Control 24, 1979).

theta has no value before its standard error is half of what it was at first, nor while noise alone
explains its component.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Vector
from cosim.theory.disturbances.families import SearchBox


def first_theta(box: SearchBox) -> Vector:
    """Return the theta to begin with: the slowest of the box but for its outer tenth."""
    step = box.step
    start: Vector = np.clip(0.0, box.lower + step, box.upper - step)
    return start
