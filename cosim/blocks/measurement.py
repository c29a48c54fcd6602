"""What happens to the samples of a sensor: sampling instants, conversion, random numbers.

The order of these effects stands in :mod:`cosim.blocks.sensor`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError, steps_text
from cosim.native.blocks.sensor import DrawnSamples, Levels
from cosim.native.numerics.noise import WORDS_PER_NORMAL, normal
from cosim.native.step import LARGEST_MEMORY

MOST_BITS = 52  # doubles tell no more levels apart
WHOLE_NUMBERS = 2.0**53  # from here on every double is a whole number
DRAWN_AHEAD = 4096  # numbers that are drawn at once, at least: a call for each sample is slow

PerElement: TypeAlias = float | Sequence[float]


@dataclass(frozen=True, slots=True)
class SensorParameters:
    """What happens to a sample; without any, a sensor reports its input.

    Those in units of the signal are one number, or one for each element.

    Parameters
    ----------
    noise : float or sequence of float
        Standard deviation of every sample, whatever the step.
    bias : float or sequence of float
    lower, upper : float or sequence of float, optional
        Limits of y.
    resolution : float or sequence of float, optional
        Distance of the levels, its whole multiples within the limits.
    bits : int, optional
        Instead: 2**bits levels, the first at ``lower``, the last at ``upper``.
    delay : float
        Communication steps, also parts of a step.
    jitter : float
        Largest deviation of the sampling instant [communication steps].
    dropout : float, optional
        Probability that a sample is lost; given, the sensor has the output ``valid``.
    seed : int, optional
        Of noise, jitter and dropouts.
    period : int
        Communication steps between two samples.
    """

    noise: PerElement = 0.0
    bias: PerElement = 0.0
    lower: PerElement | None = None
    upper: PerElement | None = None
    resolution: PerElement | None = None
    bits: int | None = None
    delay: float = 0.0
    jitter: float = 0.0
    dropout: float | None = None
    seed: int | None = None
    period: int = 1

    @property
    def earliest(self) -> float:
        """The earliest sampling instant minus t [communication steps]."""
        return -self.delay - self.jitter

    @property
    def latest(self) -> float:
        """The latest sampling instant minus t [communication steps]."""
        return self.jitter - self.delay


def per_element(name: str, value: PerElement, size: int) -> Vector:
    """Return one number for each element.

    Raises
    ------
    UsageError
        If there are more or fewer, or a number is not finite.
    """
    values = np.array(value, np.float64)
    if not np.isfinite(values).all():
        raise UsageError(f"{name}: expected finite numbers, got NaN or infinity")
    if values.ndim == 0:
        return np.full(size, float(values))
    if values.shape != (size,):
        raise UsageError(
            f"{name}: expected one number, or one for each of {size} elements, got {values.size}"
        )
    return values


class SamplingInstants:
    """When samples are taken.

    Parameters
    ----------
    parameters : SensorParameters
    size : int
        Number of elements.

    Attributes
    ----------
    depth : int
        Number of past inputs that are needed.
    reach_now : bool
        Whether the input at t counts for the sample at t.

    Raises
    ------
    UsageError
        If they are not possible, or need too many past inputs.
    """

    def __init__(self, parameters: SensorParameters, size: int) -> None:
        _check_timing(parameters)
        self.reach_now = parameters.latest > -1.0
        self.depth = -math.floor(parameters.earliest)
        if self.depth * size > LARGEST_MEMORY:
            raise UsageError(
                f"delay: expected at most {LARGEST_MEMORY} values, got "
                f"{steps_text(parameters.delay)} of {size} values"
            )


def _check_timing(parameters: SensorParameters) -> None:
    delay = parameters.delay
    jitter = parameters.jitter
    period = parameters.period
    if period < 1:
        raise UsageError(f"period: expected at least 1 communication step, got {period}")
    if not 0.0 <= delay < np.inf:
        raise UsageError(f"delay: expected a number of communication steps >= 0, got {delay:g}")
    if not 0.0 <= jitter <= 0.5 * period:
        raise UsageError(
            f"jitter: expected 0 to {0.5 * period:g}, half the sampling period, so that samples "
            f"keep their order, got {steps_text(jitter)}"
        )
    if parameters.latest > 1.0:
        raise UsageError(
            f"jitter: got {steps_text(jitter)}, so that samples are taken up to "
            f"{parameters.latest:g} after they are reported, where the input is not known; "
            "expected at most 1: use less jitter, or more delay"
        )


class MeasuringChain:
    """From the input at the sampling instant to what is measured: bias, limits, levels.

    Parameters
    ----------
    parameters : SensorParameters
    size : int
        Number of elements.

    Attributes
    ----------
    bias, lower, upper : Vector, shape (size,)
    levels : Levels or None

    Raises
    ------
    UsageError
        If they are not possible.
    """

    def __init__(self, parameters: SensorParameters, size: int) -> None:
        lower = parameters.lower
        upper = parameters.upper
        self.bias = per_element("bias", parameters.bias, size)
        self.lower = np.full(size, -np.inf)
        self.upper = np.full(size, np.inf)
        if lower is not None:
            self.lower = per_element("lower", lower, size)
        if upper is not None:
            self.upper = per_element("upper", upper, size)
        self._check_limits()
        self.levels = self._quantizer(parameters, size)

    def _check_limits(self) -> None:
        wrong = np.flatnonzero(self.lower >= self.upper)
        if wrong.size:
            lower = self.lower[wrong[0]]
            upper = self.upper[wrong[0]]
            raise UsageError(f"expected lower < upper, got lower = {lower:g} and upper = {upper:g}")

    def _quantizer(self, parameters: SensorParameters, size: int) -> Levels | None:
        if parameters.bits is None:
            if parameters.resolution is None:
                return None
            resolution = per_element("resolution", parameters.resolution, size)
            return _levels_of_resolution(resolution, self.lower, self.upper)
        if parameters.resolution is not None:
            raise UsageError("expected resolution or bits, got both")
        if parameters.lower is None or parameters.upper is None:
            raise UsageError("bits: requires lower and upper, the range of the levels")
        return _levels_of_bits(parameters.bits, self.lower, self.upper)


def _levels_of_bits(bits: int, lower: Vector, upper: Vector) -> Levels:
    if not 1 <= bits <= MOST_BITS:
        raise UsageError(f"bits: expected 1 to {MOST_BITS}, got {bits}")
    intervals = np.full(len(lower), 2.0**bits - 1.0)
    with np.errstate(over="ignore"):
        resolution = (upper - lower) / intervals
    largest = np.maximum(np.abs(lower), np.abs(upper))
    if (resolution < np.spacing(largest)).any() or np.isinf(resolution).any():
        raise UsageError(
            f"bits: got {bits}, but there are fewer than 2**{bits} equidistant doubles from lower "
            "to upper; use fewer bits, or other limits"
        )
    return Levels(lower, resolution, np.zeros(len(lower)), intervals)


def _levels_of_resolution(resolution: Vector, lower: Vector, upper: Vector) -> Levels:
    first = np.full(len(resolution), -np.inf)
    last = np.full(len(resolution), np.inf)
    for i, distance in enumerate(resolution.tolist()):
        if not distance > 0.0:
            raise UsageError(f"resolution: expected a number > 0, got {distance:g}")
        if np.isfinite(lower[i]):
            first[i] = _number_of_level(math.ceil(_ratio(lower[i], distance)))
        if np.isfinite(upper[i]):
            last[i] = _number_of_level(math.floor(_ratio(upper[i], distance)))
        if not first[i] < last[i]:
            limits = f"{lower[i]:g} and {upper[i]:g}"
            raise UsageError(
                f"resolution: expected two multiples or more between the limits {limits}, got "
                f"{distance:g}"
            )
    return Levels(np.zeros(len(resolution)), resolution, first, last)


def _ratio(limit: float, distance: float) -> Fraction:
    """Return the ratio of the decimals: 0.3 is 3 times 0.1, which its double is not."""
    return Fraction(repr(float(limit))) / Fraction(repr(distance))


def _number_of_level(number: int) -> float:
    """Return it as a double; infinity where every double is a level."""
    if abs(number) < WHOLE_NUMBERS:
        return float(number)
    return math.copysign(np.inf, number)


@dataclass(frozen=True, eq=False, slots=True)
class StreamState:
    """The numbers of the first sample of those drawn, and the generators before the others."""

    first: tuple[Vector, ...]
    generators: tuple[Any, ...]

    def is_same(self, other: StreamState) -> bool:
        """Whether the numbers that were drawn are those of another state."""
        return self.generators == other.generators and all(
            map(np.array_equal, self.first, other.first)
        )


class SampleStreams:
    """The random numbers of a sensor's samples: a stream for each effect.

    Parameters
    ----------
    parameters : SensorParameters
    size : int
        Number of elements.

    Attributes
    ----------
    drawn : DrawnSamples
        The numbers that were drawn ahead.

    Raises
    ------
    UsageError
        If they are not possible.
    """

    def __init__(self, parameters: SensorParameters, size: int) -> None:
        self._deviation = per_element("noise", parameters.noise, size)
        if (self._deviation < 0.0).any():
            smallest = self._deviation.min()
            raise UsageError(f"noise: expected a standard deviation >= 0, got {smallest:g}")
        self._dropout = 0.0 if parameters.dropout is None else parameters.dropout
        if not 0.0 <= self._dropout < 1.0:
            raise UsageError(f"dropout: expected a probability >= 0 and < 1, got {self._dropout:g}")
        self._parameters = parameters
        self._is_noisy = bool(self._deviation.any())
        self._seed = self._checked_seed()
        shape = (1 + max(1, DRAWN_AHEAD // size), size)
        self.drawn = DrawnSamples(np.zeros(shape), np.zeros(shape), np.zeros(shape))
        self._arrays = (self.drawn.position, self.drawn.noise, self.drawn.lost)
        self.begin()

    def _checked_seed(self) -> int:
        """Return the seed, 0 where nothing is random."""
        seed = self._parameters.seed
        if seed is None:
            if self._is_noisy or self._parameters.jitter or self._dropout:
                raise UsageError(
                    "seed: expected an integer, as noise, jitter and dropout require one"
                )
            return 0
        if seed < 0:
            raise UsageError(f"seed: expected an integer >= 0, got {seed}")
        return seed

    def begin(self) -> None:
        """Begin all streams; the first sample is not lost, as there is none to keep instead."""
        self._noise_words = self._generator(0)
        self._jitter_words = self._generator(1)
        self._dropout_words = self._generator(2)
        self._draw(slice(0, 1))
        self.drawn.lost[0] = 0.0
        self._draw_others()

    def _generator(self, spawn_key: int) -> np.random.PCG64:
        return np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=(spawn_key,)))

    def draw_more(self) -> None:
        """Keep the last sample as the first, and draw the others anew."""
        for array in self._arrays:
            array[0] = array[-1]
        self._draw_others()

    def _draw_others(self) -> None:
        """Draw all samples but the first."""
        states = tuple(generator.state for generator in self._generators)
        first = tuple(array[0].copy() for array in self._arrays)
        self._state = StreamState(first, states)
        self._draw(slice(1, None))

    def _draw(self, rows: slice) -> None:
        position, noise, lost = (array[rows] for array in self._arrays)
        parameters = self._parameters
        shape = (len(position), position.shape[1])
        position[:] = -parameters.delay
        if parameters.jitter:
            within = 2.0 * _uniform(self._jitter_words, shape) - 1.0
            # rounding keeps the order of numbers: none is before earliest or after latest
            position[:] = parameters.jitter * within + position
        if self._is_noisy:
            words = self._noise_words.random_raw(WORDS_PER_NORMAL * noise.size)
            noise[:] = self._deviation * normal(words).reshape(shape)
        if self._dropout:
            lost[:] = _uniform(self._dropout_words, shape) < self._dropout

    def save(self) -> StreamState:
        """Return the state of the numbers that were drawn."""
        return self._state

    def restore(self, state: StreamState) -> None:
        """Go back to a saved state."""
        if state.is_same(self._state):
            return
        for array, first in zip(self._arrays, state.first, strict=True):
            array[0] = first
        for generator, saved in zip(self._generators, state.generators, strict=True):
            generator.state = saved
        self._draw_others()

    @property
    def _generators(self) -> tuple[np.random.PCG64, ...]:
        return (self._noise_words, self._jitter_words, self._dropout_words)


def _uniform(generator: np.random.PCG64, shape: tuple[int, int]) -> Matrix:
    """Return numbers of [0, 1), the 53 leading bits of a word each."""
    words: NDArray[np.uint64] = generator.random_raw(shape[0] * shape[1])
    leading = words >> np.uint64(11)
    return leading.astype(np.float64).reshape(shape) * 2.0**-53
