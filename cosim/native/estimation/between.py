"""The numbers of the kernel that takes samples between communication points."""

from __future__ import annotations

import ctypes
from ctypes import c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix
from cosim.native.library import pointer


class BetweenStruct(ctypes.Structure):
    """cosim_between."""

    _fields_ = (
        *((name, c_int32) for name in ("most", "states", "outputs", "inputs", "components")),
        ("capacity", c_int64),
        *((name, c_void_p) for name in ("A", "B", "C", "D", "held")),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class BetweenConstants:
    """The numbers of cosim_between.

    Parameters
    ----------
    most : int
        Samples in one communication step.
    A : Matrix, shape (n, n)
    B : Matrix, shape (n, n_u + components)
    C : Matrix, shape (n_y, n)
    D : Matrix, shape (n_y, n_u + components)
    held : Mask, shape (n_u,)
        Inputs with a zero-order hold over the step.
    """

    most: int
    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    held: Mask

    def struct(self, steps: int) -> tuple[BetweenStruct, list[NDArray[Any]]]:
        """Return the struct for a number of steps, and the arrays that must outlive it."""
        n_y, n = self.C.shape
        n_u = len(self.held)
        components = self.B.shape[1] - n_u
        arrays: list[NDArray[Any]] = []
        for values in (self.A, self.B, self.C, self.D):
            arrays.append(np.ascontiguousarray(values, np.float64))
        free = np.zeros(components, np.bool_)
        arrays.append(np.concatenate([self.held, free]).astype(np.uint8))
        sizes = (self.most, n, n_y, n_u, components, steps * self.most)
        return BetweenStruct(*sizes, *map(pointer, arrays)), arrays
