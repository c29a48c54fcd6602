"""The descriptor plant (1) as a model."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix
from cosim.core.linear import DescriptorModel, LinearModel, feedthrough_of, start_dependencies
from cosim.core.signals import Interface, Signal
from cosim.errors import AssumptionError
from cosim.theory.descriptor import DescriptorSystem, reduce


def descriptor_model(system: DescriptorSystem, x_a0: ArrayLike) -> LinearModel:
    """Write a descriptor system as a model: inputs u and delta, outputs y, x_a and x_b (8)-(10), states x_a.

    Raises
    ------
    AssumptionError
        If A22 is singular (Assumption 2), or ``x_a0`` has the wrong size.
    """
    r = reduce(system)
    n, start = len(r.A_a), np.atleast_1d(np.asarray(x_a0, dtype=np.float64))
    if start.shape != (n,):
        raise AssumptionError(
            f"x_a0 has shape {start.shape}; needed ({n},): one number a dynamic state"
        )
    inputs = (
        Signal("u", r.B_1a.shape[1], role="input"),
        Signal("delta", r.B_2a.shape[1], role="input"),
    )
    outputs = [Signal("y", len(r.C3)), Signal("x_a", n, role="state")]
    if len(r.Kx):
        outputs.append(Signal("x_b", len(r.Kx), role="state"))
    C = np.vstack([r.C3, np.eye(n), r.Kx])
    D = np.vstack(
        [
            np.hstack([r.C4, r.C5]),
            np.zeros((n, inputs[0].size + inputs[1].size)),
            np.hstack([r.Ku, r.Kd]),
        ]
    )
    return linear_model(
        inputs,
        tuple(outputs),
        states=tuple(outputs[1].elements),
        A=r.A_a,
        B=np.hstack([r.B_1a, r.B_2a]),
        C=C,
        D=D,
        X0=start,
    )


def descriptor_form(system: DescriptorSystem, x_a0: ArrayLike) -> DescriptorModel:
    """Write a descriptor system as a model that keeps its equations (2)-(3), with x_b as algebraic variable.

    Raises
    ------
    AssumptionError
        As for ``descriptor_model``, or if there are no algebraic states.
    """
    reduced, n_a = descriptor_model(system, x_a0), system.n_a
    n, n_b, n_y = len(system.A), len(system.A) - n_a, len(system.C)
    if n_b == 0:
        raise AssumptionError(
            f"n_a = {n_a} of {n} states: there are no algebraic states, and so no residual form"
        )
    B = np.hstack([system.Bu, system.Bd])
    by_state = np.vstack(
        [system.A[:n_a], system.C, np.eye(n), system.A[n_a:]]
    )  # x_a', y, x_a and x_b, 0
    by_u = np.vstack([B[:n_a], np.zeros((n_y + n, B.shape[1])), B[n_a:]])
    by_x, by_z = (
        np.ascontiguousarray(part, np.float64) for part in (by_state[:, :n_a], by_state[:, n_a:])
    )
    return DescriptorModel(reduced, "x_b", by_x, by_z, np.ascontiguousarray(by_u, np.float64))


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
    """Put matrices and signals together; what depends on what is read off the matrices."""
    interface, Xu = Interface(inputs, outputs), np.zeros(B.shape) if Xu is None else Xu
    return LinearModel(
        Interface(
            inputs, outputs, feedthrough_of(interface, D), start_dependencies(interface, C, D, Xu)
        ),
        states,
        A=np.ascontiguousarray(A, np.float64),
        B=np.ascontiguousarray(B, np.float64),
        C=np.ascontiguousarray(C, np.float64),
        D=np.ascontiguousarray(D, np.float64),
        X0=np.ascontiguousarray(X0, np.float64),
        Xu=np.ascontiguousarray(Xu, np.float64),
    )
