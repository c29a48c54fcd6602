"""States and disturbance over the whole record, from what a fit by output error found.

With theta, amplitudes and x(0) known, the model says what x and delta were at every sample, from
all samples before and after it: smoothing. Where the model is right, its error is to first order
that of all these unknowns together, from noise and from what step and quantization have moved them
by, and that of straight lines between samples in the states themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.output_error import Generators
from cosim.theory.assessment.accuracy import step_error
from cosim.theory.assessment.consistency import MARGIN
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.linearized_fit import error_bias
from cosim.theory.assessment.record_information import joint_covariance
from cosim.theory.bounded.irregular_part import ResponseModel
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    needs_predictor,
    sample_plant,
    white_noise,
)


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


def smoothed_signals(fitted: FittedModel, index: int = 0) -> SmoothedSignals:
    """Compute states and disturbance with their 95 % bands, which hold at any one instant.

    Parameters
    ----------
    fitted : FittedModel
    index : int
        Number of the data set whose signals are wanted.

    Raises
    ------
    AssumptionError
        If the plant is unstable: its states cannot be simulated.
    """
    fit = fitted.fit
    problem = fitted.problem
    plant = problem.plant
    own = problem.data[index]
    span = float(own.t[-1] - own.t[0])
    if needs_predictor(plant.A, span):
        raise AssumptionError(
            f"smoothing needs a stable plant: over {span:g} s a mode of this one grows too much "
            "for its states to be simulated"
        )
    n = len(plant.A)
    observed = _with_signals_as_outputs(plant)
    unmeasured = replace(own, y=np.zeros((len(own.t), n + 1)))
    model, known = _response(unmeasured, observed, problem.generators)
    p = np.concatenate([fit.theta, fit.amplitudes[index], fit.x0[index]])
    prediction = model(p)
    linearized = fitted.linearized[index]
    joint = joint_covariance(linearized.inverse, linearized.slopes, fit.covariance, fit.deviation)
    covariance = joint[: len(p), : len(p)]
    variance = np.einsum("nop,pq,noq->no", prediction.jacobian, covariance, prediction.jacobian)
    half_width = fitted.quantile * np.sqrt(np.maximum(variance, 0.0))
    disturbance = fitted.responses[index].disturbance
    bias = error_bias(fitted.linearized, fit.estimated)
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
    data: DataSet, observed: DisturbedPlant, matrices: Generators
) -> tuple[ResponseModel, Matrix]:
    """Return the response of a plant to the disturbance, and that to u."""
    noise = white_noise(len(observed.C))
    sampled = sample_plant(observed, matrices, data, noise=noise)
    record = sampled.record(data)
    return ResponseModel(record), -record.residual
