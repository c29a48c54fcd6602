"""The gains of a Kalman filter without process noise, sample by sample."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_int32, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.native.library import declare, int32, library, pointer


class PredictorStruct(ctypes.Structure):
    """cosim_predictor."""

    _fields_ = (
        *((name, c_int32) for name in ("states", "outputs")),
        *((name, c_void_p) for name in ("T", "C", "R")),
    )


class ModePredictorStruct(ctypes.Structure):
    """cosim_mode_predictor."""

    _fields_ = (
        ("modes", PredictorStruct),
        *((name, c_void_p) for name in ("V", "P")),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ModePredictorConstants:
    """The numbers of cosim_mode_predictor.

    Parameters
    ----------
    T : Matrix, shape (m, m)
        Transition of the modes over a step.
    C : Matrix, shape (n_y, m)
        How the outputs see them.
    R : Matrix, shape (n_y, n_y)
        Covariance of the noise.
    V : Matrix, shape (n, m)
        The states of the modes.
    P : Matrix, shape (m, m)
        Covariance of the modes at the first sample.
    """

    T: Matrix
    C: Matrix
    R: Matrix
    V: Matrix
    P: Matrix

    def struct(self) -> tuple[ModePredictorStruct, list[NDArray[np.float64]]]:
        """Return the struct, and the arrays that must outlive it."""
        arrays = []
        for values in (self.T, self.C, self.R, self.V, self.P):
            arrays.append(np.ascontiguousarray(values, np.float64))
        n_y, m = self.C.shape
        of_modes = PredictorStruct(m, n_y, *map(pointer, arrays[:3]))
        return ModePredictorStruct(of_modes, *map(pointer, arrays[3:])), arrays


def predictor_gains(
    T: NDArray[np.float64],
    C: Matrix,
    R: Matrix,
    interval: NDArray[np.integer],
    measured: NDArray[np.bool_],
    P: Matrix,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the gain at each sample for the state at the next one, and its L.

    Parameters
    ----------
    T : shape (m, n, n)
        Transitions over intervals.
    C : Matrix, shape (n_y, n)
    R : Matrix, shape (n_y, n_y)
        Covariance of the noise.
    interval : array of int, shape (N,)
        Which one ends at each sample.
    measured : shape (N, n_y)
    P : Matrix, shape (n, n)
        Covariance of the state at the first sample.

    Returns
    -------
    array, shape (N, n, n_y)
        0 for outputs that are not measured.
    array, shape (N, n_y, n_y)
        Lower triangles that give the innovations the covariance R.

    Raises
    ------
    AssumptionError
        If a gap is so long that the covariance overflows.
    """
    n_y, n = C.shape
    N = len(interval)
    arrays = [np.ascontiguousarray(values, np.float64) for values in (T, C, R)]
    struct = PredictorStruct(n, n_y, *map(pointer, arrays))
    intervals = int32(interval)
    there = np.ascontiguousarray(measured, np.uint8)
    covariance = np.array(P, np.float64)
    gains = np.zeros((N, n, n_y))
    L = np.zeros((N, n_y, n_y))
    scratch = np.zeros(n_y, np.int32)
    work = np.zeros(n_y * (3 * n_y + n) + n * n)
    status = library.cosim_predictor_gains(
        byref(struct),
        N,
        pointer(intervals),
        pointer(there),
        pointer(covariance),
        pointer(gains),
        pointer(L),
        pointer(scratch),
        pointer(work),
    )
    if status:
        raise AssumptionError(
            "an unstable mode of the plant overflows between two samples; expected shorter gaps"
        )
    return gains, L


declare(
    {
        "cosim_predictor_gains": (
            c_int32,
            (POINTER(PredictorStruct), c_int64, *(c_void_p,) * 7),
        )
    }
)
