"""Reconstruction of delta: three ways to the derivative in (20), and what each one costs.

With `w = y - C4 u`, the drift `v = C3 A_a x_a + C3 B_1a u` and `G = (C3 B_2a)^+`, delta is
`G (w' - v)` (20). x_a is known at once, w' is not:

* **first-order**, the paper's (19): w' is read through `F(s) = rate / (s + rate)`, v is not. What F
  does to w' is an error of delta, `-G w'' / rate` to the leading order, whatever delta is: no
  instant belongs to this delta but its own.
* **consistent**: the same filter of all of (15), that is of `r = w - integral of v`, whose
  derivative is `delta / G`. With the increments of r over the steps, which are known exactly,

      e(t + h) = a e(t) + (1 - a)/h G (r(t + h) - r(t)),    a = exp(-rate h),

  is a moving average of delta with exponential weights: delta at `t - lag`, with the lag
  `h/2 (1 + a)/(1 - a)`, about 1/rate, but for `delta'' / (2 rate^2)`. Nothing is assumed of w
  between its samples, so that held ones do no harm.
* **Savitzky-Golay**: a polynomial is fitted to `2 m + 1` samples of r, m on each side, and its
  slope in the middle taken, with the fixed lag `m step`. The taps d_k, k = -m..m, are odd in k, and
  exact for polynomials r up to the order (one more where that is odd). A sum by parts turns them
  into weights of the increments of r,

      sum_k d_k r_k = sum_i c_i (r_i - r_(i-1)),    c_i = sum over k >= i of d_k,

  so the reconstruction is a moving average of delta: what is exact in r up to degree n is exact in
  delta up to n - 1, and no sum grows with time.

By white noise of deviation 1 in w at every sample, the derivative has the deviation `noise_gain`.
Both filters respond to one sample by `s, -s (1 - a), -s (1 - a) a, ...` with `s = (1 - a)/h`, and
`s = rate` where (19) reads held samples; the sum of squares is `2 s^2 / (1 + a)`. For the fit it is
the sum of `d_k^2`.

``cosim.theory.reconstruction.filter_choice`` takes the one of the least predicted error.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import ClassVar, Final, Protocol

import numpy as np

from cosim.arrays import Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.documents import Bias

HIGHEST_ORDER: Final = 10  # of a fitted polynomial: beyond it noise is all that it follows
MOST_SAMPLES: Final = 100_000  # on each side of a window


class DisturbanceFilter(Protocol):
    """A way to the derivative in (20)."""

    @property
    def name(self) -> str:
        """What scenarios call it."""
        ...

    @property
    def lag(self) -> float:
        """How far back the instant lies that delta belongs to [s]."""
        ...

    @property
    def window(self) -> float:
        """How long there is no value at the start [s]."""
        ...

    @property
    def bias(self) -> Bias:
        """The leading error."""
        ...

    def noise_gain(self, *, held: bool = False) -> float:
        """Return the deviation of the derivative for white noise of deviation 1 in w [1/s].

        ``held``: w has a zero-order hold.
        """
        ...

    def response(self, rate: float) -> complex:
        """Return what becomes of a sine of ``rate`` [rad/s] and amplitude 1, the lag taken out.

        The error relative to its amplitude is the distance from 1.
        """
        ...


@dataclass(frozen=True)
class DirectReconstruction:
    """No filter: delta follows from y without a derivative."""

    name: ClassVar[str] = "direct"
    lag: ClassVar[float] = 0.0
    window: ClassVar[float] = 0.0
    bias: ClassVar[Bias] = Bias(0.0, 0, "delta")


@dataclass(frozen=True)
class _ExponentialFilter:
    """What both filters by `F(s) = rate / (s + rate)` have in common.

    Parameters
    ----------
    rate : float
        `lambda_f` [rad/s].
    step : float
        Between samples [s].

    Raises
    ------
    AssumptionError
        If one is not positive and finite.
    """

    rate: float
    step: float

    def __post_init__(self) -> None:
        _check_positive("filter_rate", self.rate, "rate [rad/s]")
        _check_positive("step", self.step, "time [s]")

    @property
    def window(self) -> float:
        """It has a value at once."""
        return 0.0

    @property
    def _decay(self) -> float:
        """What is left of a value after a step, `a`."""
        return math.exp(-self.rate * self.step)

    @property
    def _newest_weight(self) -> float:
        """`(1 - a)/h`."""
        return -math.expm1(-self.rate * self.step) / self.step

    @property
    def _mean_age(self) -> float:
        """`h/2 (1 + a)/(1 - a)`."""
        return 0.5 * self.step / math.tanh(0.5 * self.rate * self.step)

    def _noise_gain(self, first: float) -> float:
        """Return `s (2 / (1 + a))^(1/2)` for the response ``first`` = s to a sample at once."""
        return first * math.sqrt(2.0 / (1.0 + self._decay))

    def _averaged(self, rate: float) -> complex:
        """Return the response of the average of increments, with exponential weights.

        ``sum over j of (1 - a)/h a^j`` times the mean of ``exp(i rate t)`` over step j back.
        """
        if rate == 0.0:
            return complex(1.0)
        angle = rate * self.step
        mean = cmath.exp(-0.5j * angle) * (math.sin(0.5 * angle) / (0.5 * angle))
        newest = self._newest_weight * self.step
        return mean * newest / (1.0 - self._decay * cmath.exp(-1j * angle))


class FirstOrderFilter(_ExponentialFilter):
    """The filter (19) of w' alone, with linear interpolation of w."""

    @property
    def name(self) -> str:
        """What scenarios call it."""
        return "first-order"

    @property
    def lag(self) -> float:
        """None that could be taken out: what is late is w', not delta."""
        return 0.0

    @property
    def bias(self) -> Bias:
        """The leading error, about `-G w'' / rate`."""
        return Bias(-self._mean_age, 2, "G w")

    def noise_gain(self, *, held: bool = False) -> float:
        """Return `s (2 / (1 + a))^(1/2)`."""
        return self._noise_gain(self.rate if held else self._newest_weight)

    def response(self, rate: float) -> complex:
        """Return the response of G w', a part of delta that may be larger than delta."""
        return self._averaged(rate)


