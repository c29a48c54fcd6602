"""What a fit by output error says at every sample: residual, derivatives, disturbance, states."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.output_error import Generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorFit
from cosim.theory.forced_response import simulate

TAYLOR_TERMS = 14  # of a norm of a half the rest is below 0.5^15 / 15! = 3e-17
LARGEST_STATE = 1e6  # over the output: of an unstable plant, whose simulation says nothing


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedResponse:
    """The response of a fitted model to the data set it was fitted to.

    Parameters
    ----------
    residual : Matrix, shape (N, n_y)
        Of the outputs; NaN: not measured.
    slopes : shape (N, n_y, P)
        Its derivatives by theta, with the other sign.
    linear : shape (N, n_y, L)
        By amplitudes, initial state and offset.
    disturbance : Matrix, shape (N, components)
        ``alpha_i f_i``.
    states : Matrix, shape (N, n)
        Simulated from the fitted initial state; no columns where the plant is unstable.
    """

    residual: Matrix
    slopes: NDArray[np.float64]
    linear: NDArray[np.float64]
    disturbance: Matrix
    states: Matrix

    def at(self, rows: NDArray[np.intp]) -> FittedResponse:
        """Return it at some of the samples."""
        return FittedResponse(
            residual=self.residual[rows],
            slopes=self.slopes[rows],
            linear=self.linear[rows],
            disturbance=self.disturbance[rows],
            states=self.states[rows],
        )


def fitted_response(
    fit: OutputErrorFit,
    index: int,
    data: DataSet,
    plant: DisturbedPlant,
    generators: Generators,
) -> FittedResponse:
    """Compute the response of a fit to its data set number ``index``."""
    record = fit.records[index]
    rows = record.rows(fit.theta)
    amplitudes = fit.amplitudes[index]
    unknowns = np.concatenate([amplitudes, fit.x0[index], fit.offset[index]])
    count = len(unknowns)
    linear = rows[:, :, :count]
    residual = rows[:, :, -1] - linear @ unknowns
    slopes = slopes_of(rows[:, :, count:-1], amplitudes, generators)
    disturbance = disturbance_of(fit.theta, amplitudes, data, generators)
    forcing = np.hstack([data.u, disturbance])
    inputs = np.hstack([plant.B, plant.Bd])
    held = np.zeros(forcing.shape[1], np.bool_)
    held[: data.u.shape[1]] = data.is_held
    states = simulate(plant.A, inputs, data.t, forcing, fit.x0[index], held)
    largest = LARGEST_STATE * float(np.nanmax(np.abs(data.y)))
    if not np.abs(states).max(initial=0.0) <= largest:
        states = np.zeros((len(data.t), 0))
    return FittedResponse(
        residual=residual,
        slopes=slopes,
        linear=linear,
        disturbance=disturbance,
        states=states,
    )


def disturbance_of(
    theta: Vector, amplitudes: Vector, data: DataSet, generators: Generators
) -> Matrix:
    """Compute ``alpha_i c_i' expm(G_i t) beta_i`` at every sample, t from the first one.

    Parameters
    ----------
    theta : Vector, shape (P,)
    amplitudes : Vector, shape (order,)
        All beta_i, one behind the other.
    data : DataSet
    generators : Generators

    Returns
    -------
    Matrix
        Shape ``(N, components)``.
    """
    t = data.t - data.t[0]
    values = np.empty((len(t), len(generators.size)))
    for i, component in enumerate(generators.each):
        c = component.c
        G = component.matrix(theta[component.theta])
        beta = amplitudes[component.basis]
        if len(G) == 1:
            f = c[0] * beta[0] * np.exp(G[0, 0] * t)
        else:
            f = np.einsum("a,nab,b->n", c, transitions(G, t), beta)
        values[:, i] = data.alpha[:, i] * f
    return values


def transitions(G: Matrix, t: Vector) -> NDArray[np.float64]:
    """Compute ``expm(G t)`` at many instants at once, shape (N, V, V).

    By scaling, a Taylor series and squaring: scipy takes the instants one by one.
    """
    largest = float(np.abs(G).sum(axis=1).max() * np.abs(t).max(initial=0.0))
    squarings = max(0, math.frexp(2.0 * largest)[1])  # so that the norm is at most a half
    scaled = G * np.ldexp(t, -squarings)[:, np.newaxis, np.newaxis]
    term = scaled
    result = np.eye(len(G)) + scaled
    for k in range(2, TAYLOR_TERMS + 1):
        term = term @ scaled / k
        result += term
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result, np.float64)


def slopes_of(
    derivatives: NDArray[np.float64], amplitudes: Vector, generators: Generators
) -> NDArray[np.float64]:
    """Multiply derivatives of the basis by theta with amplitudes.

    Parameters
    ----------
    derivatives : shape (..., columns)
        Of every function of the basis by every parameter of its component.
    amplitudes : Vector, shape (order,)
        All beta_i, one behind the other.
    generators : Generators

    Returns
    -------
    shape (..., P)
    """
    slopes = np.empty((*derivatives.shape[:-1], generators.parameters))
    column = parameter = 0
    for component in generators.each:
        beta = amplitudes[component.basis]
        for _ in component.G1:
            slopes[..., parameter] = derivatives[..., column : column + len(beta)] @ beta
            column += len(beta)
            parameter += 1
    return slopes
