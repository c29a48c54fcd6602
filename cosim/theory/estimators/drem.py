"""Dynamic regressor extension and mixing with Kreisselmeier's extension: a baseline.

The extension filters the regression (26) times its regressor,

    Omega' = -Omega / forgetting + m m',   Y' = -Y / forgetting + m p,   so that Y = Omega eta,

the mixing multiplies by the adjugate: ``adj(Omega) Y = Delta eta`` with ``Delta = det Omega`` is
one scalar regression for every eta_i, each with a gradient of its own,

    eta_i' = gain Delta (adj(Omega) Y - Delta eta)_i / max Delta^2,

so that errors decay one by one, without oscillating (S. Aranovskiy, A. Bobtsov, R. Ortega and
A. Pyrkin, IEEE Trans. Automatic Control 62, 2017). Delta is taken in units of its largest value so
far: its own unit is the q-th power of that of mu squared. ``forgetting`` is the time constant in
which samples lose their weight.
"""

from __future__ import annotations

from cosim.arrays import Matrix, Vector
from cosim.theory.estimators.adaptive import AdaptiveEstimate, adapt
from cosim.theory.estimators.defaults import DREM_FORGETTING, DREM_GAIN
from cosim.theory.estimators.least_squares import Recovery


def drem(
    t: Vector,
    mu: Matrix,
    recovery: Recovery,
    *,
    gain: float = DREM_GAIN,
    forgetting: float = DREM_FORGETTING,
) -> AdaptiveEstimate:
    """Extend and mix rows of the regression, straight lines between them.

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
    forgetting : float
        [s]
    """
    return adapt("drem", recovery, t, mu, gain=gain, forgetting=forgetting)
