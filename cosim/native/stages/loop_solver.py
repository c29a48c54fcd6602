"""The unknowns of a loop at the end of a step; see ``loop_solver.h``."""

from __future__ import annotations

from ctypes import Structure, addressof, c_double, c_int32, c_int64, c_void_p
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.library import declare, library, pointer

SOLVED: Final = 0  # COSIM_SOLVED and so on
SWEEP: Final = 1
UNDECIDED: Final = 2
UNSOLVED: Final = 3
INVALID: Final = 4


class LoopSolverStruct(Structure):
    """cosim_loop_solver."""

    _fields_ = (
        *((name, c_int64) for name in ("n", "n_rows")),
        *((name, c_void_p) for name in ("times", "rows")),
        ("iterations", c_int64),
        *((name, c_void_p) for name in ("memory", "v", "point")),
        *((name, c_int64) for name in ("sweeps", "column", "is_new", "halvings")),
        *((name, c_int64) for name in ("is_last", "point_is_rounding")),
        ("before", c_double),
        ("worst", c_int64),
        *((name, c_double) for name in ("residual", "tolerance")),
    )


declare(
    {
        "cosim_loop_solver_begin": (None, (c_void_p, c_double)),
        "cosim_loop_solver_next": (c_int32, (c_void_p, c_void_p, c_double)),
    }
)


@final
class LoopSolver:
    """Solves ``w(v) = v``, in turns with sweeps of the loop.

    Parameters
    ----------
    n : int
        Number of unknowns.
    iterations : int
        Sweeps of a step, each with what the one before gave, solution or not; 0: as many as
        Newton's method takes.

    Attributes
    ----------
    v : Vector, shape (n,)
        What the next sweep takes.
    memory : Vector
        What is kept from step to step.
    """

    def __init__(self, n: int, iterations: int) -> None:
        self.iterations = iterations
        self.v = np.zeros(n)
        self.memory = np.zeros(1 + 3 * n + n * n)
        self._point = np.zeros(2 * n)
        arrays = (pointer(self.memory), pointer(self.v), pointer(self._point))
        self._struct = LoopSolverStruct(n, 0, None, None, iterations, *arrays)
        self.address = addressof(self._struct)

    def take(self, times: Vector, rows: Matrix) -> None:
        """Take recorded values from now on, and solve for nothing.

        Parameters
        ----------
        times : Vector, shape (N,)
            The ends of the steps [s], ascending; at least one.
        rows : Matrix, shape (N, n)
        """
        self._recorded = (np.ascontiguousarray(times), np.ascontiguousarray(rows))
        self._struct.times, self._struct.rows = map(pointer, self._recorded)
        self._struct.n_rows = len(rows)

    def begin(self, t1: float, v: Vector) -> None:
        """Begin a step that ends at ``t1`` [s] with a guess."""
        self.v[:] = v
        library.cosim_loop_solver_begin(self.address, t1)

    def next(self, w: Vector, largest: float) -> int:
        """Take what a sweep with ``v`` gave; return what is next: ``SOLVED``, ``SWEEP``, ...

        Parameters
        ----------
        w : Vector, shape (n,)
        largest : float
            The largest absolute value involved in computing it.
        """
        status: int = library.cosim_loop_solver_next(self.address, pointer(w), largest)
        return status

    def reset(self) -> None:
        """Forget the past."""
        self.memory[:] = 0.0

    @property
    def worst(self) -> tuple[int, float, float]:
        """The worst element of the last candidate, its residual, and what is allowed there."""
        struct = self._struct
        return struct.worst, struct.residual, struct.tolerance
