"""Models with a residual form: a descriptor system with two algebraic states, and a nonlinear one compiled from C."""

import numpy as np

from cosim.blocks.plant import descriptor_form
from cosim.core.solver import DescriptorModel
from cosim.theory.descriptor import DescriptorSystem

SYSTEM = DescriptorSystem(
    A=np.array([[-1.0, 0.5, 1.0, 0.0], [0.0, -2.0, 0.25, -1.0], [1.0, 0.0, 2.0, 0.5], [0.5, -1.0, -0.25, 1.5]]),
    Bu=np.array([[0.0], [2.0], [1.0], [0.5]]),
    Bd=np.array([[1.0], [0.0], [0.0], [-0.5]]),
    C=np.array([[2.0, 0.0, 1.0, -1.0]]),
    n_a=2,
)
START = [1.0, -1.0]


def descriptor() -> DescriptorModel:
    return descriptor_form(SYSTEM, START)
