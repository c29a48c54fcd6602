"""The descriptor plant (1) as a model."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix
from cosim.core.linear import DescriptorModel, LinearModel, feedthrough_of, initial_dependencies
from cosim.core.signals import Interface, Signal
from cosim.errors import AssumptionError
from cosim.theory.descriptor import DescriptorSystem, reduce


def descriptor_model(system: DescriptorSystem, x_a0: ArrayLike) -> LinearModel:
    """Write a descriptor system as a model (8)-(10).

    Inputs u and delta, outputs y, x_a and x_b, states x_a.

    Raises
    ------
    AssumptionError
        If A22 is singular (Assumption 2), or ``x_a0`` has the wrong size.
    """
    reduced = reduce(system)
    n_a, n_u = reduced.B_1a.shape
    n_y, n_d = reduced.C5.shape
    n_b = len(reduced.Kx)
    X0 = np.atleast_1d(np.asarray(x_a0, dtype=np.float64))
    if X0.shape != (n_a,):
        raise AssumptionError(
            f"x_a0 has shape {X0.shape}; needed ({n_a},): one number a dynamic state"
        )
    u = Signal("u", n_u, role="input")
    delta = Signal("delta", n_d, role="input")
    y = Signal("y", n_y)
    x_a = Signal("x_a", n_a, role="state")
    outputs = [y, x_a]
    if n_b:
        x_b = Signal("x_b", n_b, role="state")
        outputs.append(x_b)
    C_x_a = np.eye(n_a)
    D_y = np.hstack([reduced.C4, reduced.C5])
    D_x_a = np.zeros((n_a, n_u + n_d))
    D_x_b = np.hstack([reduced.Ku, reduced.Kd])
    A = reduced.A_a
    B = np.hstack([reduced.B_1a, reduced.B_2a])
    C = np.vstack([reduced.C3, C_x_a, reduced.Kx])
    D = np.vstack([D_y, D_x_a, D_x_b])
    states = tuple(x_a.elements)
    return linear_model((u, delta), tuple(outputs), states=states, A=A, B=B, C=C, D=D, X0=X0)


def descriptor_form(system: DescriptorSystem, x_a0: ArrayLike) -> DescriptorModel:
    """Write a descriptor system as a model that keeps its equations (2)-(3).

    Its algebraic variable is x_b.

    Raises
    ------
    AssumptionError
        As for ``descriptor_model``, or if there are no algebraic states.
    """
    reduced = descriptor_model(system, x_a0)
    n_a = system.n_a
    n = len(system.A)
    n_y = len(system.C)
    if n_a == n:
        raise AssumptionError(
            f"n_a = {n_a} of {n} states: there are no algebraic states, and so no residual form"
        )
    B = np.hstack([system.Bu, system.Bd])
    A_dynamic = system.A[:n_a]
    A_algebraic = system.A[n_a:]
    B_dynamic = B[:n_a]
    B_algebraic = B[n_a:]
    identity = np.eye(n)
    no_feedthrough = np.zeros((n_y + n, B.shape[1]))
    # rows: x_a', y, x_a and x_b, 0
    by_state = np.vstack([A_dynamic, system.C, identity, A_algebraic])
    by_input = np.vstack([B_dynamic, no_feedthrough, B_algebraic])
    by_x = _contiguous(by_state[:, :n_a])
    by_z = _contiguous(by_state[:, n_a:])
    by_u = _contiguous(by_input)
    return DescriptorModel(reduced, "x_b", by_x, by_z, by_u)


def linear_model(
    inputs: tuple[Signal, ...],
    outputs: tuple[Signal, ...],
    *,
    states: tuple[str, ...],
    A: Matrix,
    B: Matrix,
    C: Matrix,
    D: Matrix,
    X0: Matrix,
    Xu: Matrix | None = None,
) -> LinearModel:
    """Build a linear model; its feedthrough and initial dependencies follow from the matrices."""
    if Xu is None:
        Xu = np.zeros(B.shape)
    ports = Interface(inputs, outputs)
    feedthrough = feedthrough_of(ports, D)
    initial = initial_dependencies(ports, C, D, Xu)
    interface = Interface(inputs, outputs, feedthrough, initial)
    matrices = [_contiguous(matrix) for matrix in (A, B, C, D, X0, Xu)]
    return LinearModel(interface, states, *matrices)


def _contiguous(values: Matrix) -> Matrix:
    return np.ascontiguousarray(values, np.float64)
