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

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.assessment.accuracy import accuracy_of, step_error
from cosim.theory.assessment.consistency import MARGIN
from cosim.theory.assessment.linearized_fit import LinearizedFit, error_bias, linearize_fit
from cosim.theory.assessment.record_information import joint_covariance
from cosim.theory.bounded.irregular_part import ResponseModel
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
from cosim.theory.quantiles import CONFIDENCE, student_two_sided


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
    fits = [_linearized(fit, i, one, plant, families, noise) for i, one in enumerate(data)]
    linearized = fits[index]
    joint = joint_covariance(linearized.inverse, linearized.slopes, fit.covariance, fit.deviation)
    covariance = joint[: len(p), : len(p)]
    variance = np.einsum("nop,pq,noq->no", prediction.jacobian, covariance, prediction.jacobian)
    quantile = student_two_sided(CONFIDENCE, max(fit.freedom, 1.0))
    half_width = quantile * np.sqrt(np.maximum(variance, 0.0))
    matrices = generators(families)
    disturbance = disturbance_of(fit.theta, fit.amplitudes[index], own, matrices)
    bias = error_bias(fits, fit.estimated)
    moved = prediction.jacobian @ np.vstack([bias.theta, bias.linear[index]])[: len(p)]
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


def _linearized(
    fit: OutputErrorFit,
    index: int,
    data: DataSet,
    plant: DisturbedPlant,
    families: Sequence[Family],
    noise: NoiseModel,
) -> LinearizedFit:
    response = fitted_response(fit, index, data, plant, generators(families))
    accuracy = accuracy_of(plant, data, response.disturbance)
    return linearize_fit(data, response, accuracy, noise)
