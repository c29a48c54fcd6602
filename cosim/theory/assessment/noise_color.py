"""The color of the noise: an autoregressive model of all that a fit does not touch.

Whatever is fitted takes the noise along its directions away, and slow ones take it where slow noise
has its power: a model of what is left would be of less colored noise. Restricted maximum likelihood
(H. Patterson and R. Thompson, Biometrika, 1971) estimates it from all that the fitted columns do
not touch. Given a model, the expected lagged products of the noise are those of what generalized
least squares leave, and the variance of what they took (A. Dempster, N. Laird and D. Rubin, 1977):
a linear regression on them is a better model, and its misfit the slope of the likelihood.

Beside the columns of the fit those of a wrong model (``model_errors``) are fitted:
a wrong model must not pass for colored noise. The noise must be correlated over a small part of
the record only, for the rest cannot be told from such a model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.model_errors import SLOW_DIRECTIONS, model_errors
from cosim.theory.disturbed_plant import counted_values

LONGEST_AR: Final = 24
# Where slow directions take all power, a model says something as long as it resolves no less.
SAMPLES_A_COEFFICIENT: Final = 3 * SLOW_DIRECTIONS
# samples over which noise may be correlated, as a part of the record
LONGEST_CORRELATION: Final = 0.01
MOST_SAMPLES: Final = 6_000  # from the middle of a longer record: they tell the color
# times that at which a first model is given up: what is left of a wrong model, not noise
FAR_TOO_LONG: Final = 3.0
FIRST_STEPS: Final = 4  # of expectation and maximization, before the order is chosen
MOST_STEPS: Final = 20
SMALL_SLOPE: Final = 1e-2  # of the deviance, where a coefficient moves by one standard error
DIFFERENCE: Final = 0.05  # standard errors, for second derivatives
LEAST_INFORMATION: Final = 1e-3  # relative to that where nothing was fitted
# Of the power at low frequencies. With fewer the tests would pass nearly everything.
LEAST_FREEDOM: Final = 10.0
# part of the samples that gaps may cost a model of a high order
LEAST_WINDOWS: Final = 0.5
# of directions, relative to the largest: what of one may be left beside others
LEAST_REMAINDER: Final = 1e-6
ROUNDING: Final = 1e-10  # of lagged products
UNKNOWN_COLOR: Final = (
    "the model explains it but for the color of its noise, which no autoregressive model that "
    "these samples allow describes: the standard errors are not known"
)
SPECTRUM_POINTS: Final = 2**13
BLOCK: Final = 256  # of samples that are filtered together: they stay in the cache


class Criterion(StrEnum):
    """By what the order is chosen."""

    SCHWARZ = "Schwarz"  # few coefficients (1978)
    AKAIKE = "Akaike"  # as many as the whitest residual needs (1974)


@dataclass(frozen=True, eq=False)
class NoiseColor:
    """The noise of every output as an autoregressive model.

    Parameters
    ----------
    a : Matrix, shape (n_y, order)
    freedom : float
        Degrees of freedom of the variance at the lowest frequencies, as far as ``a`` is known.
    memory : float
        Samples over which the noise is correlated: the sum of its squared autocorrelations.
    samples : int
        Of the shortest record.
    """

    a: Matrix
    freedom: float
    memory: float
    samples: int

    @property
    def order(self) -> int:
        """The order of the models."""
        return int(self.a.shape[1])

    @property
    def remark(self) -> str:
        """Why the noise is no explanation, where too little of it is beside a wrong model."""
        longest = LONGEST_CORRELATION * self.samples
        if self.memory <= longest and self.freedom >= LEAST_FREEDOM:
            return ""
        length = f"about {self.memory:.0f}" if self.memory <= self.samples else "very many"
        return (
            f"noise that is correlated over {length} samples would leave that too, and "
            f"{self.samples} samples are too few to tell such noise from a wrong model: a longer "
            "record would"
        )


def noise_color(fitted: FittedModel, criterion: Criterion) -> NoiseColor:
    """Estimate the color of each output's noise beside all that is fitted and may be wrong."""
    problem = fitted.problem
    columns = []
    for data, response in zip(problem.data, fitted.responses, strict=True):
        directions = model_errors(problem.plant, data, response).columns
        slopes = response.slopes[:, :, fitted.fit.estimated]
        columns.append(np.concatenate([slopes, response.linear, directions], axis=2))
    models = []
    for o in range(problem.outputs):
        records = []
        for data, response, X in zip(problem.data, fitted.responses, columns, strict=True):
            records.append(_record(data.numbers[:, o], response.residual[:, o], X[:, o]))
        models.append(autoregression(records, criterion))
    order = max(len(model.a) for model in models)
    return NoiseColor(
        a=np.array([np.pad(model.a, (0, order - len(model.a))) for model in models]),
        freedom=min(model.freedom for model in models),
        memory=max(correlation_length(model.a) for model in models),
        samples=min(data.samples for data in problem.data),
    )


