"""Predicting an unstable plant loses nothing: the fit is that of the simulated outputs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares

from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import fit_output_error

A = np.array([[0.5, 0.3], [0.0, -1.0]])
BD = np.ones((2, 1))
C = np.array([[1.0, 0.5], [0.4, -0.7]])
RATE = -0.3
SIGMA = 0.02
X0 = np.array([-0.9, -0.9])
MODES, VECTORS = np.linalg.eig(A)
TO_MODES = np.linalg.inv(VECTORS)


def alpha(t):
    return 1.3 + 0.4 * np.sin(1.7 * t)


def simulate(t, outputs, theta):
    """Return y by amplitude, x(0) and offset, shape (N, outputs, 3 + outputs).

    For straight lines between samples, by closed forms of the modes.
    """
    elapsed = t - t[0]
    forcing = alpha(t) * np.exp(theta * elapsed)
    h = np.diff(t)
    X = np.zeros((len(t), 2, 3))
    for i, mode in enumerate(MODES):
        growth = np.exp(mode * h)
        constant = (growth - 1.0) / mode
        end = (constant - h) / (mode * h)
        entering = (constant - end) * forcing[:-1] + end * forcing[1:]
        steps = zip(growth.tolist(), entering.tolist(), strict=True)
        forced = itertools.accumulate(steps, lambda x, step: step[0] * x + step[1], initial=0.0)
        X[:, i, 0] = (TO_MODES @ BD)[i] * list(forced)
        X[:, i, 1:] = np.outer(np.exp(mode * elapsed), TO_MODES[i])
    y = C[:outputs] @ VECTORS @ X
    constant = np.tile(np.eye(outputs), (len(t), 1, 1))
    return np.concatenate([y, constant], axis=2)


def instants(kind, rng):
    t = np.arange(401) * 0.05
    if kind == "at unequal distances":
        t = t + rng.uniform(0.0, 0.03, len(t))
    if kind == "lost":
        t = t[rng.random(len(t)) > 0.2]
    return t


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("kind", ["all", "missing", "one by one", "lost", "at unequal distances"])
def test_a_fit_is_that_of_least_squares_of_the_simulated_outputs(kind, outputs):
    """Theta, its error, the deviation and the linear unknowns, against a solver of its own.

    Growth by 2e4 leaves 12 digits to the simulation. The deviation of the innovations is above that
    of the noise by the mode of the plant, 1.025, where nothing turns them back.
    """
    rng = np.random.default_rng(3)
    t = instants(kind, rng)
    truth = np.array([1.0, *X0, 0.3, -0.2])[: 3 + outputs]
    y = simulate(t, outputs, RATE) @ truth
    y = y + SIGMA * rng.standard_normal(y.shape)
    if kind == "missing":
        y[rng.random(len(t)) < 0.2] = np.nan
    if kind == "one by one":
        y[rng.random(y.shape) < 0.2] = np.nan
    measured = np.isfinite(y)

    def split(theta):
        columns = simulate(t, outputs, theta)[measured]
        unit = np.linalg.norm(columns, axis=0)
        unknowns = np.linalg.lstsq(columns / unit, y[measured])[0] / unit
        return columns, unknowns

    def residual(theta):
        columns, unknowns = split(theta[0])
        return y[measured] - columns @ unknowns

    found = least_squares(residual, [RATE], xtol=1e-12, ftol=1e-15, gtol=1e-15, diff_step=1e-5)
    columns, unknowns = split(found.x[0])
    step = 1e-5
    slope = simulate(t, outputs, found.x[0] + step) - simulate(t, outputs, found.x[0] - step)
    slope = (slope[measured] @ unknowns) / (2.0 * step)
    unit = np.linalg.norm(columns, axis=0)
    beside = slope - columns @ (np.linalg.lstsq(columns / unit, slope)[0] / unit)
    freedom = measured.sum() - len(unknowns) - 1
    deviation = np.linalg.norm(found.fun) / np.sqrt(freedom)
    error = deviation / np.linalg.norm(beside)

    plant = DisturbedPlant(
        A=A,
        B=np.zeros((2, 0)),
        Bd=BD,
        C=C[:outputs],
        D=np.zeros((outputs, 0)),
        Dd=np.zeros((outputs, 1)),
    )
    data = DataSet(t, y, np.zeros((len(t), 0)), alpha(t)[:, np.newaxis])
    fit = fit_output_error([data], plant, [Exponential()], np.array([-0.32]), offset=True)
    assert fit.freedom == freedom
    assert fit.theta[0] == pytest.approx(found.x[0], abs=1e-3 * error)
    assert fit.standard_error[0] == pytest.approx(error, rel=1e-3)
    assert fit.deviation == pytest.approx(deviation, rel=1e-5)
    linear = np.concatenate([fit.amplitudes[0], fit.x0[0], fit.offset[0]])
    np.testing.assert_allclose(linear, unknowns, rtol=1e-3)
