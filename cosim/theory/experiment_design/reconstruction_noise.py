"""White noise of y as it reaches the reconstructed disturbance: stationary, but not white.

An observer is linear and does not change with time, so the noise of delta hat is the sum over the
outputs of ``response * noise``, and its autocovariance ``r(k) = sum of g(i) g(i + k)``, for
responses g that contain the deviations of the outputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError

# of the variance: what the samples of a response that are left out may have
_NEGLIGIBLE: Final = 1e-18


@dataclass(frozen=True, eq=False)
class ReconstructionNoise:
    """The noise of delta hat at the communication points.

    Parameters
    ----------
    response : Matrix, shape (M, n_y)
        Of delta hat to a unit sample of white noise of variance 1 in each output, its deviation
        included; where the noises of outputs are correlated, to each of independent ones.

    Raises
    ------
    AssumptionError
        If it is not finite.
    """

    response: Matrix

    def __post_init__(self) -> None:
        response = np.asarray(self.response, np.float64)
        if not np.isfinite(response).all():
            raise AssumptionError("the response of delta to noise of y is not finite")
        squares = np.sum(response**2, axis=1)
        from_the_end = np.cumsum(squares[::-1])
        left_out = from_the_end[::-1]
        counts = left_out > _NEGLIGIBLE * squares.sum()
        kept = max(int(counts.sum()), 1)
        object.__setattr__(self, "response", frozen(response[:kept], 2))

    @property
    def deviation(self) -> float:
        """Of one sample of delta hat."""
        return float(np.sqrt(self.autocovariance[0]))

    @cached_property
    def autocovariance(self) -> Vector:
        """``r(0), r(1), ...`` up to the last that is not zero, shape ``(M,)``."""
        M = len(self.response)
        length = fft_length(2 * M)
        spectrum = np.fft.rfft(self.response, length, axis=0)
        power = np.sum(np.abs(spectrum) ** 2, axis=1)
        circular = np.fft.irfft(power, length)
        return frozen(circular[:M], 1)

    def covariance(self, distance: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return ``r`` at distances in samples, of any sign and shape."""
        r = self.autocovariance
        apart = np.abs(distance)
        inside = apart < len(r)
        return np.where(inside, r[np.where(inside, apart, 0)], 0.0)

    def spectrum(self, length: int) -> Vector:
        """Return the discrete Fourier transform of r, of both signs, over ``length`` samples."""
        if length not in self._spectra:
            self._spectra[length] = self._spectrum(length)
        return self._spectra[length]

    @cached_property
    def _spectra(self) -> dict[int, Vector]:
        """The transforms that are known, by length."""
        return {}

    def _spectrum(self, length: int) -> Vector:
        distance = np.arange(length)
        wrapped = np.minimum(distance, length - distance)
        transformed: Vector = np.fft.rfft(self.covariance(wrapped)).real
        return transformed

    def averaged(self, count: int) -> Vector:
        """Return the autocovariance of sums of ``count`` successive samples, from 0 on."""
        r = self.autocovariance
        reach = np.arange(len(r) + count)
        triangle = count - np.abs(np.arange(-count + 1, count))
        around = np.arange(-count + 1, len(reach) + count - 1)
        values = self.covariance(around)
        summed: Vector = _convolved(values, triangle.astype(np.float64))
        return summed


def fft_length(least: int) -> int:
    """Return a length of at least so many samples that transforms are fast for, one of few."""
    power = 1 << max(0, least - 1).bit_length()
    shorter = 3 * power // 4
    return shorter if shorter >= least and power >= 4 else power


def _convolved(values: Vector, kernel: Vector) -> Vector:
    """Return the part of a convolution where the kernel lies within the values."""
    length = fft_length(len(values))
    of_values = np.fft.rfft(values, length)
    of_kernel = np.fft.rfft(kernel, length)
    circular = np.fft.irfft(of_values * of_kernel, length)
    within: Vector = circular[len(kernel) - 1 : len(values)]
    return within
