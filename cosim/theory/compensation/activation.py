"""When an estimate of theta is good enough for the internal model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Mask, Vector

HALF_WIDTH: Final = 1.959963984540054  # of a 95 % interval, in standard errors


@dataclass(frozen=True, eq=False)
class Activation:
    """The conditions: the 95 % interval within the certified one, a small standard error.

    Parameters
    ----------
    lower, upper : Vector, shape (P,)
        The interval that the loop is certified for.
    largest_error : float
        Largest standard error, relative to theta, or to half the interval where that is more: a
        theta may be zero.
    """

    lower: Vector
    upper: Vector
    largest_error: float

    def allows(self, theta: Vector, error: Vector) -> bool:
        """Return whether an estimate with its standard error is good enough; NaN: it is not."""
        return bool(self._is_good(theta, error).all())

    def reason(self, theta: Vector, error: Vector) -> str:
        """Return why an estimate is not good enough; empty: it is."""
        unmet = np.flatnonzero(~self._is_good(theta, error))
        if not len(unmet):
            return ""
        j = int(unmet[0])
        name = "theta" if len(theta) == 1 else f"theta[{j}]"
        value = float(theta[j])
        deviation = float(error[j])
        if not np.isfinite(value) or not np.isfinite(deviation):
            return f"{name} has no value with a standard error"
        if self._is_inside(theta, error)[j]:
            return (
                f"the standard error of {name} = {value:.6g} is {deviation:.2g}, more than "
                f"{self.largest_error:g} of it, or of half its interval"
            )
        reach = HALF_WIDTH * deviation
        lower = float(self.lower[j])
        upper = float(self.upper[j])
        return (
            f"the 95 % interval of {name}, [{value - reach:.6g}, {value + reach:.6g}], is not "
            f"within the certified [{lower:.6g}, {upper:.6g}]"
        )

    def largest_standard_error(self, theta: Vector) -> Vector:
        """Return the largest standard error with which a theta is good enough, shape (P,).

        Where it is not above zero there is none.
        """
        below = theta - self.lower
        above = self.upper - theta
        room = np.minimum(below, above)
        small = self._small(theta)
        return np.minimum(small, room / HALF_WIDTH)

    def _is_good(self, theta: Vector, error: Vector) -> Mask:
        is_inside = self._is_inside(theta, error)
        is_small = error <= self._small(theta)
        return is_inside & is_small

    def _is_inside(self, theta: Vector, error: Vector) -> Mask:
        reach = HALF_WIDTH * error
        above = theta - reach >= self.lower
        below = theta + reach <= self.upper
        return above & below

    def _small(self, theta: Vector) -> Vector:
        """Return the largest standard error that is small."""
        width = self.upper - self.lower
        size = np.abs(theta)
        relative_to = np.maximum(size, 0.5 * width)
        return self.largest_error * relative_to
