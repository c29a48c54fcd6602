"""Blocks that several modules of tests build."""

from __future__ import annotations

import numpy as np

from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.blocks.state_space import DiscreteStateSpace, controller, system_matrices
from cosim.core.linear import Linear
from cosim.theory.disturbances.families import Exponential, group_by_alpha
from cosim.theory.disturbances.regression import expand
from cosim.theory.estimators.least_squares import plan

H = 1e-3


def through():
    """Return a controller with a state and feedthrough from its first input only."""
    D = np.array([[0.5, 0.0], [0.0, 0.0]])
    return Linear(controller(A=np.array([[-3.0, 1.0], [0.0, -2.0]]), B=np.eye(2), C=np.eye(2), D=D))


def identifier(**options):
    groups = group_by_alpha(["a", "b"], [Exponential()] * 2)
    return LeastSquaresIdentifier(
        plan(expand((1, 1)), groups, [1.0, 2.0, 3.0]), start_time=3 * H, **options
    )


def discrete():
    """Return a discrete-time system with a state and feedthrough from its first input only."""
    A = np.array([[0.9, 0.1], [0.0, -0.5]])
    D = np.array([[0.5, 0.0], [0.0, 0.0]])
    return DiscreteStateSpace(
        system_matrices("test", A=A, B=np.eye(2), C=np.eye(2), D=D, x0=np.array([1.0, -2.0]))
    )
