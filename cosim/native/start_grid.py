"""The kernel that searches starts of theta from y itself, on a grid."""

from __future__ import annotations

import ctypes
from ctypes import byref, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.native.library import declare, int32, library, pointer
from cosim.native.output_error import OutputErrorConstants, OutputErrorModel

MOST_STARTS: Final = 8  # COSIM_MOST_STARTS


class StartGridStruct(ctypes.Structure):
    """cosim_start_grid."""

    _fields_ = (
        ("components", c_int32),
        *((name, c_void_p) for name in ("model", "size", "count", "points", "theta")),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class StartGridConstants:
    """The numbers of cosim_start_grid.

    Parameters
    ----------
    model : OutputErrorConstants
        With a component for each point of a component, one beside the other.
    size, count, points : tuple of int
        Basis functions of one point, parameters, and points of every component.
    theta : Vector, shape (sum of points_i count_i,)
        The points of one component behind those of the other.
    """

    model: OutputErrorConstants
    size: tuple[int, ...]
    count: tuple[int, ...]
    points: tuple[int, ...]
    theta: Vector


class StartGridModel:
    """All combinations of the points of a grid as columns of one regression."""

    def __init__(self, constants: StartGridConstants) -> None:
        self.model = OutputErrorModel(constants.model, fitted_to=None)
        self._parameters = sum(constants.count)
        arrays: list[NDArray[Any]] = [
            int32(constants.size),
            int32(constants.count),
            int32(constants.points),
            np.array(constants.theta, np.float64),
        ]
        self.arrays = arrays
        self.struct = StartGridStruct(
            len(constants.size), ctypes.addressof(self.model.struct), *map(pointer, arrays)
        )
        self.memory = int(library.cosim_start_grid_memory(byref(self.struct)))
        self.points = int(library.cosim_start_grid_points(byref(self.struct)))

    def squares(self, R: Matrix) -> Vector:
        """Compute the least squares of every combination from R of the model, shape (points,)."""
        R = np.ascontiguousarray(R, np.float64)
        scratch = np.zeros(self.memory)
        squares = np.empty(self.points)
        library.cosim_start_grid_squares(
            byref(self.struct), pointer(R), pointer(scratch), pointer(squares)
        )
        return squares

    def best(self, squares: Vector, most: int) -> Matrix:
        """Return the points that no neighbor betters, the best first, shape (at most most, P).

        Parameters
        ----------
        squares : Vector, shape (points,)
            Of one record, or the sum over several.
        most : int
            1 to MOST_STARTS.

        Raises
        ------
        UsageError
            If ``most`` is not in that range.
        """
        if not 1 <= most <= MOST_STARTS:
            raise UsageError(f"most: found {most} starts; needed 1 to {MOST_STARTS}")
        squares = np.ascontiguousarray(squares, np.float64)
        theta = np.zeros((most, self._parameters))
        count = library.cosim_start_grid_best(
            byref(self.struct), pointer(squares), most, pointer(theta)
        )
        return theta[:count]


declare(
    {
        "cosim_start_grid_memory": (c_int64, (c_void_p,)),
        "cosim_start_grid_points": (c_int64, (c_void_p,)),
        "cosim_start_grid_squares": (None, (c_void_p, c_void_p, c_void_p, c_void_p)),
        "cosim_start_grid_best": (c_int32, (c_void_p, c_void_p, c_int32, c_void_p)),
    }
)
