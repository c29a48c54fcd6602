"""The descriptor plant (1) as a model."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix, Vector
from cosim.core.linear import DescriptorModel, LinearModel, with_dependencies
from cosim.core.signals import Interface, Role, Signal
from cosim.errors import AssumptionError
from cosim.theory.plants.descriptor import DescriptorSystem, ReducedSystem, reduce, state_maps

CONSISTENT: Final = 1e-6  # of the terms of a constraint, that written initial values may miss
_TEXTS: Final = MappingProxyType(
    {
        "u": "known input",
        "delta": "unknown disturbance",
        "y": "measured output",
        "x": "state",
        "x_a": "dynamic states",
        "x_b": "algebraic states",
    }
)


def descriptor_model(system: DescriptorSystem, initial: ArrayLike) -> LinearModel:
    """Write a descriptor system as a model (8)-(10).

    Inputs u and delta; outputs y and the user's states: x_a and x_b of the partitioned form, x of
    the general one. There is no signal without elements.

    Parameters
    ----------
    system : DescriptorSystem
    initial : ArrayLike
        x_a(0), shape ``(n_a,)``; of the general form x(0), shape ``(n,)``, of which E x(0) counts.

    Raises
    ------
    AssumptionError
        If the system cannot be reduced, or ``initial`` has the wrong size or contradicts a
        constraint between dynamic states.
    """
    reduced = reduce(system)
    n_a, n_u = reduced.B_1a.shape
    n_y, n_d = reduced.C5.shape
    coordinates = reduced.coordinates
    if coordinates is None:
        X0 = initial_vector("x_a0", initial, n_a, "one number a dynamic state")
    else:
        n = len(coordinates.X)
        x0 = initial_vector("x0", initial, n, "one number a state")
        _check_constraints(coordinates.H, x0)
        X0 = coordinates.R @ x0
    states = state_maps(reduced)
    sizes = {state.name: len(state.of_x_a) for state in states}
    D_states = [np.hstack([state.of_u, state.of_delta]) for state in states]
    D_y = np.hstack([reduced.C4, reduced.C5])
    inputs = _signals({"u": n_u, "delta": n_d}, "input")
    outputs = (Signal("y", n_y, description=_TEXTS["y"]), *_signals(sizes, "state"))
    model = LinearModel(
        Interface(inputs, outputs),
        states=_state_names(reduced),
        A=reduced.A_a,
        B=np.hstack([reduced.B_1a, reduced.B_2a]),
        C=np.vstack([reduced.C3, *(state.of_x_a for state in states)]),
        D=np.vstack([D_y, *D_states]),
        X0=X0,
        Xu=np.zeros((n_a, n_u + n_d)),
    )
    return with_dependencies(model)


def _check_constraints(H: Matrix, x0: Vector) -> None:
    """Check that initial states fulfill the constraints `H x = 0` of a model of a higher index."""
    parts = np.abs(H) * np.abs(x0)
    violated = np.abs(H @ x0) > CONSISTENT * parts.sum(axis=1)
    if violated.any():
        entries = np.flatnonzero(np.any(parts[violated] > 0.0, axis=0))
        shown = ", ".join(f"x[{i}] = {x0[i]:g}" for i in entries)
        raise AssumptionError(
            "x0: expected states that fulfill the constraints between them, also those between "
            f"their rates that follow, got {shown}"
        )


def _state_names(reduced: ReducedSystem) -> tuple[str, ...]:
    """Return the names of the model's states: those of x where they are x itself."""
    n_a = len(reduced.A_a)
    is_x = reduced.coordinates is not None and len(reduced.coordinates.X) == n_a
    return tuple(Signal("x" if is_x else "x_a", n_a, role="state").elements)


def _signals(sizes: Mapping[str, int], role: Role) -> tuple[Signal, ...]:
    """Return signals by their sizes; there is none without elements."""
    signals = []
    for name, size in sizes.items():
        if size:
            signals.append(Signal(name, size, role=role, description=_TEXTS[name]))
    return tuple(signals)


def initial_vector(name: str, values: ArrayLike, size: int, needed: str) -> Vector:
    """Return given initial values as a vector.

    Raises
    ------
    AssumptionError
        If there are not ``size`` of them.
    """
    vector = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if vector.shape != (size,):
        raise AssumptionError(f"{name}: expected shape ({size},), {needed}, got {vector.shape}")
    return vector


def descriptor_form(system: DescriptorSystem, x_a0: ArrayLike) -> DescriptorModel:
    """Write a descriptor system as a model that keeps its equations (2)-(3).

    Its algebraic variable is x_b.

    Raises
    ------
    AssumptionError
        As for ``descriptor_model``, or if there are no algebraic states, or the form is general.
    """
    n_a = system.n_a
    if n_a is None:
        raise AssumptionError(
            "a residual form requires the algebraic states x_b; expected a model with n_a, A, Bu, "
            "Bd, C"
        )
    reduced = descriptor_model(system, x_a0)
    n = len(system.A)
    n_y = len(system.C)
    if n_a == n:
        raise AssumptionError(
            f"n_a = {n_a} of {n} states: without algebraic states there is no residual form"
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


def _contiguous(values: Matrix) -> Matrix:
    return np.ascontiguousarray(values, np.float64)