def _record(numbers: NDArray[np.integer], residual: Vector, columns: Matrix) -> ColoredRecord:
    """Return the values of an output by their numbers, and nothing in the places between."""
    there = np.flatnonzero(numbers >= 0)
    places = numbers[there]
    if places[-1] >= MOST_SAMPLES:  # a pause must not be all of the middle
        places = np.cumsum(np.minimum(np.diff(places, prepend=0), LONGEST_AR + 1))
    length = min(int(places[-1]) + 1, MOST_SAMPLES)
    places = places - (int(places[-1]) + 1 - length) // 2
    is_kept = (places >= 0) & (places < length)
    there, places = there[is_kept], places[is_kept]
    measured = np.zeros(length, np.bool_)
    measured[places] = True
    of_samples = np.zeros(length)
    of_samples[places] = residual[there]
    own = np.zeros((length, columns.shape[1]))
    own[places] = columns[there]
    return ColoredRecord(of_samples, own, measured)


def correlation_length(a: Vector) -> float:
    """Return the sum of squared autocorrelations over all lags; infinite where it is unstable."""
    if not len(a):
        return 1.0
    if float(np.abs(np.roots(np.concatenate([[1.0], -a]))).max()) >= 1.0:
        return np.inf
    power, weights = _spectrum(a)
    return float(np.average(power**2, weights=weights))


def largest_power(a: Vector) -> float:
    """Return the largest power of a stable model at a frequency, over its mean."""
    return float(_spectrum(a)[0].max())


def _spectrum(a: Vector) -> tuple[Vector, Vector]:
    """Return the power of a model over frequency, of mean 1, and the weights of that mean."""
    response = np.fft.rfft(np.concatenate([[1.0], -a]), 2 * SPECTRUM_POINTS)
    power = 1.0 / np.abs(response) ** 2
    weights = np.ones(len(power))
    weights[[0, -1]] = 0.5  # both ends are there once, all others twice
    return power / float(np.average(power, weights=weights)), weights


@dataclass(frozen=True, eq=False)
class ColoredRecord:
    """Samples of colored noise, of which a fit took its share.

    Parameters
    ----------
    residual : Vector, shape (N,)
    columns : Matrix, shape (N, K)
        Of the fit.
    measured : Mask, shape (N,)
    """

    residual: Vector
    columns: Matrix
    measured: Mask

    @property
    def independent(self) -> ColoredRecord:
        """Return the same with orthonormal columns; dependent ones are left out."""
        columns = self.columns * self.measured[:, np.newaxis]
        lengths = np.linalg.norm(columns, axis=0)
        scaled = columns / np.where(lengths > 0.0, lengths, 1.0)
        left, values, _ = np.linalg.svd(scaled, full_matrices=False)
        kept = values > LEAST_REMAINDER * values.max(initial=0.0)
        return ColoredRecord(self.residual, left[:, kept], self.measured)

    def behind_zeros(self, order: int) -> _WindowedRecord:
        """Return the same as if there had been nothing in ``order`` samples before.

        Otherwise a column that decays as the noise does would not count at all.
        """
        before = ((order, 0),)
        padded = ColoredRecord(
            np.pad(self.residual, before),
            np.pad(self.columns, (*before, (0, 0))),
            np.pad(self.measured, before, constant_values=True),
        )
        windows = np.flatnonzero(padded.windows(order))
        return _WindowedRecord(padded.residual, padded.columns, windows)

    def windows(self, order: int) -> Mask:
        """Return which samples are measured, with ``order`` others before them, shape (N,)."""
        numbers = np.where(self.measured, np.arange(len(self.measured)), -1)
        return counted_values(numbers[:, np.newaxis], order)[:, 0]


@dataclass(frozen=True, eq=False)
class _WindowedRecord:
    """A record behind zeros.

    Parameters
    ----------
    residual : Vector, shape (N,)
    columns : Matrix, shape (N, K)
    windows : array of int
        The last sample of each window of a model's order.
    """

    residual: Vector
    columns: Matrix
    windows: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class AutoregressiveModel:
    """An autoregressive model, and the degrees of freedom of its power at low frequencies."""

    a: Vector
    freedom: float


