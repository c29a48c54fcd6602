"""The confidence of all intervals of studies, and the quantiles that belong to it."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import ndtri, stdtrit

from cosim.arrays import Vector

CONFIDENCE: Final = 0.95
TAIL: Final = 0.5 * (1.0 - CONFIDENCE)  # beyond either end of an interval
_UPPER: Final = 0.5 + 0.5 * CONFIDENCE

NORMAL_QUANTILE: Final = float(ndtri(_UPPER))


def student_quantile(count: float) -> float:
    """Return the quantile of Student's distribution for ``count`` values, of one degree less."""
    return float(stdtrit(count - 1, _UPPER))


def student_quantiles(counts: Vector) -> Vector:
    """Return the same for counts (n,); NaN for one value, and for none."""
    return np.asarray(stdtrit(counts - 1.0, _UPPER))
