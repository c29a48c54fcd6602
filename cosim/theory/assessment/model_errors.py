"""Directions in which the output moves if the model is wrong.

To first order the output of a plant with an error in A, B or Bd moves by the response to the
states, to the inputs, to the disturbance, each entering at one state; with an error in C, D or the
gain of a sensor by these signals themselves. A constant disturbance, and one whose alphas are
shifted or stretched in time, are inputs at the same places. What none of these describe leaves
something slow: cosines over the record.

An input that depends on y carries its noise, which shows along it as a wrong model would: of a
closed loop the directions are those of signals without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.fitted_response import FittedResponse
from cosim.theory.forced_response import forced_outputs, simulate

SLOW_DIRECTIONS: Final = 30


@dataclass(frozen=True)
class ModelError:
    """An error of a model.

    Parameters
    ----------
    name : str
    limit : float
        The size at which, to first order, a change is as large as what it changes.
    is_on_output : bool
        It is no error of the plant or the disturbance.
    is_constant : bool
        A constant on an output, which may be an unknown.
    """

    name: str
    limit: float = np.inf
    is_on_output: bool = False
    is_constant: bool = False


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions of the outputs, shape (N, n_y, K), and the error of the model behind each."""

    columns: NDArray[np.float64]
    errors: tuple[ModelError, ...]


def model_errors(plant: DisturbedPlant, data: DataSet, response: FittedResponse) -> Directions:
    """Compute the directions for a fitted model."""
    signals = _signals(plant, data, response)
    changes, limits = _alpha_changes(data, response.disturbance)
    parts = [
        _entering_states(plant, data, {**signals, **changes}, limits),
        _at_outputs(plant, signals),
        _slow(data.t, plant.C.shape[0]),
    ]
    columns = np.concatenate([part.columns for part in parts], axis=2)
    return Directions(columns, sum((part.errors for part in parts), ()))


def missing_parts(plant: DisturbedPlant, data: DataSet, rates: Vector) -> Directions:
    """Compute what parts that a model lacks leave: constants and drifts on y, terms of delta.

    A drift is 1 at the last sample. The terms are decaying exponentials, 1 at the first sample, and
    a constant; each where the disturbances of the model enter.

    Parameters
    ----------
    plant : DisturbedPlant
    data : DataSet
    rates : Vector
        Of the exponentials [1/s]; 0: a constant.
    """
    t = data.t - data.t[0]
    drift = t / t[-1] if t[-1] > 0.0 else t
    n_y, n = plant.C.shape
    outputs = forced_outputs(plant, data)
    nothing = np.zeros((len(t), n))
    columns = []
    errors = []
    for o, unit in enumerate(np.eye(n_y)):
        output = f"y[{o}]" if n_y > 1 else "y"
        columns.append(outputs.respond(nothing, nothing, np.outer(np.ones(len(t)), unit)))
        errors.append(ModelError(f"a constant on {output}", is_on_output=True, is_constant=True))
        columns.append(outputs.respond(nothing, nothing, np.outer(drift, unit)))
        errors.append(ModelError(f"a drift over the record on {output}", is_on_output=True))
    entries = np.unique(np.vstack([plant.Bd, plant.Dd]), axis=1).T
    for entry in entries:
        where = "delta"
        if len(entries) > 1:
            same = (np.vstack([plant.Bd, plant.Dd]) == entry[:, np.newaxis]).all(axis=0)
            where = f"the delta of terms[{int(same.argmax())}]"
        for rate in rates:
            term = np.exp(-rate * t)
            forced = np.outer(term, entry[:n])
            columns.append(outputs.respond(forced, nothing, np.outer(term, entry[n:])))
            errors.append(ModelError(f"{_term_name(float(rate), float(data.t[0]))} in {where}"))
    return Directions(np.nan_to_num(np.stack(columns, axis=2)), tuple(errors))


def _term_name(rate: float, t_1: float) -> str:
    if rate == 0.0:
        return "a constant"
    time = f"(t - {t_1:g})" if t_1 else "t"
    return f"a further exp(-{rate:.2g} {time})"


def _signals(plant: DisturbedPlant, data: DataSet, response: FittedResponse) -> dict[str, Vector]:
    """Return what a wrong entry of a matrix multiplies, by its name in a report."""
    states = _states_outside_feedback(plant, data, response)
    signals = {f"x_a[{i}]": column for i, column in enumerate(states.T)}
    for j in np.flatnonzero(~data.is_in_feedback).tolist():
        signals[_input_name(j)] = data.u[:, j]
    signals["delta"] = response.disturbance.sum(axis=1)
    signals["a constant"] = np.ones(len(data.t))
    return signals


