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

from cosim.arrays import Mask, Matrix, Vector
from cosim.errors import UsageError, steps_text
from cosim.native.step import LARGEST_MEMORY, WORDS_PER_NORMAL, normal

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
        raise UsageError(f"{name}: found NaN or infinity, needed finite numbers")
    if values.ndim == 0:
        return np.full(size, float(values))
    if values.shape != (size,):
        raise UsageError(
            f"{name}: found {values.size} numbers, needed one, or one for each of {size} elements"
        )
    return values


class SamplingInstants:
    """When samples are taken, and what the input is then.

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
                f"delay: found {steps_text(parameters.delay)} of {size} values, needed "
                f"at most {LARGEST_MEMORY} values"
            )
        self._column = np.arange(size)

    def values(
        self, past: Matrix, u: Matrix, row: NDArray[np.int64], position: Matrix, held: Mask
    ) -> Matrix:
        """Return the input at sampling instants, shape (n, size).

        Parameters
        ----------
        past : Matrix, shape (depth, size)
            Inputs before the time reached.
        u : Matrix, shape (rows, size)
            Inputs from there on.
        row : array of int, shape (n,)
            Rows of ``u`` at which the samples are reported.
        position : Matrix, shape (n, size)
            Sampling instants in communication steps after those rows.
        held : Mask, shape (size,)
            Elements with a zero-order hold.
        """
        if not self.depth:
            return u[row]
        known = np.concatenate((past, u))
        now = self.depth + row[:, np.newaxis]
        # after now the line of the last step goes on
        whole = np.minimum(np.floor(position), 0.0)
        before = now + whole.astype(np.int64)
        end = np.minimum(before + 1, now)
        at_point = known[before, self._column]
        elapsed = np.where(held, 0.0, position - whole)
        with np.errstate(over="ignore", invalid="ignore"):  # the master names what is not finite
            at_end = known[end, self._column]
            at_begin = known[end - 1, self._column]
            values: Matrix = at_point + elapsed * (at_end - at_begin)
        return values


def _check_timing(parameters: SensorParameters) -> None:
    delay = parameters.delay
    jitter = parameters.jitter
    period = parameters.period
    if period < 1:
        raise UsageError(f"period: found {period} communication steps, needed at least 1")
    if not 0.0 <= delay < np.inf:
        raise UsageError(f"delay: found {delay:g} communication steps, needed 0 or more")
    if not 0.0 <= jitter <= 0.5 * period:
        raise UsageError(
            f"jitter: found {steps_text(jitter)}, needed 0 to {0.5 * period:g}, half the "
            "distance of two samples: they keep their order"
        )
    if parameters.latest > 1.0:
        raise UsageError(
            f"jitter: found {steps_text(jitter)}, so that samples are taken up to "
            f"{parameters.latest:g} after they are reported, where the input is not known; needed "
            "at most 1: less jitter, or more delay"
        )


class MeasuringChain:
    """From the input at the sampling instant to what is measured: bias, noise, limits, levels.

    Parameters
    ----------
    parameters : SensorParameters
    size : int
        Number of elements.

    Raises
    ------
    UsageError
        If they are not possible.
    """

    def __init__(self, parameters: SensorParameters, size: int) -> None:
        lower = parameters.lower
        upper = parameters.upper
        self._bias = per_element("bias", parameters.bias, size)
        self._lower = np.full(size, -np.inf)
        self._upper = np.full(size, np.inf)
        if lower is not None:
            self._lower = per_element("lower", lower, size)
        if upper is not None:
            self._upper = per_element("upper", upper, size)
        self._check_limits()
        self._levels = self._quantizer(parameters, size)

    def _check_limits(self) -> None:
        wrong = np.flatnonzero(self._lower >= self._upper)
        if wrong.size:
            lower = self._lower[wrong[0]]
            upper = self._upper[wrong[0]]
            raise UsageError(f"found lower = {lower:g} and upper = {upper:g}, needed lower < upper")

    def _quantizer(self, parameters: SensorParameters, size: int) -> _Quantizer | None:
        if parameters.bits is None:
            if parameters.resolution is None:
                return None
            resolution = per_element("resolution", parameters.resolution, size)
            return _levels_of_resolution(resolution, self._lower, self._upper)
        if parameters.resolution is not None:
            raise UsageError("found resolution and bits, needed one of them")
        if parameters.lower is None or parameters.upper is None:
            raise UsageError("bits: needed lower and upper too, the range of the levels")
        return _levels_of_bits(parameters.bits, self._lower, self._upper)

    def values(self, values: Matrix, noise: Matrix) -> Matrix:
        """Return what is measured, shape (n, size)."""
        with np.errstate(over="ignore"):  # the master names what is not finite
            noisy = values + self._bias + noise
        limited = self._limited(noisy)
        if self._levels is None:
            return limited
        # a level is rounded, as the product of its number and the resolution: not beyond a limit
        return self._limited(self._levels.nearest(limited))

    def _limited(self, values: Matrix) -> Matrix:
        limited: Matrix = np.minimum(np.maximum(values, self._lower), self._upper)
        return limited


@dataclass(frozen=True, slots=True)
class _Quantizer:
    """Levels ``origin + i resolution``, i from first to last; each of shape (size,)."""

    origin: Vector
    resolution: Vector
    first: Vector
    last: Vector

    def nearest(self, values: Matrix) -> Matrix:
        """Return the nearest levels."""
        with np.errstate(over="ignore"):
            number = np.rint((values - self.origin) / self.resolution)
            level = self.origin + np.clip(number, self.first, self.last) * self.resolution
        # where doubles are farther apart than the levels, every value is a level
        return np.where(np.abs(number) < WHOLE_NUMBERS, level, values)


def _levels_of_bits(bits: int, lower: Vector, upper: Vector) -> _Quantizer:
    if not 1 <= bits <= MOST_BITS:
        raise UsageError(f"bits: found {bits}, needed 1 to {MOST_BITS}")
    intervals = np.full(len(lower), 2.0**bits - 1.0)
    with np.errstate(over="ignore"):
        resolution = (upper - lower) / intervals
    largest = np.maximum(np.abs(lower), np.abs(upper))
    if (resolution < np.spacing(largest)).any() or np.isinf(resolution).any():
        raise UsageError(
            f"bits: found {bits}, and there are not 2**{bits} doubles from lower to upper at equal "
            "distances; needed fewer bits, or other limits"
        )
    return _Quantizer(lower, resolution, np.zeros(len(lower)), intervals)


def _levels_of_resolution(resolution: Vector, lower: Vector, upper: Vector) -> _Quantizer:
    first = np.full(len(resolution), -np.inf)
    last = np.full(len(resolution), np.inf)
    for i, distance in enumerate(resolution.tolist()):
        if not distance > 0.0:
            raise UsageError(f"resolution: found {distance:g}, needed a positive number")
        if np.isfinite(lower[i]):
            first[i] = _number_of_level(math.ceil(_ratio(lower[i], distance)))
        if np.isfinite(upper[i]):
            last[i] = _number_of_level(math.floor(_ratio(upper[i], distance)))
        if not first[i] < last[i]:
            limits = f"{lower[i]:g} and {upper[i]:g}"
            raise UsageError(
                f"resolution: found {distance:g}, with fewer than two whole multiples between the "
                f"limits {limits}"
            )
    return _Quantizer(np.zeros(len(resolution)), resolution, first, last)


def _ratio(limit: float, distance: float) -> Fraction:
    """Return the ratio of the decimals: 0.3 is 3 times 0.1, which its double is not."""
    return Fraction(repr(float(limit))) / Fraction(repr(distance))


def _number_of_level(number: int) -> float:
    """Return it as a double; infinity where every double is a level."""
    if abs(number) < WHOLE_NUMBERS:
        return float(number)
    return math.copysign(np.inf, number)


@dataclass(frozen=True, slots=True)
class SampleNumbers:
    """The random numbers of n samples, each of shape (n, size).

    ``position`` is the sampling instant minus t, in communication steps.
    """

    position: Matrix
    noise: Matrix
    lost: Mask

    def rows(self, rows: slice) -> SampleNumbers:
        """Return those of some samples."""
        return SampleNumbers(self.position[rows], self.noise[rows], self.lost[rows])

    def then(self, more: SampleNumbers) -> SampleNumbers:
        """Return those of these samples and of more."""
        position = np.concatenate((self.position, more.position))
        noise = np.concatenate((self.noise, more.noise))
        lost = np.concatenate((self.lost, more.lost))
        return SampleNumbers(position, noise, lost)


@dataclass(frozen=True, slots=True)
class StreamState:
    """The numbers that were drawn, which of them is the next, and the states of the generators."""

    drawn: SampleNumbers
    next: int
    generators: tuple[Any, ...]


class SampleStreams:
    """The random numbers of a sensor's samples: a stream for each effect.

    Parameters
    ----------
    parameters : SensorParameters
    size : int
        Number of elements.

    Raises
    ------
    UsageError
        If they are not possible.
    """

    def __init__(self, parameters: SensorParameters, size: int) -> None:
        self._deviation = per_element("noise", parameters.noise, size)
        if (self._deviation < 0.0).any():
            smallest = self._deviation.min()
            raise UsageError(f"noise: found {smallest:g}, needed 0 or more, a standard deviation")
        self._dropout = 0.0 if parameters.dropout is None else parameters.dropout
        if not 0.0 <= self._dropout < 1.0:
            raise UsageError(
                f"dropout: found {self._dropout:g}, needed a probability of 0 or more, below 1"
            )
        self._parameters = parameters
        self._size = size
        self._is_noisy = bool(self._deviation.any())
        self._seed = self._checked_seed()
        self.begin()

    def _checked_seed(self) -> int:
        """Return the seed, 0 where nothing is random."""
        seed = self._parameters.seed
        if seed is None:
            if self._is_noisy or self._parameters.jitter or self._dropout:
                raise UsageError("seed: needed with noise, jitter or dropout, a whole number")
            return 0
        if seed < 0:
            raise UsageError(f"seed: found {seed}, needed 0 or more")
        return seed

    def begin(self) -> None:
        """Begin all streams; the first sample is not lost, as there is none to keep instead."""
        self._noise_words = self._generator(0)
        self._jitter_words = self._generator(1)
        self._dropout_words = self._generator(2)
        self._drawn = self._draw(1)
        self._drawn.lost[:] = False
        self._next = 0

    def _generator(self, spawn_key: int) -> np.random.PCG64:
        return np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=(spawn_key,)))

    def next(self, count: int) -> SampleNumbers:
        """Return the numbers of the next samples, again until they are skipped."""
        end = self._next + count
        missing = end - len(self._drawn.lost)
        if missing > 0:
            ahead = self._draw(max(missing, DRAWN_AHEAD // self._size))
            self._drawn = self._drawn.rows(slice(self._next, None)).then(ahead)
            self._next = 0
        return self._drawn.rows(slice(self._next, self._next + count))

    def skip(self, count: int) -> None:
        """Go on to the numbers after the next ``count`` samples, which were returned."""
        self._next += count

    def _draw(self, count: int) -> SampleNumbers:
        shape = (count, self._size)
        parameters = self._parameters
        position = np.full(shape, -parameters.delay)
        noise = np.zeros(shape)
        lost = np.zeros(shape, np.bool_)
        if parameters.jitter:
            within = 2.0 * _uniform(self._jitter_words, shape) - 1.0
            # rounding keeps the order of numbers: none is before earliest or after latest
            position = parameters.jitter * within + position
        if self._is_noisy:
            words = self._noise_words.random_raw(WORDS_PER_NORMAL * noise.size)
            noise = self._deviation * normal(words).reshape(shape)
        if self._dropout:
            lost = _uniform(self._dropout_words, shape) < self._dropout
        return SampleNumbers(position, noise, lost)

    def save(self) -> StreamState:
        """Copy the state."""
        states = tuple(generator.state for generator in self._generators)
        return StreamState(self._drawn, self._next, states)

    def restore(self, state: StreamState) -> None:
        """Go back to a saved state."""
        self._drawn = state.drawn
        self._next = state.next
        for generator, saved in zip(self._generators, state.generators, strict=True):
            generator.state = saved

    @property
    def _generators(self) -> tuple[np.random.PCG64, ...]:
        return (self._noise_words, self._jitter_words, self._dropout_words)


def _uniform(generator: np.random.PCG64, shape: tuple[int, int]) -> Matrix:
    """Return numbers of [0, 1), the 53 leading bits of a word each."""
    words: NDArray[np.uint64] = generator.random_raw(shape[0] * shape[1])
    leading = words >> np.uint64(11)
    return leading.astype(np.float64).reshape(shape) * 2.0**-53