def autoregression(records: Sequence[ColoredRecord], criterion: Criterion) -> AutoregressiveModel:
    """Estimate an autoregressive model of noise by restricted maximum likelihood.

    Parameters
    ----------
    records : sequence of ColoredRecord
    criterion : Criterion
        None may be the best model.
    """
    longest = _longest(records)
    records = [record.independent for record in records]
    a = np.zeros(longest)
    behind_zeros = [record.behind_zeros(longest) for record in records]
    for _ in range(FIRST_STEPS):
        a = _expected(behind_zeros, a).coefficients(longest)
    products = _expected(behind_zeros, a)
    order = _best_order(products, criterion)
    if not order:
        return AutoregressiveModel(np.zeros(0), np.inf)
    start = products.coefficients(order)
    shortest = min(len(record.residual) for record in records)
    if correlation_length(start) > FAR_TOO_LONG * LONGEST_CORRELATION * shortest:
        return AutoregressiveModel(start, np.inf)
    behind_zeros = [record.behind_zeros(order) for record in records]
    a = _most_likely(behind_zeros, start)
    return AutoregressiveModel(a, _freedom(behind_zeros, a))


def _most_likely(records: Sequence[_WindowedRecord], start: Vector) -> Vector:
    """Return the coefficients of the greatest restricted likelihood near a start."""
    from scipy.optimize import minimize  # takes long to import

    scale = _expected(records, start).scale

    def at(z: Vector) -> tuple[float, Vector]:
        a = start + scale @ z
        here = _expected(records, a)
        return here.deviance, scale.T @ here.slope(a)

    options = {"gtol": SMALL_SLOPE, "maxiter": MOST_STEPS}
    result = minimize(at, np.zeros(len(start)), jac=True, method="BFGS", options=options)
    return np.asarray(start + scale @ result.x, np.float64)


def _freedom(records: Sequence[_WindowedRecord], a: Vector) -> float:
    """Return the degrees of freedom that a chi-square as uncertain as the power at 0 has.

    By the observed information, half the second derivatives of the deviance.
    """
    order = len(a)
    scale = _expected(records, a).scale
    information = np.empty((order, order))
    for j in range(order):
        ends = []
        for sign in (1.0, -1.0):
            moved = a + sign * DIFFERENCE * scale[:, j]
            ends.append(scale.T @ _expected(records, moved).slope(moved))
        information[j] = (ends[0] - ends[1]) / (4.0 * DIFFERENCE)
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    direction = vectors.T @ scale.sum(axis=0)
    variance = float(np.sum(direction**2 / np.maximum(values, LEAST_INFORMATION)))
    return float((1.0 - a.sum()) ** 2 / (2.0 * variance))


