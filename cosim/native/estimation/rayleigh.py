"""The kernel that estimates theta by the Rayleigh quotient of the regression."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_double, c_int32, c_void_p
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.output_error import MOST_PARAMETERS, Generators
from cosim.native.library import declare, int32, library, pointer

MOST_TERMS: Final = 128  # COSIM_MOST_TERMS
MOST_ROWS: Final = 48  # COSIM_MOST_ROWS


class RayleighStruct(ctypes.Structure):
    """cosim_rayleigh."""

    _fields_ = (
        *((name, c_int32) for name in ("components", "parameters", "rows", "groups", "terms")),
        *((name, c_void_p) for name in ("size", "count", "group", "c", "G0", "G1", "delays")),
        *((name, c_void_p) for name in ("parts", "lower", "upper")),
        ("points", c_int32),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class RayleighConstants:
    """The numbers of cosim_rayleigh.

    Parameters
    ----------
    generators : Generators
    group : tuple of int
        Which group of (21) each component belongs to.
    delays : tuple of float
        D_j [s].
    parts : array of int, shape (terms, delays - 1)
        The rows R_b of all groups, one group behind the other; none: (25) is not expanded, and
        there is no quotient.
    lower, upper : Vector, shape (P,)
        The box that is searched.
    points : int
        Of the grid of starts, in every direction.

    Raises
    ------
    AssumptionError
        If it is larger than the kernel holds.
    """

    generators: Generators
    group: tuple[int, ...]
    delays: tuple[float, ...]
    parts: NDArray[np.integer]
    lower: Vector
    upper: Vector
    points: int

    def __post_init__(self) -> None:
        """Check the sizes."""
        for name, found, most in (
            ("terms", len(self.parts) if self.parts.shape[1] else 0, MOST_TERMS),
            ("delays", len(self.delays), MOST_ROWS),
            ("parameters", self.generators.parameters, MOST_PARAMETERS),
        ):
            if found > most:
                raise AssumptionError(
                    f"the linear regression: expected at most {most} {name}, got {found}; give "
                    "components the same alpha, use fewer, or estimate by output error from an "
                    "explicit start"
                )


class RayleighModel:
    """The quotient chi' S chi / chi' N chi as a function of theta."""

    def __init__(self, constants: RayleighConstants) -> None:
        generators = constants.generators
        arrays: list[NDArray[Any]] = [
            int32(generators.size),
            int32(generators.count),
            int32(constants.group),
        ]
        for values in (generators.c, generators.G0, generators.G1, constants.delays):
            arrays.append(np.array(values, np.float64))
        arrays.append(int32(constants.parts))
        arrays.append(np.array(constants.lower, np.float64))
        arrays.append(np.array(constants.upper, np.float64))
        self.arrays = arrays
        terms = len(constants.parts)
        self.struct = RayleighStruct(
            len(generators.size),
            generators.parameters,
            len(constants.delays),
            max(constants.group) + 1,
            terms,
            *map(pointer, arrays),
            constants.points,
        )

    def minimize(self, R: Matrix, N: Matrix, theta: Vector | None) -> tuple[int, Vector, float]:
        """Minimize from ``theta``, or from the best points of the grid.

        Returns
        -------
        tuple of int, Vector and float
            Status, theta and quotient.
        """
        R = np.ascontiguousarray(R, np.float64)
        N = np.ascontiguousarray(N, np.float64)
        value = c_double()
        minimum = np.zeros(self.struct.parameters)
        function = library.cosim_rayleigh_search
        if theta is not None:
            minimum[:] = theta
            function = library.cosim_rayleigh_minimize
        status = int(
            function(byref(self.struct), pointer(R), pointer(N), pointer(minimum), byref(value))
        )
        return status, minimum, value.value


declare(
    {
        "cosim_rayleigh_minimize": (
            c_int32,
            (POINTER(RayleighStruct), c_void_p, c_void_p, c_void_p, POINTER(c_double)),
        ),
        "cosim_rayleigh_search": (
            c_int32,
            (POINTER(RayleighStruct), c_void_p, c_void_p, c_void_p, POINTER(c_double)),
        ),
    }
)
