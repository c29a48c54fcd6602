"""The Cramer-Rao bound of theta from y: what no unbiased estimator is better than.

Amplitudes, initial state and offset are unknown too, as for output error, which reaches the bound
(L. Ljung, System Identification, 2nd ed., 1999, section 7.4). The inputs of a linear plant are no
part of it: what they do to y is known, and is subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.assessment.record_information import (
    DEPENDENT,
    DETERMINED,
    RecordInformation,
    information_of,
)
from cosim.theory.disturbances.families import Family, generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, NoiseModel, sample_plant

_ABSENT: Final = 1e-10  # of y: a component that has less of it is rounding


@dataclass(frozen=True, eq=False)
class AccuracyBound:
    """The least covariance of theta.

    Parameters
    ----------
    covariance : Matrix, shape (P, P)
        Infinite on the diagonal where the data do not determine theta.
    residual : float
        Root mean square of what the model leaves of y, over that of y; of data without noise it is
        a model error.
    """

    covariance: Matrix
    residual: float

    @property
    def standard_error(self) -> Vector:
        """The least standard errors, shape (P,)."""
        return np.sqrt(np.diag(self.covariance))


def accuracy_bound(
    plant: DisturbedPlant,
    families: Sequence[Family],
    theta: Vector,
    data: DataSet,
    *,
    noise: Matrix,
    offset: bool = False,
) -> AccuracyBound:
    """Compute the Cramer-Rao bound of theta.

    Parameters
    ----------
    plant : DisturbedPlant
    families : sequence of Family
        Of the terms of the disturbance.
    theta : Vector, shape (P,)
        The true one.
    data : DataSet
        y without noise, by which the amplitudes are known.
    noise : Matrix, shape (n_y, n_y)
        Covariance of the white noise of y.
    offset : bool
        An unknown constant is on every output.

    Raises
    ------
    AssumptionError
        If the data do not fit the plant, or there are too many unknowns.
    """
    matrices = generators(families)
    white = NoiseModel(covariance=noise, a=np.zeros((len(noise), 0)))
    record = sample_plant(plant, matrices, data, noise=white, offset=offset).record(data)
    R = record.make(theta)
    linear = record.model.linear
    known = RecordInformation(np.zeros((len(R), 0)), R[:, :linear])
    unknowns = known.inverse @ R[:, -1]
    left = R[:, -1] - R[:, :linear] @ unknowns
    measured = np.nan_to_num(data.y)
    whole = white.whitened(measured[:, :, np.newaxis], data.numbers)
    size = float(np.linalg.norm(whole))
    amplitudes = unknowns[: matrices.order]
    for component in matrices.each:
        part = R[:, component.basis] @ amplitudes[component.basis]
        if float(np.linalg.norm(part)) <= _ABSENT * size:
            amplitudes[component.basis] = 0.0
    information = information_of(record, theta, amplitudes)
    relative = float(np.linalg.norm(left)) / size if size else 0.0
    return AccuracyBound(_covariance(information), relative)


def _covariance(information: RecordInformation) -> Matrix:
    """Return the covariance of theta for whitened noise of deviation 1."""
    free = information.free
    lengths = np.linalg.norm(free, axis=0)
    whole = np.linalg.norm(information.slopes, axis=0)
    places = np.flatnonzero(lengths > DEPENDENT * whole)
    scaled = free[:, places] / lengths[places]
    _, values, directions = np.linalg.svd(scaled, full_matrices=False)
    is_known = values > DEPENDENT * values.max(initial=0.0)
    known = directions[is_known] / values[is_known, np.newaxis]
    covariance = np.diag(np.full(len(lengths), np.inf))
    covariance[np.ix_(places, places)] = (
        known.T @ known / np.outer(lengths[places], lengths[places])
    )
    unknown = np.linalg.norm(directions[~is_known], axis=0) > DETERMINED
    covariance[places[unknown], places[unknown]] = np.inf
    return covariance
