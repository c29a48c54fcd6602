"""The kernel that searches starts of theta from y itself, on a grid."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.native.estimation.output_error import OutputErrorConstants, OutputErrorModel
from cosim.native.library import declare, int32, library, pointer

MOST_STARTS: Final = 16  # COSIM_MOST_STARTS


class StartGridStruct(ctypes.Structure):
    """cosim_start_grid."""

    _fields_ = (
        *((name, c_int32) for name in ("components", "beside")),
        *(
            (name, c_void_p)
            for name in ("model", "size", "count", "points", "alike", "even", "theta")
        ),
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
    alike : tuple of int
        For every component the last one before that is interchangeable with it, or -1.
    even : tuple of bool
        For every parameter, whether its negative makes the same signals.
    theta : Vector, shape (sum of points_i count_i,)
        The points of one component behind those of the other.
    beside : bool
        The last point of each component with parameters is no part of the grid: it is that of a
        fit, beside which starts are searched.
    """

    model: OutputErrorConstants
    size: tuple[int, ...]
    count: tuple[int, ...]
    points: tuple[int, ...]
    alike: tuple[int, ...]
    even: tuple[bool, ...]
    theta: Vector
    beside: bool = False


class StartGridModel:
    """All combinations of the points of a grid as columns of one regression."""

    def __init__(self, constants: StartGridConstants) -> None:
        self.model = OutputErrorModel(constants.model, fitted_to=None)
        self._parameters = sum(constants.count)
        arrays: list[NDArray[Any]] = [
            int32(constants.size),
            int32(constants.count),
            int32(constants.points),
            int32(constants.alike),
            np.array(constants.even, np.uint8),
            np.array(constants.theta, np.float64),
        ]
        self.arrays = arrays
        self.struct = StartGridStruct(
            len(constants.size),
            constants.beside,
            ctypes.addressof(self.model.struct),
            *map(pointer, arrays),
        )
        self.points = int(library.cosim_start_grid_points(byref(self.struct)))

    def squares(self, triangles: Sequence[Matrix]) -> Vector:
        """Compute the least squares of every combination, where they are few, shape (points,).

        Parameters
        ----------
        triangles : sequence of Matrix
            R of the model of each record; the squares are summed.
        """
        squares = np.empty(self.points)
        R, memory = self._work_of(triangles)
        addresses = (pointer(R), pointer(memory), pointer(squares))
        library.cosim_start_grid_squares(byref(self.struct), len(triangles), *addresses)
        return squares

    def search(self, triangles: Sequence[Matrix], most: int) -> Matrix:
        """Return the best combinations, the best first, shape (at most most, P).

        Parameters
        ----------
        triangles : sequence of Matrix
            R of the model of each record.
        most : int
            1 to MOST_STARTS.

        Raises
        ------
        UsageError
            If ``most`` is not in that range.
        """
        if not 1 <= most <= MOST_STARTS:
            raise UsageError(f"most: expected 1 to {MOST_STARTS}, got {most} starts")
        R, memory = self._work_of(triangles)
        theta = np.zeros((most, self._parameters))
        count = library.cosim_start_grid_search(
            byref(self.struct), len(triangles), pointer(R), pointer(memory), most, pointer(theta)
        )
        return theta[:count]

    def _work_of(self, triangles: Sequence[Matrix]) -> tuple[Matrix, Vector]:
        """Return the triangles one behind the other, and the memory of a search."""
        R = np.ascontiguousarray(np.concatenate(list(triangles)), np.float64)
        size = int(library.cosim_start_grid_memory(byref(self.struct), len(triangles)))
        return R, np.zeros(size)


declare(
    {
        "cosim_start_grid_memory": (c_int64, (c_void_p, c_int32)),
        "cosim_start_grid_points": (c_int64, (c_void_p,)),
        "cosim_start_grid_squares": (None, (c_void_p, c_int32, c_void_p, c_void_p, c_void_p)),
        "cosim_start_grid_search": (
            c_int32,
            (c_void_p, c_int32, c_void_p, c_void_p, c_int32, c_void_p),
        ),
    }
)
