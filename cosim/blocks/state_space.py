"""A linear controller with a state of its own."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.blocks.plant import linear_model
from cosim.core.linear import LinearModel
from cosim.core.signals import Signal
from cosim.errors import UsageError


def controller(
    *,
    A: Matrix,
    B: Matrix,
    C: Matrix,
    D: Matrix | None = None,
    x0: Vector | None = None,
    unit: str | None = None,
) -> LinearModel:
    """Build ``x' = A x + B u``, ``y = C x + D u``: input u, output y, and the state x as an output.

    Parameters
    ----------
    A, B, C : Matrix
        Shapes ``(n, n)``, ``(n, m)``, ``(p, n)``.
    D : Matrix, optional
        Shape ``(p, m)``; by default 0.
    x0 : Vector, optional
        Initial state, shape ``(n,)``; by default 0.
    unit : str, optional
        The unit of y.

    Raises
    ------
    UsageError
        If the shapes do not fit together.
    """
    n = len(A)
    m = B.shape[1]
    p = len(C)
    if D is None:
        D = np.zeros((p, m))
    if x0 is None:
        x0 = np.zeros(n)
    _check_shape("A", A, (n, n))
    _check_shape("B", B, (n, m))
    _check_shape("C", C, (p, n))
    _check_shape("D", D, (p, m))
    _check_shape("x0", x0, (n,))
    u = Signal("u", m, role="input")
    y = Signal("y", p, unit)
    x = Signal("x", n, role="state")
    states = tuple(x.elements)
    C_x = np.eye(n)
    D_x = np.zeros((n, m))
    C_all = np.vstack([C, C_x])
    D_all = np.vstack([D, D_x])
    return linear_model((u,), (y, x), states=states, A=A, B=B, C=C_all, D=D_all, X0=x0)


def _check_shape(name: str, array: Matrix | Vector, needed: tuple[int, ...]) -> None:
    if array.shape != needed:
        raise UsageError(f"controller: {name} has shape {array.shape}, needed {needed}")
