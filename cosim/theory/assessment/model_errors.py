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
CONSTANT: Final = "a constant on y"
DRIFT: Final = "a drift over the record on y"


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions of the outputs, shape (N, n_y, K), and the name of each."""

    columns: NDArray[np.float64]
    names: tuple[str, ...]


def model_errors(plant: DisturbedPlant, data: DataSet, response: FittedResponse) -> Directions:
    """Compute the directions for a fitted model."""
    signals = _signals(plant, data, response)
    changes = _alpha_changes(data, response.disturbance)
    parts = [
        _entering_states(plant, data, {**signals, **changes}),
        _at_outputs(plant, signals),
        _slow(data.t, plant.C.shape[0]),
    ]
    columns = np.concatenate([part.columns for part in parts], axis=2)
    names = sum((part.names for part in parts), ())
    return Directions(columns, names)


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
    names = []
    for o, unit in enumerate(np.eye(n_y)):
        of_output = f"[{o}]" if n_y > 1 else ""
        for name, signal in ((CONSTANT, np.ones(len(t))), (DRIFT, drift)):
            columns.append(outputs.respond(nothing, nothing, np.outer(signal, unit)))
            names.append(f"{name}{of_output}")
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
            names.append(f"{_term_name(float(rate), float(data.t[0]))} in {where}")
    return Directions(np.nan_to_num(np.stack(columns, axis=2)), tuple(names))


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


def _alpha_changes(data: DataSet, disturbance: Matrix) -> dict[str, Vector]:
    """Return what a time shift and another rate of every alpha change in the disturbance."""
    t = data.t
    if len(t) < 3:
        return {}
    is_large = np.abs(data.alpha) > 1e-9 * np.abs(data.alpha).max(axis=0, initial=0.0)
    f = np.divide(disturbance, data.alpha, out=np.zeros_like(disturbance), where=is_large)
    changes = {}
    for i, (alpha, factor) in enumerate(zip(data.alpha.T, f.T, strict=True)):
        shift = _slope_of(alpha, t) * factor
        changes[_shift_of(i)] = shift
        changes[_rate_in(i)] = shift * (t - t[0])
    return changes


def alpha_limits(data: DataSet) -> dict[str, float]:
    """Return at which size a change of an alpha, to first order, is as large as what varies of it.

    By how names in ``model_errors`` begin; an alpha that is constant has nothing to change.
    """
    limits = {}
    for i, alpha in enumerate(data.alpha.T):
        varying = float(np.std(alpha))
        shift = _slope_of(alpha, data.t)
        for name, change in ((_shift_of(i), shift), (_rate_in(i), shift * (data.t - data.t[0]))):
            size = float(np.sqrt(np.mean(change**2)))
            limits[name] = varying / size if size > 0.0 else 0.0
    return limits


def _slope_of(alpha: Vector, t: Vector) -> Vector:
    """Return the derivative; of a constant it is 0, which differences at unequal instants miss."""
    return np.asarray(np.gradient(alpha, t) if np.ptp(alpha) else np.zeros(len(t)), np.float64)


def _shift_of(i: int) -> str:
    return f"a shift of alpha {i + 1}"


def _rate_in(i: int) -> str:
    return f"another rate in alpha {i + 1}"


def _entering_states(
    plant: DisturbedPlant, data: DataSet, signals: dict[str, Vector]
) -> Directions:
    """Return the responses to each signal, entering at each state."""
    n_y, n = plant.C.shape
    outputs = forced_outputs(plant, data)
    held = {_input_name(j) for j, is_held in enumerate(data.is_held) if is_held}
    columns = np.zeros((len(data.t), n_y, n * len(signals)))
    nothing = np.zeros((len(data.t), n))
    names: list[str] = []
    for j, unit in enumerate(np.eye(n)):
        for name, signal in signals.items():
            entering = np.outer(signal, unit)
            parts = (nothing, entering) if name in held else (entering, nothing)
            columns[:, :, len(names)] = np.nan_to_num(outputs.respond(*parts))
            names.append(f"{name} in the dynamics of x_a[{j}]")
    return Directions(columns, tuple(names))


def _at_outputs(plant: DisturbedPlant, signals: dict[str, Vector]) -> Directions:
    """Return each signal as an error of each output."""
    forcing = np.stack(list(signals.values()), axis=1)
    n_y = plant.C.shape[0]
    N, K = forcing.shape
    columns = np.zeros((N, n_y, n_y * K))
    names = []
    for o in range(n_y):
        columns[:, o, o * K : (o + 1) * K] = forcing
        names += [f"{name} in y[{o}]" for name in signals]
    return Directions(columns, tuple(names))


def _slow(t: Vector, n_y: int) -> Directions:
    """Return cosines of some half periods over the record, on each output."""
    span = float(t[-1] - t[0])
    fraction = (t - t[0]) / span if span > 0.0 else np.zeros(len(t))
    halves = np.arange(1, SLOW_DIRECTIONS + 1)
    cosines = np.cos(np.pi * np.outer(fraction, halves))
    columns = np.zeros((len(t), n_y, n_y * SLOW_DIRECTIONS))
    names = []
    for o in range(n_y):
        columns[:, o, o * SLOW_DIRECTIONS : (o + 1) * SLOW_DIRECTIONS] = cosines
        for k in halves:
            period = 2.0 * span / k
            names.append(f"something of period {period:.3g} s in y[{o}]")
    return Directions(columns, tuple(names))
