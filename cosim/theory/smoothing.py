"""States and disturbance over the whole record, from what a fit by output error found.

With theta, amplitudes and x(0) known, the model says what x and delta were at every sample, from
all samples before and after it: smoothing. Where the model is right, its error is to first order
that of all these unknowns together, from noise and from what step and quantization have moved them
by, and that of straight lines between samples in the states themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.accuracy import accuracy_of, quantization_error, step_error
from cosim.theory.consistency import MARGIN
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
from cosim.theory.fitted_response import disturbance_of, fitted_response
from cosim.theory.irregular_part import ResponseModel
from cosim.theory.quantiles import CONFIDENCE, student_two_sided
from cosim.theory.record_information import joint_covariance


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
    data: Sequence[DataSet],
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
        Number of the data set whose signals are wanted.
    data : sequence of DataSet
        All those of the fit.
    plant : DisturbedPlant
    families : sequence of Family
    noise : NoiseModel, optional
        As in the fit.

    Raises
    ------
    AssumptionError
        If the plant is unstable: its states cannot be simulated.
    """
    own = data[index]
    span = float(own.t[-1] - own.t[0])
    if needs_predictor(plant.A, span):
        raise AssumptionError(
            f"smoothing needs a stable plant: over {span:g} s a mode of this one grows too much "
            "for its states to be simulated"
        )
    noise = noise or white_noise(len(plant.C))
    n = len(plant.A)
    observed = _with_signals_as_outputs(plant)
    unmeasured = replace(own, y=np.zeros((len(own.t), n + 1)))
    model, known = _response(unmeasured, observed, families)
    p = np.concatenate([fit.theta, fit.amplitudes[index], fit.x0[index]])
    prediction = model(p)
    regressions = [_regression(fit, i, one, plant, families, noise) for i, one in enumerate(data)]
    own_regression = regressions[index]
    joint = joint_covariance(
        own_regression.inverse, own_regression.slopes, fit.covariance, fit.deviation
    )
    covariance = joint[: len(p), : len(p)]
    variance = np.einsum("nop,pq,noq->no", prediction.jacobian, covariance, prediction.jacobian)
    quantile = student_two_sided(CONFIDENCE, max(fit.freedom, 1.0))
    half_width = quantile * np.sqrt(np.maximum(variance, 0.0))
    matrices = generators(families)
    disturbance = disturbance_of(fit.theta, fit.amplitudes[index], own, matrices)
    moved = prediction.jacobian @ _moved(fit, regressions, index)[: len(p)]
    moved[:, :, 0] -= step_error(observed, unmeasured, disturbance)
    half_width += MARGIN * np.abs(moved).sum(axis=2)
    values = known + prediction.output
    return SmoothedSignals(
        t=own.t,
        states=values[:, :n],
        states_half_width=half_width[:, :n],
        disturbance=values[:, n],
        disturbance_half_width=half_width[:, n],
    )


def _with_signals_as_outputs(plant: DisturbedPlant) -> DisturbedPlant:
    """Return the plant with its states and the disturbance as outputs."""
    n, n_u = plant.B.shape
    components = plant.Bd.shape[1]
    return DisturbedPlant(
        A=plant.A,
        B=plant.B,
        Bd=plant.Bd,
        C=np.vstack([np.eye(n), np.zeros((1, n))]),
        D=np.zeros((n + 1, n_u)),
        Dd=np.vstack([np.zeros((n, components)), np.ones((1, components))]),
    )


def _response(
    data: DataSet, observed: DisturbedPlant, families: Sequence[Family]
) -> tuple[ResponseModel, Matrix]:
    """Return the response of a plant to the disturbance, and that to u."""
    noise = white_noise(len(observed.C))
    sampled = sample_plant(observed, generators(families), data, noise=noise)
    record = sampled.record(data)
    return ResponseModel(record), -record.residual


@dataclass(frozen=True, eq=False)
class _Regression:
    """A fit near its minimum, of one data set: measured values only, white.

    Parameters
    ----------
    slopes : Matrix, shape (M, P)
    inverse : Matrix, shape (L, M)
        Pseudo-inverse of the columns of the linear unknowns.
    free : Matrix, shape (M, P)
        What of the slopes the linear unknowns cannot take.
    errors : Matrix, shape (M, 2)
        Of the step and of quantization.
    """

    slopes: Matrix
    inverse: Matrix
    free: Matrix
    errors: Matrix


def _regression(
    fit: OutputErrorFit,
    index: int,
    data: DataSet,
    plant: DisturbedPlant,
    families: Sequence[Family],
    noise: NoiseModel,
) -> _Regression:
    matrices = generators(families)
    response = fitted_response(fit, index, data, plant, matrices)
    accuracy = accuracy_of(plant, data, response.disturbance)
    quantized = quantization_error(data.y, response.residual, accuracy.spacing)
    errors = np.stack([accuracy.step, quantized], axis=2)
    measured = data.measured

    def white(rows: NDArray[np.float64]) -> Matrix:
        return noise.whitened(rows, measured).reshape(-1, rows.shape[2])

    linear = white(response.linear)
    slopes = white(response.slopes)
    lengths = np.linalg.norm(linear, axis=0)
    lengths[lengths == 0.0] = 1.0
    inverse = np.linalg.pinv(linear / lengths, rcond=1e-12) / lengths[:, np.newaxis]
    free = slopes - linear @ (inverse @ slopes)
    return _Regression(slopes, inverse, free, white(errors))


def _moved(fit: OutputErrorFit, regressions: Sequence[_Regression], index: int) -> Matrix:
    """Compute by how much errors of step and quantization move the unknowns, shape (p, 2)."""
    gradient = sum(one.free.T @ one.errors for one in regressions)
    theta = fit.covariance @ gradient / fit.deviation**2
    own = regressions[index]
    linear = own.inverse @ (own.errors - own.slopes @ theta)
    return np.vstack([theta, linear])
