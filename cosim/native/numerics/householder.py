"""Householder's rotations, as the kernels have them."""

from __future__ import annotations

from ctypes import c_int32, c_void_p

import numpy as np

from cosim.arrays import Matrix
from cosim.native.library import declare, library, pointer


def triangle(rows: Matrix, R: Matrix | None = None) -> Matrix:
    """Rotate rows, shape ``(N, n)``, into an upper triangle R with R'R = sum of their products."""
    n = rows.shape[1]
    result = np.zeros((n, n)) if R is None else np.array(R, np.float64)
    block = 256
    work = np.empty(n)
    for begin in range(0, len(rows), block):
        part = np.array(rows[begin : begin + block], np.float64, order="C")
        library.cosim_householder(n, pointer(result), len(part), pointer(part), pointer(work))
    return result


declare({"cosim_householder": (None, (c_int32, c_void_p, c_int32, c_void_p, c_void_p))})
