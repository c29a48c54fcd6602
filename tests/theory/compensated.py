"""A plant with a compensator, and its sampled loop written step by step with other tools."""

import numpy as np
from scipy.linalg import expm

from cosim.theory.compensation.design import (
    CompensatorGains,
    ControlledPlant,
    decay_rate_of,
)
from cosim.theory.compensation.internal_model import ParameterBox, internal_model
from cosim.theory.compensation.state_feedback import (
    feedforward,
    no_gain,
    reference_gain,
    regulated_plant,
    state_feedback,
)
from cosim.theory.compensation.transmission_zeros import check_zeros
from cosim.theory.disturbances.families import Sine
from cosim.theory.observers.observer import StateSpace, design, realize
from cosim.theory.plants.descriptor import DescriptorSystem, reduce

FILTER_RATE = 50.0
SINE = (Sine(),)
WEIGHTS = (1.0, 10.0, 1.0, 1.0)


def drive(scale=(1.0, 1.0, 1.0, 1.0)):
    """Return two masses between springs: u acts on the first, delta on the second, seen by y.

    y are position and velocity of the second one; ``scale`` are the units of the states.
    """
    T = np.diag(scale)
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-5, 4, -1.8, 0.8], [4, -5, 0.8, -1.8]])
    Bu = np.array([[0.0], [0.0], [1.0], [0.0]])
    Bd = np.array([[0.0], [0.0], [0.0], [1.0]])
    C = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    inverse = np.linalg.inv(T)
    system = DescriptorSystem.partitioned(
        A=T @ A @ inverse, Bu=T @ Bu, Bd=T @ Bd, C=C @ inverse, n_a=4
    )
    return reduce(system)


def designed(reduced, *, lower, upper, families=SINE, Q=WEIGHTS, R=None, ff=False, rate=None):
    """Return the gains of a compensator of the first output, its observer inside."""
    plant = regulated_plant(reduced, [0])
    K = state_feedback(plant.A, plant.B, Q=Q, R=R)
    model = internal_model(families, 1)
    box = ParameterBox(np.atleast_1d(lower), np.atleast_1d(upper))
    check_zeros(plant, model, box)
    return CompensatorGains(
        plant=plant,
        K=K,
        F=feedforward(plant, K) if ff else no_gain(plant, 0),
        N=reference_gain(plant, K),
        model=model,
        box=box,
        decay_rate=decay_rate_of(plant, K, rate),
    )


def observer_of(reduced, *, delta=False):
    """Return the observer from (u, y) to x_a, and to delta."""
    system = realize(reduced, design(reduced, poles=[-6.0, -8.0], filter_rate=FILTER_RATE))
    rows = len(reduced.A_a) + (1 if delta else 0)
    return StateSpace(system.A, system.B, system.C[:rows], system.D[:rows])


def plant_of(reduced):
    """Return the plant from u to y."""
    return StateSpace(reduced.A_a, reduced.B_1a, reduced.C3, reduced.C4)


def sampled(reduced, h, *, delta=False):
    """Return what is certified."""
    observer = observer_of(reduced, delta=delta)
    return ControlledPlant(plant=plant_of(reduced), observer=observer, regulated=(0,), h=h)


def over_a_step(system, h):
    """Return the solution of x' = A x + B v over h, by x and both ends of the straight line v."""
    n, m = system.B.shape
    M = np.zeros((n + 2 * m, n + 2 * m))
    M[:n, :n] = system.A
    M[:n, n : n + m] = system.B
    M[n : n + m, n + m :] = np.eye(m)
    solution = expm(M * h)[:n]

    def advance(x, start, end):
        return solution @ np.concatenate([x, start, (end - start) / h])

    return advance


def loop_matrix(reduced, gains, theta, h, *, at, delta=False):
    """Return what a step of the whole loop does to (x, observer, u, w), a column a unit vector.

    ``at`` are the gains of the internal model, ``theta`` is that of its dynamics.
    """
    plant = plant_of(reduced)
    observer = observer_of(reduced, delta=delta)
    n = len(plant.A)
    n_o = len(observer.A)
    n_w = len(gains.model.b)
    plant_over = over_a_step(plant, h)
    observer_over = over_a_step(observer, h)
    S = gains.model.S(np.atleast_1d(theta))
    no_output = np.zeros((0, n_w)), np.zeros((0, 1))
    model_over = over_a_step(StateSpace(S, gains.model.b, *no_output), h)

    def step(state):
        x, o, u, w = np.split(state, np.cumsum([n, n_o, 1]))
        y = plant.C @ x + plant.D @ u
        estimates = observer.C @ o + observer.D @ np.concatenate([u, y])
        x_hat = estimates[:n]
        new_u = -gains.K @ x_hat + gains.F.gain @ estimates[n:]
        deviation = x_hat - gains.F.states @ estimates[n:]
        new_u = new_u - at.K_w @ (w - at.X @ deviation)
        new_w = model_over(w, y[:1], y[:1])
        new_x = plant_over(x, u, new_u)
        new_y = plant.C @ new_x + plant.D @ new_u
        ends = np.concatenate([u, y]), np.concatenate([new_u, new_y])
        new_o = observer_over(o, *ends)
        return np.concatenate([new_x, new_o, new_u, new_w])

    return np.column_stack([step(unit) for unit in np.eye(n + n_o + 1 + n_w)])


def growth(matrix, h):
    """Return the rate of the fastest growing mode of a sampled loop [1/s]; negative: it decays."""
    return np.log(np.abs(np.linalg.eigvals(matrix)).max()) / h
