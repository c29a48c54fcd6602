"""Adaptive laws as identifiers: the gradient, and regressor extension and mixing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Mask
from cosim.blocks.identifier import regression_interface
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import UsageError
from cosim.native.estimation.adaptive import AdaptiveLaw, AdaptiveStep
from cosim.theory.estimators.adaptive import adaptive_constants
from cosim.theory.estimators.least_squares import Recovery


@dataclass(frozen=True, eq=False, kw_only=True)
class AdaptiveIdentifier:
    """Input regressor (mu), outputs theta and eta.

    Parameters
    ----------
    law : AdaptiveLaw
    recovery : Recovery
        How theta follows from eta.
    start_time : float
        First instant that counts, the identification start time T_id (36) [s].
    gain : float
        [1/s]
    forgetting : float
        Time constant in which samples lose their weight [s], infinite: they keep it; of DREM.

    Raises
    ------
    UsageError
        If gain is not positive and finite, or forgetting not positive.
    """

    law: AdaptiveLaw
    recovery: Recovery
    start_time: float
    gain: float
    forgetting: float

    def __post_init__(self) -> None:
        if not 0.0 < self.gain < np.inf:
            raise UsageError(f"gain: expected a finite number > 0, got {self.gain} 1/s")
        if not self.forgetting > 0.0:
            raise UsageError(f"forgetting: expected a time > 0, got {self.forgetting} s")

    @property
    def interface(self) -> Interface:
        """Input regressor, outputs theta and eta."""
        return regression_interface(self.recovery)

    def design(self, h: float, held: Mask) -> Design:
        """Return the start time: it depends on eigenvalues, so it is recorded."""
        return {"start": np.array([self.start_time])}

    def kernel(self, h: float, held: Mask, design: Design) -> AdaptiveStep:
        """Return the law without samples."""
        (start,) = design["start"]
        constants = adaptive_constants(
            self.recovery,
            start_time=float(start),
            gain=self.gain,
            forgetting=self.forgetting,
            held=bool(held.any()),
        )
        return AdaptiveStep(self.law, constants)
