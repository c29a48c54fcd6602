"""What noise of delta hat does to sums of products of rows of the regression (25).

The rows M_r are sums of mu over blocks of samples (a block of one: mu itself), and mu is
``products(t) delta_hat(t - D)``, so that the noise n of delta hat enters them linearly,
``M_r = m_r + x_r``. An estimate near its expected root is

    delta theta_i = sum over r of (d_i' M_r) (g' M_r)  less its mean

with constants d and g of the estimator. Its **linear** part in n, with the weights

    L_i(s) = sum over j of (d_i' m) (q_j)(s + D_j) + (g' m) (p_ij)(s + D_j),

where p_ij and q_j are the sums of products of row j with d_i and g, has the covariance
``sum L_i(s) r(s - s') L_j(s')``, exactly. Its **quadratic** part, ``sum (d_i' x) (g' x)``, has by
Isserlis' theorem products of two autocovariances. There the products are taken as constant over a
block, or over a few samples where blocks are of one sample: they are as smooth as the alphas.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.native.numerics.householder import triangle
from cosim.theory.experiment_design.reconstruction_noise import ReconstructionNoise, fft_length

_COARSE_ROWS: Final = 256  # that the quadratic part is summed by
_CORRELATED: Final = 1e-3  # of the variance: less of it is left out of products of two


@dataclass(frozen=True, eq=False, kw_only=True)
class NoisyRegression:
    """Rows of the regression without noise, and the noise that comes to them.

    Parameters
    ----------
    products : Matrix, shape (q + 1, N)
        Products of the alphas at every sample, signs and weights included.
    row : array of int, shape (q + 1,)
        Which delay each term reads delta at.
    delta : Matrix, shape (l + 1, N)
        Reconstructed without noise, at every delay.
    steps : tuple of int
        The delays in samples.
    block : int
        Samples that are summed to one row of the regression; N is a multiple of it.
    noise : ReconstructionNoise
        Of delta hat.
    """

    products: Matrix
    row: NDArray[np.integer]
    delta: Matrix
    steps: tuple[int, ...]
    block: int
    noise: ReconstructionNoise

    @property
    def rows(self) -> int:
        """How many there are."""
        return self.samples // self.block

    @property
    def samples(self) -> int:
        """How many samples they are made of."""
        return int(self.products.shape[1])

    @cached_property
    def sums(self) -> Matrix:
        """The rows of the regression without noise, shape (q + 1, rows)."""
        return self._summed(self.products * self.delta[self.row])

    @cached_property
    def unit_noise(self) -> Matrix:
        """N of the Rayleigh quotient: covariance of the rows for noise that blocks take as one."""
        factors = self._summed(self.products)
        shares_row = self.row[:, np.newaxis] == self.row
        covariance: Matrix = (factors @ factors.T) * shares_row
        return covariance

    @cached_property
    def noise_moment(self) -> Matrix:
        """The expected ``sum x x'``, shape (q + 1, q + 1)."""
        steps = np.array(self.steps)
        delays = steps[self.row]
        apart = delays - delays[:, np.newaxis]
        if self.block == 1:
            products = self.products @ self.products.T
            return products * self.noise.covariance(apart)
        return self._moment_of_blocks(apart)

    @property
    def moment(self) -> Matrix:
        """The expected ``sum M M'``, shape (q + 1, q + 1)."""
        total: Matrix = self.sums @ self.sums.T + self.noise_moment
        return total

    @property
    def triangle(self) -> Matrix:
        """R with R'R the expected ``sum M M'``, also where that is singular to rounding."""
        values, vectors = np.linalg.eigh(self.noise_moment)
        of_noise = np.sqrt(np.maximum(values, 0.0)) * vectors
        return triangle(np.vstack([self.sums.T, of_noise.T]))

    def covariance(self, d: Matrix, g: Vector) -> Matrix:
        """Compute the covariance of ``sum over r of (d_i' M_r) (g' M_r)``, shape (P, P).

        Parameters
        ----------
        d : Matrix, shape (P, q + 1)
        g : Vector, shape (q + 1,)
        """
        q = self._by_delay(g[np.newaxis])[0]
        p = self._by_delay(d)
        return self._linear(d, g, p, q) + self._quadratic(p, q)

    # --- parts ---

    def _summed(self, samples: Matrix) -> Matrix:
        grouped = samples.reshape(len(samples), self.rows, self.block)
        summed: Matrix = grouped.sum(axis=2)
        return summed

    def _moment_of_blocks(self, apart: NDArray[np.integer]) -> Matrix:
        """Sum over blocks of the double sums of products of samples with r at their distance."""
        blocks = self.products.reshape(len(self.products), self.rows, self.block)
        length = fft_length(2 * self.block)
        spectra = np.fft.rfft(blocks, length, axis=2).transpose(2, 0, 1)
        crossed = spectra @ spectra.conj().transpose(0, 2, 1)  # frequency, term, term
        correlation = np.fft.irfft(crossed, length, axis=0)
        place = np.arange(length)
        # the correlation is circular: its end belongs to negative distances
        is_negative = place >= length - self.block
        distance = place - length * is_negative
        between = distance[:, np.newaxis, np.newaxis] + apart
        moment: Matrix = np.sum(correlation * self.noise.covariance(between), axis=0)
        return moment

    def _by_delay(self, combinations: Matrix) -> NDArray[np.float64]:
        """Sum the products of every delay with combinations (k, q + 1), shape (k, l + 1, N)."""
        sums = np.empty((len(combinations), len(self.steps), self.samples))
        for j in range(len(self.steps)):
            of_j = self.row == j
            sums[:, j] = combinations[:, of_j] @ self.products[of_j]
        return sums

    def _linear(self, d: Matrix, g: Vector, p: NDArray[np.float64], q: Matrix) -> Matrix:
        """Compute the covariance of the part that is linear in the noise."""
        rows_by_d = d @ self.sums
        rows_by_g = g @ self.sums
        of_d = np.repeat(rows_by_d, self.block, axis=1)
        of_g = np.repeat(rows_by_g, self.block)
        longest = max(self.steps)
        weights = np.zeros((len(d), self.samples + longest))  # of the samples of the noise
        for j, steps in enumerate(self.steps):
            begin = longest - steps
            end = begin + self.samples
            weights[:, begin:end] += of_d * q[j]
            weights[:, begin:end] += of_g * p[:, j]
        reach = len(self.noise.autocovariance)
        length = fft_length(weights.shape[1] + reach)
        spectra = np.fft.rfft(weights, length, axis=1)
        weighted = spectra * self.noise.spectrum(length)
        return _inner_products(weighted, spectra, length)

    def _quadratic(self, p: NDArray[np.float64], q: Matrix) -> Matrix:
        """Compute the covariance of the part that is quadratic in the noise."""
        pairs = list(combinations_with_replacement(range(len(self.steps)), 2))
        size = self.block
        if size == 1:
            size = max(1, self.samples // _COARSE_ROWS)
        signals = []
        for j, k in pairs:
            products = p[:, j] * q[k]
            if j != k:
                products = products + p[:, k] * q[j]
            signals.append(_means(products, size))
        of_pairs = np.stack(signals, axis=1)  # (P, pairs, rows)
        rows = of_pairs.shape[2]
        length = fft_length(2 * rows)
        spectra = np.fft.rfft(of_pairs, length, axis=2)
        total = np.zeros((len(p), len(p)))
        kernel = self._kernel_of_blocks if self.block > 1 else self._kernel_of_samples
        for (a, first), (b, second) in combinations_with_replacement(enumerate(pairs), 2):
            weights = kernel(first, second, size, rows)
            if weights is None:
                continue
            wrapped = np.zeros(length)
            wrapped[:rows] = weights[rows - 1 :]
            wrapped[length - rows + 1 :] = weights[: rows - 1]
            weighted = spectra[:, b] * np.fft.rfft(wrapped)
            part = _inner_products(spectra[:, a], weighted, length)
            total += part if a == b else part + part.T
        return total

    def _distances(self, first: tuple[int, int], second: tuple[int, int]) -> list[tuple[int, int]]:
        """Return how far the samples of two pairs are apart in rows that coincide, both ways."""
        j, k = (self.steps[row] for row in first)
        other_j, other_k = (self.steps[row] for row in second)
        return [(other_j - j, other_k - k), (other_k - j, other_j - k)]

    def _kernel_of_blocks(
        self, first: tuple[int, int], second: tuple[int, int], size: int, rows: int
    ) -> Vector | None:
        """Return the covariance of products of two sums, blocks ``-rows + 1 .. rows - 1`` apart."""
        blocks = np.arange(-rows + 1, rows)
        apart = size * blocks
        total = np.zeros(len(blocks))
        for distance, other in self._distances(first, second):
            of_distance = self._of_sums(apart + distance)
            of_other = self._of_sums(apart + other)
            total += of_distance * of_other
        return total

    def _of_sums(self, distance: NDArray[np.integer]) -> Vector:
        averaged = self._averaged
        apart = np.abs(distance)
        inside = apart < len(averaged)
        values: Vector = np.where(inside, averaged[np.where(inside, apart, 0)], 0.0)
        return values

    @cached_property
    def _averaged(self) -> Vector:
        return self.noise.averaged(self.block)

    @cached_property
    def _reach(self) -> int:
        """Samples over which products of two autocovariances count."""
        r = np.abs(self.noise.autocovariance)
        return 1 + int(np.flatnonzero(r > _CORRELATED * r[0])[-1])

    def _kernel_of_samples(
        self, first: tuple[int, int], second: tuple[int, int], size: int, rows: int
    ) -> Vector | None:
        """Return the covariance of sums of products of two samples, as that of blocks."""
        total = None
        for distance, other in self._distances(first, second):
            begin = max(-distance, -other) - self._reach
            end = min(-distance, -other) + self._reach
            if begin > end:
                continue
            middle = np.arange(begin, end + 1)
            of_distance = self.noise.covariance(middle + distance)
            values = of_distance * self.noise.covariance(middle + other)
            place = np.floor_divide(middle, size)
            fraction = middle / size - place
            binned = np.zeros(2 * rows + 1)
            for offset, share in ((0, 1.0 - fraction), (1, fraction)):
                at = place + offset + rows
                inside = (at >= 0) & (at < len(binned))
                binned += np.bincount(
                    at[inside], weights=(size * share * values)[inside], minlength=len(binned)
                )
            total = binned[1:-1] if total is None else total + binned[1:-1]
        return total


def _means(values: Matrix, size: int) -> Matrix:
    """Return the sums of ``size`` successive columns over size; the last ones may be fewer."""
    begins = np.arange(0, values.shape[1], size)
    means: Matrix = np.add.reduceat(values, begins, axis=1) / size
    return means


def _inner_products(
    spectra: NDArray[np.complex128], other: NDArray[np.complex128], length: int
) -> Matrix:
    """Return the sums over all samples of products of real signals, from their spectra."""
    twice = np.full(spectra.shape[1], 2.0)
    twice[0] = 1.0
    if length % 2 == 0:
        twice[-1] = 1.0
    products: Matrix = ((spectra * twice) @ other.conj().T).real / length
    return products
