"""Verdicts on good data of plants drawn at random: there is no false alarm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import Exponential, Sine
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.forced_response import simulate

STOP = 30.0  # s
THETA = (-0.15, 1.3)
FAMILIES = (Exponential(), Sine())


@dataclass(frozen=True)
class Case:
    """An experiment, as it was drawn."""

    plant: DisturbedPlant
    families: tuple
    theta: np.ndarray
    data: DataSet


def alphas(t, count):
    """Return the known factors."""
    both = [1.35 + 0.25 * np.sin(1.7 * t), 1.1 + 0.2 * np.cos(2.3 * t)]
    return np.stack(both[:count], axis=1)


def drawn_plant(rng, components):
    """Return a stable plant of up to three states, two inputs and two outputs."""
    n, n_u, n_y = (int(rng.integers(1, most)) for most in (4, 3, 3))
    A = rng.standard_normal((n, n))
    A -= (np.linalg.eigvals(A).real.max() + rng.uniform(0.1, 1.5)) * np.eye(n)
    return DisturbedPlant(
        A=A,
        B=rng.standard_normal((n, n_u)),
        Bd=np.repeat(rng.standard_normal((n, 1)), components, axis=1),
        C=rng.standard_normal((n_y, n)),
        D=rng.standard_normal((n_y, n_u)) * rng.integers(0, 2),
        Dd=np.zeros((n_y, components)),
    )


def drawn_inputs(rng, t, n_u, every):
    """Return smooth inputs, and some that are held from one sample to the next."""
    held = rng.random(n_u) < 0.4
    rates = rng.uniform(0.3, 3.0, n_u)
    u = np.sin(np.outer(t, rates)) + 0.3 * np.cos(np.outer(t, 1.7 * rates))
    levels = rng.standard_normal((len(t) // (7 * every) + 1, n_u))
    u[:, held] = levels[np.arange(len(t)) // (7 * every)][:, held]
    return u, held


def drawn(seed):
    """Return an experiment: its solution has the same lines, or is sixteen times as fine.

    Noise is from nothing to 1 % of an output; a quarter of the sensors have twelve bits.
    """
    rng = np.random.default_rng(seed)
    chosen = ((0,), (1,), (0, 1))[seed % 3]
    families = tuple(FAMILIES[i] for i in chosen)
    theta = np.array([THETA[i] for i in chosen])
    plant = drawn_plant(rng, len(chosen))
    every = int(rng.choice([1, 16]))
    h = 10.0 ** rng.uniform(-2.3, -1.5) / every
    t = np.arange(int(STOP / h / every) * every + 1) * h
    u, held = drawn_inputs(rng, t, plant.B.shape[1], every)
    functions = (np.exp(THETA[0] * t), np.sin(THETA[1] * t + 0.4))
    delta = alphas(t, len(chosen)) * np.stack([functions[i] for i in chosen], axis=1)
    inputs = np.hstack([plant.B, plant.Bd])
    mask = np.concatenate([held, np.zeros(len(chosen), np.bool_)])
    x0 = rng.standard_normal(len(plant.A))
    x = simulate(plant.A, inputs, t, np.hstack([u, delta]), x0, mask)
    y = (x @ plant.C.T + u @ plant.D.T)[::every]
    sizes = y.std(axis=0)
    y += rng.choice([0.0, 1e-6, 1e-4, 1e-3, 1e-2]) * sizes * rng.standard_normal(y.shape)
    if rng.random() < 0.25:
        levels = 8.0 * sizes / 4096
        y = levels * np.round(y / levels)
    t = t[::every]
    data = DataSet(t, y, u[::every], alphas(t, len(chosen)), held)
    return Case(plant, families, theta, data)


def outcome(seed):
    """Return whether there is a false alarm, and how many intervals miss."""
    case = drawn(seed)
    found = assess(OutputErrorProblem([case.data], case.plant, case.families), 1.1 * case.theta)
    verdicts = [parameter.verdict for parameter in found.parameters]
    if found.consistency.step_too_long or Verdict.INCONSISTENT in verdicts:
        return not found.consistency.step_too_long, 0
    missed = 0
    for parameter, true in zip(found.parameters, case.theta, strict=True):
        if parameter.lower is not None:
            missed += not parameter.lower <= true <= parameter.upper
    return False, missed


@pytest.mark.parametrize("seed", range(6))
def test_good_data_of_a_plant_are_consistent(seed):
    """Whatever its size, its inputs, its noise and its sensor; and the intervals hold."""
    assert outcome(seed) == (False, 0)


@pytest.mark.campaign
def test_good_data_of_any_plant_are_rarely_inconsistent():
    """At most 5 false alarms in 1 000 plants."""
    results = np.array([outcome(1000 + seed) for seed in range(1000)])
    alarms, missed = results.sum(axis=0)
    print(f"{alarms} of 1000 inconsistent, {missed} intervals missed")
    assert alarms <= 5
