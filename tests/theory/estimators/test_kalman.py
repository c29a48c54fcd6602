"""The Kalman filters against filters written down as in the books, with covariances and numpy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from cosim.native.numerics.linear import first_order_hold
from cosim.theory.disturbances.families import Exponential, SearchBox, Sine
from cosim.theory.disturbed_plant import DisturbedPlant, disturbed_plant
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha, delta
from tests.theory.estimators.passes import augmented_kalman, extended_kalman, smoothed_disturbance

H = 1e-2
ALPHAS = ("1.35 + 0.25*sin(1.7*t)", "1.1 + 0.2*cos(2.3*t)")
TWO_OUTPUTS = DisturbedPlant(
    A=np.array([[-1.0, 1.0], [-1.0, -2.0]]),
    B=np.array([[-1.0], [1.0]]),
    Bd=np.array([[1.0, 1.0], [0.5, 0.5]]),
    C=np.array([[1.0, 0.0], [0.3, 1.0]]),
    D=np.array([[-1.0], [0.5]]),
    Dd=np.array([[0.0, 0.0], [0.2, 0.2]]),
)


def plant() -> DisturbedPlant:
    return disturbed_plant(reduce(academic()), [0, 0])


def simulate(model, t, disturbance, *, sigma=0.0, seed=0):
    """Return y and u for straight lines between samples, with noise."""
    u = np.sin(t)[:, np.newaxis]
    inputs = np.hstack([model.B, model.Bd[:, :1]])
    discrete = first_order_hold(model.A, inputs, H, np.zeros(2, np.bool_))
    forced = np.hstack([u, disturbance[:, np.newaxis]])
    x = np.array([1.0, -1.0])
    y = np.empty((len(t), len(model.C)))
    for k in range(len(t)):
        if k:
            x = discrete.Ad @ x + discrete.B0 @ forced[k - 1] + discrete.B1 @ forced[k]
        y[k] = model.C @ x + model.D @ u[k] + model.Dd[:, 0] * disturbance[k]
    return y + sigma * np.random.default_rng(seed).standard_normal(y.shape), u


@pytest.mark.parametrize("model", [plant(), TWO_OUTPUTS], ids=["one output", "two outputs"])
def test_smoothing_is_that_of_rauch_tung_and_striebel(model):
    """The kernel's adjoint recursion on square roots is the textbook's on covariances."""
    t = np.arange(301) * H
    y, u = simulate(model, t, delta(t), sigma=1e-2)
    deviation, size, intensity = 2e-2, 3.0, 5.0
    n = 4
    A = np.zeros((n, n))
    A[:2, :2] = model.A
    A[:2, 2] = model.Bd[:, 0]
    A[2, 3] = 1.0
    B = np.vstack([model.B, np.zeros((2, 1))])
    discrete = first_order_hold(A, B, H, np.zeros(1, np.bool_))
    Q = np.zeros((n, n))
    Q[2:, 2:] = intensity * np.array([[H**3 / 3, H**2 / 2], [H**2 / 2, H]])
    C = np.hstack([model.C, model.Dd[:, :1], np.zeros((len(model.C), 1))])
    R = deviation**2 * np.eye(len(C))
    x = np.zeros(n)
    P = size**2 * np.eye(n)
    predicted = []
    filtered = []
    for k in range(len(t)):
        if k:
            x = discrete.Ad @ x + discrete.B0 @ u[k - 1] + discrete.B1 @ u[k]
            P = discrete.Ad @ P @ discrete.Ad.T + Q
        predicted.append((x, P))
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        x = x + K @ (y[k] - model.D @ u[k] - C @ x)
        P = P - K @ C @ P
        filtered.append((x, P))
    smoothed = [filtered[-1][0]]
    for k in range(len(t) - 2, -1, -1):
        G = filtered[k][1] @ discrete.Ad.T @ np.linalg.inv(predicted[k + 1][1])
        smoothed.append(filtered[k][0] + G @ (smoothed[-1] - predicted[k + 1][0]))
    expected = np.array(smoothed)[::-1, 2]
    found = smoothed_disturbance(
        t, y, u, model, deviation=deviation, size=size, intensity=intensity
    )
    # the textbook's covariances lose half of the digits that the square roots keep
    np.testing.assert_allclose(found, expected, atol=1e-7)


@cache
def discretized_with_components():
    inputs = np.hstack([TWO_OUTPUTS.B, TWO_OUTPUTS.Bd])
    return first_order_hold(TWO_OUTPUTS.A, inputs, H, np.zeros(3, np.bool_))


def transition(family_of, state, u0, u1, alpha0, alpha1):
    """Move x, beta and theta over a step, as the plant does."""
    orders = [family.v for family in family_of]
    x = state[:2]
    discrete = discretized_with_components()
    order = sum(orders)
    beta = state[2 : 2 + order]
    theta = state[2 + order :]
    before = [u0[0]]
    after = [u1[0]]
    moved = []
    column = 0
    for i, family in enumerate(family_of):
        part = beta[column : column + family.v]
        G = family.G(theta[i : i + 1])
        exponential = np.eye(family.v)
        term = np.eye(family.v)
        for k in range(1, 12):
            term = term @ (G * H) / k
            exponential = exponential + term
        moved.append(exponential @ part)
        before.append(alpha0[i] * (family.c @ part))
        after.append(alpha1[i] * (family.c @ moved[-1]))
        column += family.v
    x = discrete.Ad @ x + discrete.B0 @ np.array(before) + discrete.B1 @ np.array(after)
    return np.concatenate([x, *moved, theta])


@pytest.mark.parametrize("families", [(Exponential(), Exponential()), (Sine(), Exponential())])
def test_the_extended_filter_is_that_of_the_book(families):
    """Covariance form, its Jacobian by differences, gives the kernel's theta and errors."""
    t = np.arange(201) * H
    sizes = [family.v for family in families]
    y, u = simulate(TWO_OUTPUTS, t, delta(t), sigma=1e-2)
    order = sum(sizes)
    n = 2 + order + 2
    box = SearchBox(np.array([-1.0, -2.0]), np.array([2.0, 0.5]))
    start = np.clip(0.0, box.lower + box.step, box.upper - box.step)
    state = np.concatenate([np.zeros(2 + order), start])
    P = np.diag(np.concatenate([np.full(2 + order, 4.0), box.step**2]))
    known = alpha(t)
    for k in range(len(t) - 1):
        if k:
            arguments = (u[k - 1], u[k], known[k - 1], known[k])
            J = np.empty((n, n))
            for j in range(n):
                step = np.zeros(n)
                step[j] = 1e-6
                above = transition(families, state + step, *arguments)
                below = transition(families, state - step, *arguments)
                J[:, j] = (above - below) / 2e-6
            state = transition(families, state, *arguments)
            P = J @ P @ J.T
        C = np.zeros((2, n))
        C[:, :2] = TWO_OUTPUTS.C
        column = 2
        for i, family in enumerate(families):
            C[:, column : column + family.v] = np.outer(
                TWO_OUTPUTS.Dd[:, i] * known[k, i], family.c
            )
            column += family.v
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + 1e-4 * np.eye(2))
        state = state + K @ (y[k] - TWO_OUTPUTS.D @ u[k] - C @ state)
        P = P - K @ C @ P
        P = 0.5 * (P + P.T)
    found = extended_kalman(
        t, y, u, ALPHAS, TWO_OUTPUTS, families, deviation=1e-2, size=2.0, box=box
    )
    errors = np.sqrt(np.diag(P))[-2:]
    informed = errors < 0.5 * box.step
    assert informed.any()
    theta = found.theta[-1]
    present = ~np.isnan(theta)
    assert not present[~informed].any()
    assert present.any()
    # differences have 1e-10 of J, which 400 steps and a covariance without square roots multiply
    np.testing.assert_allclose(theta[present], state[-2:][present], atol=1e-6)
    np.testing.assert_allclose(found.standard_error[-1][present], errors[present], rtol=1e-5)


