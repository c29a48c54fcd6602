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
    """``x' = A x + B u``, ``y = C x + D u``: input u, output y, and the state x as an output.

    Raises
    ------
    UsageError
        If the shapes do not fit together.
    """
    n, m, p = len(A), B.shape[1], len(C)
    D = np.zeros((p, m)) if D is None else D
    x0 = np.zeros(n) if x0 is None else x0
    needed = {
        "A": (A, (n, n)),
        "B": (B, (n, m)),
        "C": (C, (p, n)),
        "D": (D, (p, m)),
        "x0": (x0, (n,)),
    }
    for name, (matrix, shape) in needed.items():
        if matrix.shape != shape:
            raise UsageError(f"controller: {name} has shape {matrix.shape}, needed {shape}")
    outputs = (Signal("y", p, unit), Signal("x", n, role="state"))
    return linear_model(
        (Signal("u", m, role="input"),),
        outputs,
        states=tuple(outputs[1].elements),
        A=A,
        B=B,
        C=np.vstack([C, np.eye(n)]),
        D=np.vstack([D, np.zeros((n, m))]),
        X0=x0,
    )
