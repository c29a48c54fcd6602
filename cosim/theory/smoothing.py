"""States and disturbance over the whole record, from what a fit by output error found.

With theta, amplitudes and x(0) known, the model says what x and delta were at every sample, from
all samples before and after it: smoothing. Its error comes from the errors of all these unknowns
together, and to first order from nothing else, where the model is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.consistency import autoregressive_filter
from cosim.theory.disturbance import Family, generators
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    needs_predictor,
    sample_plant,
    white_noise,
)
from cosim.theory.estimators.output_error import OutputErrorFit
from cosim.theory.fitted_response import fitted_response
from cosim.theory.irregular_part import ResponseModel
from cosim.theory.quantiles import student_above

BAND: Final = 0.95  # probability of the truth within the band, at any one instant


@dataclass(frozen=True, eq=False, kw_only=True)
class SmoothedSignals:
    """States and disturbance at the samples of a data set, and the half widths of their bands.

    Parameters
    ----------
    t : Vector, shape (N,)
    states, states_half_width : Matrix, shape (N, n)
    disturbance, disturbance_half_width : Vector, shape (N,)
        The sum of all components.
    """

    t: Vector
    states: Matrix
    states_half_width: Matrix
    disturbance: Vector
    disturbance_half_width: Vector


def smoothed_signals(
    fit: OutputErrorFit,
    index: int,
    data: DataSet,
    plant: DisturbedPlant,
    families: Sequence[Family],
    *,
    noise: NoiseModel | None = None,
) -> SmoothedSignals:
    """Compute states and disturbance with their 95 % bands, which hold at any one instant.

    Parameters
    ----------
    fit : OutputErrorFit
    index : int
        Number of the data set among those of the fit.
    data : DataSet
        That one.
    plant : DisturbedPlant
    families : sequence of Family
    noise : NoiseModel, optional
        As in the fit.

    Raises
    ------
    AssumptionError
        If the plant is unstable: its states cannot be simulated.
    """
    span = float(data.t[-1] - data.t[0])
    if needs_predictor(plant.A, span):
        raise AssumptionError(
            f"smoothing needs a stable plant: over {span:g} s a mode of this one grows too much "
            "for its states to be simulated"
        )
    noise = noise or white_noise(len(plant.C))
    n = len(plant.A)
    observed, known = _observed(data, plant, families)
    p = np.concatenate([fit.theta, fit.amplitudes[index], fit.x0[index]])
    prediction = observed(p)
    covariance = _covariance(fit, index, data, plant, families, noise)[: len(p), : len(p)]
    variance = np.einsum("nop,pq,noq->no", prediction.jacobian, covariance, prediction.jacobian)
    quantile = student_above(0.5 * (1.0 - BAND), max(fit.freedom, 1.0))
    half_width = quantile * np.sqrt(np.maximum(variance, 0.0))
    values = known + prediction.output
    return SmoothedSignals(
        t=data.t,
        states=values[:, :n],
        states_half_width=half_width[:, :n],
        disturbance=values[:, n],
        disturbance_half_width=half_width[:, n],
    )


def _observed(
    data: DataSet, plant: DisturbedPlant, families: Sequence[Family]
) -> tuple[ResponseModel, Matrix]:
    """Return the model with x and delta as outputs, and the part of them that u makes."""
    n, n_u = plant.B.shape
    components = plant.Bd.shape[1]
    observed = DisturbedPlant(
        A=plant.A,
        B=plant.B,
        Bd=plant.Bd,
        C=np.vstack([np.eye(n), np.zeros((1, n))]),
        D=np.zeros((n + 1, n_u)),
        Dd=np.vstack([np.zeros((n, components)), np.ones((1, components))]),
    )
    nothing = np.zeros((len(data.t), n + 1))
    unknown = DataSet(data.t, nothing, data.u, data.alpha, data.held)
    sampled = sample_plant(observed, generators(families), unknown, noise=white_noise(n + 1))
    record = sampled.record(unknown)
    return ResponseModel(record), -record.residual


def _covariance(
    fit: OutputErrorFit,
    index: int,
    data: DataSet,
    plant: DisturbedPlant,
    families: Sequence[Family],
    noise: NoiseModel,
) -> Matrix:
    """Compute the covariance of theta, amplitudes, x(0) and offset of a data set.

    Of theta it is that of the fit, to which other data sets contribute. For a given theta the
    others have an error of their own, uncorrelated with that of theta, which moves them along.
    """
    response = fitted_response(fit, index, data, plant, generators(families))
    measured = data.measured
    linear = _columns(autoregressive_filter(response.linear[measured], noise.a))
    slopes = _columns(autoregressive_filter(response.slopes[measured], noise.a))
    lengths = np.linalg.norm(linear, axis=0)
    lengths[lengths == 0.0] = 1.0
    inverse = np.linalg.pinv(linear / lengths, rcond=1e-12) / lengths[:, np.newaxis]
    moved = -inverse @ slopes
    own = fit.deviation**2 * (inverse @ inverse.T)
    cross = moved @ fit.covariance
    return np.block([[fit.covariance, cross.T], [cross, own + cross @ moved.T]])


def _columns(rows: Matrix) -> Matrix:
    return rows.reshape(-1, rows.shape[2])
