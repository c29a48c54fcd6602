"""Drive one component over a grid."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import prepare


def times(steps: int, step_ns: int = 1_000_000) -> Vector:
    """Return the communication points [s]."""
    return np.arange(steps + 1) * step_ns / 1e9


def drive(component, u: Matrix, *, step_ns: int = 1_000_000, held: bool = False) -> Matrix:
    """Run a component over inputs, shape (steps+1, n_u), in one call; outputs at all points."""
    t = times(len(u) - 1, step_ns)
    prepare(component, step_ns / 1e9, np.full(u.shape[1], held), {})
    first = component.initialize(0.0, u[0])
    return np.vstack([first, component.advance(t, step_ns / 1e9, u)])