def _states_outside_feedback(
    plant: DisturbedPlant, data: DataSet, response: FittedResponse
) -> Matrix:
    """Return the states, of a closed loop without what the inputs in feedback make of them."""
    if not data.is_in_feedback.any() or not response.states.shape[1]:
        return response.states
    u = np.where(data.is_in_feedback, 0.0, data.u)
    forcing = np.hstack([u, response.disturbance])
    held = np.zeros(forcing.shape[1], np.bool_)
    held[: u.shape[1]] = data.is_held
    inputs = np.hstack([plant.B, plant.Bd])
    return simulate(plant.A, inputs, data.t, forcing, np.zeros(len(plant.A)), held)


def _input_name(j: int) -> str:
    return f"u[{j}]"


def _alpha_changes(
    data: DataSet, disturbance: Matrix
) -> tuple[dict[str, Vector], dict[str, float]]:
    """Return what a time shift and another rate of every alpha change in the disturbance.

    And at which size either, to first order, is as large as what varies of that alpha: one that is
    constant has nothing to change.
    """
    t = data.t
    if len(t) < 3:
        return {}, {}
    is_large = np.abs(data.alpha) > 1e-9 * np.abs(data.alpha).max(axis=0, initial=0.0)
    f = np.divide(disturbance, data.alpha, out=np.zeros_like(disturbance), where=is_large)
    changes = {}
    limits = {}
    for i, (alpha, factor) in enumerate(zip(data.alpha.T, f.T, strict=True), start=1):
        varying = float(np.std(alpha))
        slope = _slope_of(alpha, t)
        shift = slope * factor
        for name, change, effect in (
            (f"a shift of alpha {i}", slope, shift),
            (f"another rate in alpha {i}", slope * (t - t[0]), shift * (t - t[0])),
        ):
            size = float(np.sqrt(np.mean(change**2)))
            limits[name] = varying / size if size > 0.0 else 0.0
            changes[name] = effect
    return changes, limits


def _slope_of(alpha: Vector, t: Vector) -> Vector:
    """Return the derivative; of a constant it is 0, which differences at unequal instants miss."""
    return np.asarray(np.gradient(alpha, t) if np.ptp(alpha) else np.zeros(len(t)), np.float64)


def _entering_states(
    plant: DisturbedPlant, data: DataSet, signals: dict[str, Vector], limits: dict[str, float]
) -> Directions:
    """Return the responses to each signal, entering at each state."""
    n_y, n = plant.C.shape
    outputs = forced_outputs(plant, data)
    held = {_input_name(j) for j, is_held in enumerate(data.is_held) if is_held}
    columns = np.zeros((len(data.t), n_y, n * len(signals)))
    nothing = np.zeros((len(data.t), n))
    errors: list[ModelError] = []
    for j, unit in enumerate(np.eye(n)):
        for name, signal in signals.items():
            entering = np.outer(signal, unit)
            parts = (nothing, entering) if name in held else (entering, nothing)
            columns[:, :, len(errors)] = np.nan_to_num(outputs.respond(*parts))
            limit = limits.get(name, np.inf)
            errors.append(ModelError(f"{name} in the dynamics of x_a[{j}]", limit))
    return Directions(columns, tuple(errors))


def _at_outputs(plant: DisturbedPlant, signals: dict[str, Vector]) -> Directions:
    """Return each signal as an error of each output."""
    forcing = np.stack(list(signals.values()), axis=1)
    n_y = plant.C.shape[0]
    N, K = forcing.shape
    columns = np.zeros((N, n_y, n_y * K))
    errors = []
    for o in range(n_y):
        columns[:, o, o * K : (o + 1) * K] = forcing
        errors += [ModelError(f"{name} in y[{o}]") for name in signals]
    return Directions(columns, tuple(errors))


def _slow(t: Vector, n_y: int) -> Directions:
    """Return cosines of some half periods over the record, on each output."""
    span = float(t[-1] - t[0])
    fraction = (t - t[0]) / span if span > 0.0 else np.zeros(len(t))
    halves = np.arange(1, SLOW_DIRECTIONS + 1)
    cosines = np.cos(np.pi * np.outer(fraction, halves))
    columns = np.zeros((len(t), n_y, n_y * SLOW_DIRECTIONS))
    errors = []
    for o in range(n_y):
        columns[:, o, o * SLOW_DIRECTIONS : (o + 1) * SLOW_DIRECTIONS] = cosines
        for k in halves:
            period = 2.0 * span / k
            errors.append(ModelError(f"something of period {period:.3g} s in y[{o}]"))
    return Directions(columns, tuple(errors))
