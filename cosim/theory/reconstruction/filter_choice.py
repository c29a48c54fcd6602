"""The reconstruction of delta with the least predicted error.

The error is the root of the squares of noise and bias, the bias that of one sine at the highest
rate of delta. The noise that reaches delta through the drift is not counted: a window averages it.
``cosim.theory.reconstruction.noise_gain`` counts all of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from cosim.errors import AssumptionError
from cosim.theory.reconstruction.filters import MOST_SAMPLES, DisturbanceFilter, SavitzkyGolay

# half width times rate up to which the error of a window grows with it, at every order
WIDEST: Final = 4.4
_ORDERS: Final = (2, 4, 6)


@dataclass(frozen=True)
class Conditions:
    """What a reconstruction has to do with.

    Parameters
    ----------
    noise : float
        Deviation of `G w` at a sample, white [unit of delta times s].
    amplitude : float
        Root mean square of delta.
    bandwidth : float
        Highest rate of delta [rad/s].
    step : float
        Between samples [s].

    Raises
    ------
    AssumptionError
        If a number is not positive and finite; the noise may be 0.
    """

    noise: float
    amplitude: float
    bandwidth: float
    step: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.noise < math.inf:
            raise AssumptionError(
                f"noise: expected a finite deviation of 0 or more, got {self.noise:g}"
            )
        for name in ("amplitude", "bandwidth", "step"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise AssumptionError(f"{name}: expected a positive finite number, got {value:g}")
        if self.bandwidth * self.step >= WIDEST / 2.0:
            raise AssumptionError(
                f"bandwidth: expected less than {WIDEST / 2.0 / self.step:g} rad/s with samples "
                f"every {self.step:g} s, got {self.bandwidth:g} rad/s"
            )

    def error(self, reconstruction: DisturbanceFilter) -> PredictedError:
        """Predict the error of a reconstruction of delta."""
        noise = reconstruction.noise_gain() * self.noise
        bias = abs(reconstruction.response(self.bandwidth) - 1.0) * self.amplitude
        return PredictedError(noise, bias)


@dataclass(frozen=True)
class PredictedError:
    """What is expected of a reconstruction of delta, as root mean squares."""

    noise: float
    bias: float

    @property
    def total(self) -> float:
        """Both together."""
        return math.hypot(self.noise, self.bias)


@dataclass(frozen=True)
class Choice:
    """A window, and what is expected of it."""

    window: SavitzkyGolay
    error: PredictedError


def choose(conditions: Conditions) -> Choice:
    """Choose the window of the least predicted error.

    Among those of the orders 2, 4 and 6 and of every length up to ``WIDEST / bandwidth``. Filters
    are no candidates: at every rate up to 1/step the best window has less error than the consistent
    filter, wherever that is less than delta itself; and the first-order filter has the noise of the
    consistent one, and an error of a lower order.

    Raises
    ------
    AssumptionError
        If the least error is as large as delta.
    """
    windows: list[SavitzkyGolay] = []
    for order in _ORDERS:
        windows += _best_window(conditions, order)
    choices = [Choice(window, conditions.error(window)) for window in windows]
    best = min(choices, key=lambda choice: (choice.error.total, choice.window.half_width))
    if best.error.total >= conditions.amplitude:
        raise AssumptionError(
            f"noise of {conditions.noise:g} at every sample leaves an error of "
            f"{best.error.total:.3g} in delta with the best window, not less than its amplitude, "
            f"{conditions.amplitude:g}; use less noise, more samples, or a smaller bandwidth"
        )
    return best


def _best_window(conditions: Conditions, order: int) -> Sequence[SavitzkyGolay]:
    """Return the best window of an order; none where no window is short enough."""
    longest = math.floor(WIDEST / (conditions.bandwidth * conditions.step))
    shortest = (order + 1) // 2
    longest = min(longest, MOST_SAMPLES)
    if longest < shortest:
        return ()

    def total(half_width: int) -> float:
        window = SavitzkyGolay(half_width, order, conditions.step)
        return conditions.error(window).total

    half_width = _first_rise(total, shortest, longest)
    return (SavitzkyGolay(half_width, order, conditions.step),)


def _first_rise(value: Callable[[int], float], low: int, high: int) -> int:
    """Return where a function stops to fall: noise falls with the length, bias grows."""
    reach = low
    while reach < high and value(reach) > value(reach + 1):
        low = reach + 1
        reach *= 2
    high = min(reach, high)
    while low < high:
        middle = (low + high) // 2
        if value(middle) <= value(middle + 1):
            high = middle
        else:
            low = middle + 1
    return low
