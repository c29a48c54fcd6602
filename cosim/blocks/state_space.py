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
    D = np.zeros((p, m)) if D is None else D
    x0 = np.zeros(n) if x0 is None else x0
    arrays = {"A": A, "B": B, "C": C, "D": D, "x0": x0}
    shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "x0": (n,)}
    for name, shape in shapes.items():
        found = arrays[name].shape
        if found != shape:
            raise UsageError(f"controller: {name} has shape {found}, needed {shape}")
    u = Signal("u", m, role="input")
    y = Signal("y", p, unit)
    x = Signal("x", n, role="state")
    states = tuple(x.elements)
    # the outputs are y, then x
    C = np.vstack([C, np.eye(n)])
    D = np.vstack([D, np.zeros((n, m))])
    return linear_model((u,), (y, x), states=states, A=A, B=B, C=C, D=D, X0=x0)
