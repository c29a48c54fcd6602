"""The spectrum of a residual against that of white noise.

The ordinates of the periodogram of white Gaussian noise, over their mean, are independent, each
half a chi-square of two degrees of freedom (M. Priestley, Spectral Analysis and Time Series, 1981,
section 6.1.3). Means of neighbors scatter less; here they are taken over bands that are equally
wide on a logarithmic axis of frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.quantiles import CONFIDENCE, chi_square_limits

BANDS: Final = 60


@dataclass(frozen=True, eq=False)
class WhitenessSpectrum:
    """Means of a periodogram over bands of frequency, in multiples of the level of white noise.

    Parameters
    ----------
    frequency : Vector, shape (bands,)
        Means of the frequencies in each band [Hz].
    power : Matrix, shape (bands, n_y)
        Of white noise the mean is 1.
    lower, upper : Vector, shape (bands,)
        Limits within which 95 % of the means are for white noise.
    """

    frequency: Vector
    power: Matrix
    lower: Vector
    upper: Vector


def whiteness_spectrum(residual: Matrix, h: float) -> WhitenessSpectrum:
    """Compute the periodogram of a residual.

    Parameters
    ----------
    residual : Matrix, shape (N, n_y)
        Every sample measured.
    h : float
        Mean distance of two samples [s].

    Raises
    ------
    AssumptionError
        If there are too few samples for a spectrum.
    """
    N = len(residual)
    count = (N - 1) // 2  # without the ends: the mean, and half the sampling frequency
    if count < 1:
        raise AssumptionError(f"{N} samples; a spectrum needs at least 3")
    ordinates = np.abs(np.fft.rfft(residual, axis=0)[1 : 1 + count]) ** 2
    level = ordinates.mean(axis=0)
    frequencies = np.arange(1, 1 + count) / (N * h)
    first = _bands(count)
    members = np.diff(first, append=count)
    power = np.add.reduceat(ordinates, first, axis=0) / members[:, np.newaxis]
    frequency = np.add.reduceat(frequencies, first) / members
    degrees = 2.0 * members
    lower, upper = chi_square_limits(CONFIDENCE, degrees)
    return WhitenessSpectrum(
        frequency,
        power / np.where(level > 0.0, level, 1.0),
        lower=lower / degrees,
        upper=upper / degrees,
    )


def _bands(count: int) -> NDArray[np.int64]:
    """Return the first ordinate of each band; no band has fewer than one of lower frequency."""
    edges = np.floor(np.geomspace(1.0, count + 1.0, BANDS + 1))
    ends = np.unique(edges.astype(np.int64))
    members = np.maximum.accumulate(np.diff(ends))
    first = np.concatenate([[0], np.cumsum(members)])
    is_whole = first[1:] <= count  # the last one takes the rest
    whole: NDArray[np.int64] = first[:-1][is_whole]
    return whole
