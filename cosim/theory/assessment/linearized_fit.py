"""A fit by output error as a linear regression near its minimum.

Its rows are the measured values, made white among outputs and in time. By it errors of the outputs
that are no noise (:mod:`cosim.theory.assessment.accuracy`) move theta and the linear unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.theory.assessment.accuracy import Accuracy, quantization_error
from cosim.theory.disturbed_plant import DataSet, NoiseModel, counted_values
from cosim.theory.fitted_response import FittedResponse

# of columns, scaled to length 1: what of a combination of them counts as dependent
DEPENDENT: Final = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearizedFit:
    """The regression of one data set.

    Its rows stand by sample and output, M = N n_y of them; those that do not count are 0.

    Parameters
    ----------
    counted : shape (N, n_y)
        Which values count.
    slopes : Matrix, shape (M, P)
        By theta.
    linear : Matrix, shape (M, L)
        By amplitudes, x(0) and offset.
    residual : Vector, shape (M,)
    errors : Matrix, shape (M, 2)
        Of the step and of quantization.
    inverse : Matrix, shape (L, M)
        Pseudo-inverse of ``linear``.
    """

    counted: NDArray[np.bool_]
    slopes: Matrix
    linear: Matrix
    residual: Vector
    errors: Matrix
    inverse: Matrix

    @property
    def free(self) -> Matrix:
        """What of the slopes the linear unknowns cannot take, shape (M, P)."""
        return self.slopes - self.linear @ (self.inverse @ self.slopes)

    def by_sample(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rows by sample and output, shape (N, n_y, ...)."""
        return rows.reshape(*self.counted.shape, *rows.shape[1:])


@dataclass(frozen=True, eq=False)
class ErrorBias:
    """By how much the errors of step and quantization move the unknowns.

    Parameters
    ----------
    theta : Matrix, shape (P, 2)
        0 where not estimated.
    linear : tuple of Matrix, shape (L, 2)
        Of each data set.
    """

    theta: Matrix
    linear: tuple[Matrix, ...]


def linearize_fit(
    data: DataSet, response: FittedResponse, accuracy: Accuracy, noise: NoiseModel
) -> LinearizedFit:
    """Make the regression of a data set from the response of its fit."""
    numbers = data.numbers
    quantized = quantization_error(data.y, response.residual, accuracy.spacing)
    errors = np.stack([accuracy.step, quantized], axis=2)
    residual = response.residual[:, :, np.newaxis]
    linear = whitened_rows(response.linear, numbers, noise)
    return LinearizedFit(
        counted=counted_values(numbers, noise.order),
        slopes=whitened_rows(response.slopes, numbers, noise),
        linear=linear,
        residual=whitened_rows(residual, numbers, noise)[:, 0],
        errors=whitened_rows(errors, numbers, noise),
        inverse=pseudo_inverse(linear),
    )


def pseudo_inverse(columns: Matrix) -> Matrix:
    """Return the pseudo-inverse of columns of any lengths; dependent ones share what they take."""
    lengths = _lengths(columns)
    inverse = np.linalg.pinv(columns / lengths, rcond=DEPENDENT)
    return np.asarray(inverse / lengths[:, np.newaxis], np.float64)


def whitened_rows(
    rows: NDArray[np.float64], numbers: NDArray[np.integer], noise: NoiseModel
) -> Matrix:
    """Return rows (N, n_y, k) made white, one behind the other, shape (N n_y, k)."""
    samples, outputs, columns = rows.shape
    return noise.whitened(rows, numbers).reshape(samples * outputs, columns)


def error_bias(fits: Sequence[LinearizedFit], estimated: Mask) -> ErrorBias:
    """Compute by how much errors move theta, the same for all data sets, and all other unknowns."""
    free = np.vstack([one.free[:, estimated] for one in fits])
    errors = np.vstack([one.errors for one in fits])
    lengths = _lengths(free)
    solved = np.linalg.lstsq(free / lengths, errors, rcond=DEPENDENT)[0] / lengths[:, np.newaxis]
    theta = np.zeros((len(estimated), errors.shape[1]))
    theta[estimated] = solved
    linear = tuple(one.inverse @ (one.errors - one.slopes @ theta) for one in fits)
    return ErrorBias(theta, linear)


def _lengths(columns: Matrix) -> Vector:
    lengths = np.linalg.norm(columns, axis=0)
    lengths[lengths == 0.0] = 1.0
    return np.asarray(lengths, np.float64)
