"""The deviation of white noise in a smooth signal, from its samples alone.

Differences of order p take away polynomials of degree p - 1, and make of white noise of variance
s^2 noise of variance `C(2 p, p) s^2`. Where the signal is smooth against the samples, the estimates
of s fall with p until only noise is left, and then stay, but for their own scatter of about
`N^(-1/2)`: that is where it is read. Quantization, rounding, and signals with less than three
samples a period count as noise here, and noise that is not white is read by its power at the
highest frequencies.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import AssumptionError

_HIGHEST_ORDER: Final = 12
_FEWEST_SAMPLES: Final = 200
# relative distance of estimates that count as one: at most, and in their standard errors
_MOST_APART: Final = 0.1
_STANDARD_ERRORS: Final = 4.0


def noise_level(samples: Vector) -> float:
    """Estimate the deviation of white noise in the samples of one signal, shape ``(N,)``.

    Raises
    ------
    AssumptionError
        If there are too few samples, one is not finite, or the estimates do not settle: the signal
        is too fast for its samples, or the noise is not white.
    """
    if len(samples) < _FEWEST_SAMPLES:
        raise AssumptionError(
            f"noise level: expected at least {_FEWEST_SAMPLES} samples, got {len(samples)}"
        )
    if not np.isfinite(samples).all():
        raise AssumptionError("noise level: expected finite samples")
    estimates: list[float] = []
    differences = samples
    for order in range(1, _HIGHEST_ORDER + 1):
        differences = np.diff(differences)
        variance = float(np.mean(differences**2)) / math.comb(2 * order, order)
        estimates.append(math.sqrt(variance))
    apart = min(_MOST_APART, _STANDARD_ERRORS / math.sqrt(len(samples)))
    for order in range(2, _HIGHEST_ORDER - 1):
        level, *later = estimates[order - 1 : order + 2]
        if all(abs(estimate - level) <= apart * level for estimate in later):
            return level
    shown = ", ".join(f"{estimate:.3g}" for estimate in estimates)
    raise AssumptionError(
        f"noise level: differences of order 1, 2, ... do not converge: {shown}; "
        "the signal is too fast for its samples, or its noise is not white"
    )