def _longest(records: Sequence[ColoredRecord]) -> int:
    """Return the highest order for which enough samples have that many others before them."""
    shortest = min(int(record.measured.sum()) for record in records)
    total = sum(int(record.measured.sum()) for record in records)
    longest = min(LONGEST_AR, shortest // SAMPLES_A_COEFFICIENT)
    while longest > 0:
        whole = sum(int(record.windows(longest).sum()) for record in records)
        if whole >= LEAST_WINDOWS * total:
            break
        longest -= 1
    return longest


@dataclass(frozen=True, eq=False)
class _Products:
    """Expected lagged products of the noise, shape (order + 1, order + 1).

    Parameters
    ----------
    whole : Matrix
    variance : float
        Of the white noise.
    count : int
        Of windows.
    deviance : float
        Twice the restricted likelihood's negative logarithm, up to a constant.
    """

    whole: Matrix
    variance: float
    count: int
    deviance: float

    def coefficients(self, order: int) -> Vector:
        """Return those of the best model of an order, shape (order,)."""
        own = slice(1, order + 1)
        return np.asarray(np.linalg.solve(self.whole[own, own], self.whole[own, 0]), np.float64)

    def variance_of(self, order: int) -> float:
        """Return the variance that a model of an order leaves."""
        explained = float(self.coefficients(order) @ self.whole[1 : order + 1, 0])
        return (float(self.whole[0, 0]) - explained) / self.count

    @property
    def scale(self) -> Matrix:
        """A root of the covariance of the coefficients if nothing had been fitted."""
        values, vectors = np.linalg.eigh(self.whole[1:, 1:] / self.variance)
        return np.asarray(vectors / np.sqrt(np.maximum(values, ROUNDING * values[-1])), np.float64)

    def slope(self, a: Vector) -> Vector:
        """Return the derivatives of the deviance by the coefficients ``a`` of these products."""
        misfit: Vector = self.whole[1:, 0] - self.whole[1:, 1:] @ a
        return -2.0 * misfit / self.variance


def _best_order(products: _Products, criterion: Criterion) -> int:
    count = products.count
    price = np.log(count) if criterion is Criterion.SCHWARZ else 2.0
    values = []
    for order in range(len(products.whole)):
        variance = products.variance_of(order)
        if not variance > 0.0:
            break
        values.append(count * np.log(variance) + price * order)
    return int(np.argmin(values)) if values else 0


def _expected(records: Sequence[_WindowedRecord], a: Vector) -> _Products:
    """Return the expected products of the noise under a model, of all windows of its order."""
    order = len(a)
    of_rest = np.zeros((order + 1, order + 1))
    of_columns = np.zeros((order + 1, order + 1))
    squares = determinant = 0.0
    freedom = count = 0
    for record in records:
        windows = record.windows
        white_columns = _filtered(record.columns, a, windows)
        values, vectors = np.linalg.eigh(white_columns.T @ white_columns)
        values = np.maximum(values, ROUNDING)
        basis = vectors / np.sqrt(values)
        white = _filtered(record.residual[:, np.newaxis], a, windows)[:, 0]
        taken = basis.T @ (white_columns.T @ white)
        rest = record.residual - record.columns @ (basis @ taken)
        squares += float(white @ white - taken @ taken)
        determinant += float(np.log(values).sum())
        count += len(windows)
        freedom += len(windows) - len(values)
        of_rest += _lagged_products(rest[:, np.newaxis], windows, order)
        of_columns += _lagged_products(record.columns @ basis, windows, order)
    # what has no noise is predicted but for its rounding
    least = max(ROUNDING * float(of_rest[0, 0]), np.finfo(np.float64).tiny)
    squares = max(squares, least)
    variance = squares / max(freedom, 1)
    whole = of_rest + variance * of_columns + least * np.eye(order + 1)
    return _Products(whole, variance, count, freedom * float(np.log(squares)) + determinant)


def _filtered(rows: Matrix, a: Vector, windows: NDArray[np.intp]) -> Matrix:
    result = rows[windows]
    used = np.flatnonzero(a) + 1
    for first in range(0, len(windows), BLOCK):
        part = result[first : first + BLOCK]
        ends = windows[first : first + BLOCK]
        is_run = ends[-1] - ends[0] == len(ends) - 1
        for k in used:
            before = slice(ends[0] - k, ends[-1] - k + 1) if is_run else ends - k
            part -= a[k - 1] * rows[before]
    return result


def _lagged_products(rows: Matrix, windows: NDArray[np.intp], order: int) -> Matrix:
    """Return the sums of ``rows(k - i) rows(k - j)`` over windows k and columns."""
    ends_here = np.zeros(len(rows), np.bool_)
    ends_here[windows] = True
    ahead = rows
    if rows[~ends_here].any():
        ahead = rows * ends_here[:, np.newaxis]
    by_lag = _correlations(ahead, rows, order)
    # One sample earlier each run of windows gains one in front, and loses its last.
    edges = np.diff(np.concatenate([[0], ends_here.astype(np.int8), [0]]))
    gained = _edge_products(rows, np.flatnonzero(edges == 1), order)
    lost = _edge_products(rows, np.flatnonzero(edges == -1), order)
    products = np.empty((order + 1, order + 1))
    for lag in range(order + 1):
        changes = np.diagonal(gained - lost, lag)[1:]
        diagonal = by_lag[lag] + np.concatenate([[0.0], np.cumsum(changes)])
        places = np.arange(order + 1 - lag)
        products[places, places + lag] = diagonal
        products[places + lag, places] = diagonal
    return products


def _correlations(ahead: Matrix, behind: Matrix, order: int) -> Vector:
    """Return the sums of ``ahead(k) behind(k - lag)`` over k and columns, shape (order + 1,)."""
    length = 1 << int(len(ahead) + order).bit_length()
    spectrum_ahead = np.fft.rfft(ahead, length, axis=0)
    is_same = behind is ahead
    spectrum_behind = spectrum_ahead if is_same else np.fft.rfft(behind, length, axis=0)
    spectra = spectrum_ahead * spectrum_behind.conj()
    correlations: Vector = np.fft.irfft(spectra.sum(axis=1), length)
    return correlations[: order + 1]


def _edge_products(rows: Matrix, places: NDArray[np.intp], order: int) -> Matrix:
    """Return the sums of ``rows(k - i) rows(k - j)`` over some k and columns; of i = 0 nothing."""
    padded = np.concatenate([rows, np.zeros((1, rows.shape[1]))])
    before = padded[places[:, np.newaxis] - np.arange(order + 1)]
    before[:, 0] = 0.0
    flat = before.transpose(1, 0, 2).reshape(order + 1, -1)
    products: Matrix = flat @ flat.T
    return products
