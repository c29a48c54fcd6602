"""Adaptive laws on the linear regression (26): baselines.

The **gradient**, normalized:

    eta' = gain m (p - m'eta) / m'm,   eta(0) = 0,

as in S. Sastry and M. Bodson, Adaptive Control, 1989, section 2.2. The normalization makes it
independent of the unit of delta, and stable for every gain: eta goes towards the plane of the
present row at the rate ``gain``. It converges at the rate of the weakest direction of the
regressor, which is 3e4 times slower than the strongest in the paper's example.

**Dynamic regressor extension and mixing** with Kreisselmeier's extension:

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

from cosim.native.estimation.adaptive import AdaptiveConstants
from cosim.theory.estimators.least_squares import Recovery, recovery_constants


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