def test_the_extended_filter_ends_near_the_truth():
    """On the paper's example within 5 %; there is nothing at the start."""
    t = np.arange(4001) * H
    y, u = simulate(plant(), t, delta(t), sigma=1e-3)
    found = extended_kalman(
        t,
        y,
        u,
        ALPHAS,
        plant(),
        (Exponential(), Exponential()),
        deviation=0.03,  # as much information as 0.1 at ten times the samples
        box=SearchBox(np.array([-3.0, -3.0]), np.array([0.06, 0.06])),
    )
    error = np.abs(found.theta[-1] - THETA)
    assert (error < 0.05 * np.abs(THETA)).all()
    assert (error < 4.0 * found.standard_error[-1]).all()
    assert np.isnan(found.theta[0]).all()


def test_the_extended_filter_says_nothing_of_a_disturbance_of_nothing():
    """Noise alone makes no component present."""
    t = np.arange(2001) * H
    for seed in range(5):
        y, u = simulate(plant(), t, 0.0 * t, sigma=1e-3, seed=seed)
        found = extended_kalman(t, y, u, ALPHAS, plant(), (Exponential(), Exponential()))
        assert np.isnan(found.theta).all()
        assert np.isnan(found.standard_error).all()


def test_projection_on_the_smoothed_disturbance_finds_theta():
    """With the mode of the plant's zero at -2 among its columns; else its transient biases."""
    t = np.arange(2001) * H
    y, u = simulate(plant(), t, delta(t))
    arguments = (t, y, u, alpha(t), plant(), (Exponential(), Exponential()), np.array([-0.2, -0.5]))
    with_mode = augmented_kalman(*arguments, A=np.array([[-2.0]]), c=np.ones(1))
    without = augmented_kalman(*arguments)
    error = np.abs(with_mode.theta - THETA)
    assert (error < 2e-3).all()
    assert (np.abs(without.theta - THETA) > 10.0 * error).all()