class ConsistentFilter(_ExponentialFilter):
    """The same filter of all of (15), by increments."""

    @property
    def name(self) -> str:
        """What scenarios call it."""
        return "consistent"

    @property
    def lag(self) -> float:
        """The mean age of what is averaged, about 1/rate."""
        return self._mean_age

    @property
    def bias(self) -> Bias:
        """The leading error, half of the variance of the age, about `delta'' / (2 rate^2)`."""
        steps = self._decay / math.expm1(-self.rate * self.step) ** 2
        return Bias(0.5 * self.step**2 * (1.0 / 12.0 + steps), 2, "delta")

    def noise_gain(self, *, held: bool = False) -> float:
        """Return `s (2 / (1 + a))^(1/2)`, whatever w is between its samples."""
        return self._noise_gain(self._newest_weight)

    def response(self, rate: float) -> complex:
        """Return the response of delta."""
        return self._averaged(rate) * cmath.exp(1j * rate * self.lag)


@dataclass(frozen=True)
class SavitzkyGolay:
    """The slope in the middle of a polynomial, fitted to the samples of a window.

    Parameters
    ----------
    half_width : int
        Samples on each side of the middle, m.
    order : int
        Of the polynomial. An even one is as good as the odd one before it: the middle is a point of
        symmetry.
    step : float
        Between samples [s].

    Raises
    ------
    AssumptionError
        If the window is empty or too long, or the order does not fit into it.
    """

    half_width: int
    order: int
    step: float

    def __post_init__(self) -> None:
        if not 1 <= self.half_width <= MOST_SAMPLES:
            raise AssumptionError(
                f"Savitzky-Golay: half width: expected 1 to {MOST_SAMPLES} samples, got "
                f"{self.half_width}"
            )
        if not 1 <= self.order <= min(HIGHEST_ORDER, 2 * self.half_width):
            raise AssumptionError(
                f"Savitzky-Golay: order: expected 1 to {HIGHEST_ORDER}, and less than the "
                f"{2 * self.half_width + 1} samples, got {self.order}"
            )
        if not 0.0 < self.step < math.inf:
            raise AssumptionError(
                f"Savitzky-Golay: step: expected a positive finite time [s], got {self.step:g}"
            )

    @property
    def name(self) -> str:
        """What scenarios call it."""
        return "savitzky-golay"

    @property
    def lag(self) -> float:
        """Half of the window."""
        return self.half_width * self.step

    @property
    def window(self) -> float:
        """The window has to be full."""
        return 2 * self.half_width * self.step

    @cached_property
    def _coefficients(self) -> tuple[Fraction, ...]:
        """The odd polynomial that gives the taps times step: of k, k^3, ...

        The least squares fit of a slope, so they solve ``sum_j S(i + j) a_j = [i = 0]`` with the
        power sums ``S(i) = sum over k of k^(2 i + 2)``.
        """
        n = (self.order + 1) // 2
        sums = [Fraction(self._power_sum(2 * i + 2)) for i in range(2 * n - 1)]
        rows = [sums[i : i + n] for i in range(n)]
        right = [Fraction(int(i == 0)) for i in range(n)]
        return _solve(rows, right)

    def _power_sum(self, power: int) -> int:
        """Return the sum of k^power over the window, ``power`` even."""
        right: int = sum(k**power for k in range(1, self.half_width + 1))
        return 2 * right

    @cached_property
    def _numerators(self) -> tuple[list[int], int]:
        """The taps of k = 1..m times step, over one denominator: exact."""
        coefficients = self._coefficients
        denominator = math.lcm(*(a.denominator for a in coefficients))
        integers = [int(a * denominator) for a in coefficients]
        numerators = []
        for k in range(1, self.half_width + 1):
            value = 0
            for integer in reversed(integers):
                value = value * k * k + integer
            numerators.append(value * k)
        return numerators, denominator

    @cached_property
    def taps(self) -> Vector:
        """The weights d_k of r at k = -m..m [1/s], shape ``(2 m + 1,)``, rounded once."""
        numerators, denominator = self._numerators
        right = [numerator / denominator for numerator in numerators]
        left = [-value for value in reversed(right)]
        return frozen(np.array([*left, 0.0, *right]) / self.step, 1)

    @cached_property
    def weights(self) -> Vector:
        """The weights c_i of the increments of r [1/s], oldest first, shape ``(2 m,)``.

        Their sum times step is 1; rounded once.
        """
        numerators, denominator = self._numerators
        total = 0
        newest_first = []
        for numerator in reversed(numerators):
            total += numerator
            newest_first.append(total / denominator)
        oldest_first = newest_first[::-1]
        return frozen(np.array([*newest_first, *oldest_first]) / self.step, 1)

    @property
    def bias(self) -> Bias:
        """The leading error: the first odd power of time that the fit does not follow."""
        degree = 2 * len(self._coefficients) + 1
        total = Fraction(0)
        for i, coefficient in enumerate(self._coefficients):
            total += coefficient * self._power_sum(2 * i + 1 + degree)
        factor = float(total / math.factorial(degree))
        return Bias(factor * self.step ** (degree - 1), degree - 1, "delta")

    def noise_gain(self, *, held: bool = False) -> float:
        """Return the root of the sum of the squared taps."""
        return math.sqrt(self._coefficients[0]) / self.step

    def response(self, rate: float) -> complex:
        """Return the response of delta: real, for a window has no error of phase."""
        if rate == 0.0:
            return complex(1.0)
        k = np.arange(1, self.half_width + 1)
        right = self.taps[self.half_width + 1 :]
        total = 2.0 * float(np.sum(right * np.sin(k * (rate * self.step))))
        return complex(total / rate)


def _check_positive(name: str, value: float, what: str) -> None:
    if not 0.0 < value < math.inf:
        raise AssumptionError(f"{name}: expected a positive finite {what}, got {value:g}")


def _solve(rows: list[list[Fraction]], right: list[Fraction]) -> tuple[Fraction, ...]:
    """Solve a positive definite system exactly, by elimination without pivots."""
    n = len(right)
    eliminated = [[*row, value] for row, value in zip(rows, right, strict=True)]
    for k in range(n):
        pivot = eliminated[k][k]
        eliminated[k] = [value / pivot for value in eliminated[k]]
        for i in range(n):
            if i != k:
                factor = eliminated[i][k]
                pairs = zip(eliminated[i], eliminated[k], strict=True)
                eliminated[i] = [value - factor * other for value, other in pairs]
    return tuple(row[n] for row in eliminated)
