"""Linear algebra in a fixed order, and linear systems that step: ``linear.c``."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from ctypes import POINTER, c_double, c_int32, c_int64, c_uint8, c_void_p
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.library import address, declare, library, pointer
from cosim.native.step import NativeStep


class SubstepStruct(ctypes.Structure):
    """cosim_linear_substep."""

    _fields_ = (("h", c_double), *((name, c_void_p) for name in ("Ad", "B0", "B1")))


class DynamicsStruct(ctypes.Structure):
    """cosim_linear_dynamics."""

    _fields_ = (
        *((name, c_void_p) for name in ("A", "B", "held")),
        *((name, c_double) for name in ("step", "h")),
        *((name, c_void_p) for name in ("Ad", "B0", "B1", "work")),
    )


class LinearStruct(ctypes.Structure):
    """cosim_linear."""

    _fields_ = (
        *((name, c_int32) for name in ("n", "m", "p")),
        *((name, c_void_p) for name in ("Ad", "B0", "B1", "C", "D", "memory", "substeps")),
        ("n_substeps", c_int32),
        ("dynamics", c_void_p),
    )


class DelayStruct(ctypes.Structure):
    """cosim_delay."""

    _fields_ = (("steps", c_int32), ("width", c_int32), ("memory", c_void_p))


_HOLDS = (
    *(c_int64, c_int32, c_int32),  # count, n, m
    *(c_void_p, c_void_p, c_void_p, POINTER(c_uint8)),  # A, B, h, held
    *(c_void_p, c_void_p, c_void_p, c_void_p),  # Ad, B0, B1, work
)

declare(
    {
        "cosim_multiply_add": (None, (c_int32, c_int32, c_void_p, c_void_p, c_void_p)),
        "cosim_invert": (c_int32, (c_int32, c_void_p, c_void_p)),
        "cosim_exponential": (None, (c_int32, c_void_p, c_void_p, c_void_p)),
        "cosim_first_order_holds": (None, _HOLDS),
    }
)


@dataclass(frozen=True, slots=True)
class DiscretizedDynamics:
    """The discretized dynamics `x(t+h) = Ad x(t) + B0 u(t) + B1 u(t+h)`.

    Shapes: ``Ad (n, n)``, ``B0 (n, m)``, ``B1 (n, m)``.
    """

    Ad: Matrix
    B0: Matrix
    B1: Matrix


@dataclass(frozen=True, slots=True)
class OtherSteps:
    """What steps need whose lengths are not that of a communication step.

    Parameters
    ----------
    A, B : Matrix, shapes (n, n), (n, m)
        ``x' = A x + B u``.
    held : Mask, shape (m,)
        Inputs with a zero-order hold.
    step : float
        Communication step [s].
    known : mapping of length [s] to DiscretizedDynamics
        Those of other lengths are computed where they come.
    """

    A: Matrix
    B: Matrix
    held: Mask
    step: float
    known: Mapping[float, DiscretizedDynamics]


def first_order_hold(A: Matrix, B: Matrix, h: float, held: Mask) -> DiscretizedDynamics:
    """Discretize `x' = A x + B u` exactly over a step, for linearly interpolated or held inputs.

    Linear interpolation between both ends of the step is the (triangle) first-order hold.

    Parameters
    ----------
    A : Matrix, shape (n, n)
    B : Matrix, shape (n, m)
    h : float
        Communication step [s].
    held : Mask, shape (m,)
        Inputs with a zero-order hold: they keep their value at the start of the step. The others
        are interpolated linearly.
    """
    Ad, B0, B1 = first_order_holds(A, B, np.array([h], np.float64), held)
    return DiscretizedDynamics(Ad[0], B0[0], B1[0])


def first_order_holds(
    A: Matrix, B: Matrix, steps: Vector, held: Mask
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Discretize for many steps: Ad, B0 and B1 of :func:`first_order_hold`, one behind the other.

    Parameters
    ----------
    A : Matrix, shape (n, n)
    B : Matrix, shape (n, m)
    steps : Vector, shape (count,)
        Lengths of the steps [s].
    held : Mask, shape (m,)
    """
    n, m = B.shape
    count = len(steps)
    A = _contiguous(A)
    B = _contiguous(B)
    steps = _contiguous(steps)
    Ad = np.empty((count, n, n))
    B0 = np.empty((count, n, m))
    B1 = np.empty((count, n, m))
    augmented = n + 2 * m
    work = np.empty(4 * augmented**2)
    mask_type = ctypes.c_uint8 * max(m, 1)
    mask = mask_type(*map(int, held))
    inputs = (count, n, m, pointer(A), pointer(B), pointer(steps), mask)
    results = map(pointer, (Ad, B0, B1, work))
    library.cosim_first_order_holds(*inputs, *results)
    return Ad, B0, B1


def matrix_exponential(M: Matrix) -> Matrix:
    """Compute exp(M), shape ``(n, n)``, in a fixed order: the same bits on every processor."""
    M = _contiguous(M)
    E = np.empty_like(M)
    work = np.empty(2 * M.size)
    library.cosim_exponential(len(M), pointer(M), pointer(E), pointer(work))
    return E


def invert(M: Matrix) -> Matrix:
    """Compute the inverse of M, shape ``(n, n)``, in a fixed order.

    Raises
    ------
    numpy.linalg.LinAlgError
        If M is singular.
    """
    eliminated = np.array(M, np.float64, order="C")
    inverse = np.empty_like(eliminated)
    if library.cosim_invert(len(eliminated), pointer(eliminated), pointer(inverse)):
        raise np.linalg.LinAlgError("singular matrix")
    return inverse


def affine(pairs: Sequence[tuple[Matrix, Vector]]) -> Vector:
    """Sum the products of matrices ``(n, m_i)`` and vectors ``(m_i,)`` in a fixed order.

    BLAS would give other bits on other processors.
    """
    first, _ = pairs[0]
    y = np.zeros(first.shape[0])
    for matrix, vector in pairs:
        M = _contiguous(matrix)
        v = _contiguous(vector)
        rows, columns = M.shape
        library.cosim_multiply_add(rows, columns, pointer(M), pointer(v), pointer(y))
    return y


def linear_step(
    discrete: DiscretizedDynamics,
    C: Matrix,
    D: Matrix,
    others: OtherSteps | None = None,
) -> NativeStep:
    """Build the step of a discretized linear system with the outputs `y = C x + D u`.

    Its memory is x, shape ``(n,)``, and as much scratch.

    Parameters
    ----------
    discrete : DiscretizedDynamics
    C, D : Matrix, shapes (n_y, n), (n_y, m)
    others : OtherSteps, optional
        For steps of other lengths; without, there are none.
    """
    n, m = discrete.B0.shape
    n_y = len(C)
    matrices = (discrete.Ad, discrete.B0, discrete.B1, C, D)
    # one behind the other: a thousand small systems would not fit into the cache otherwise
    arrays = _together(*matrices, np.zeros(2 * n + 1))
    memory = arrays[-1]
    state = LinearStruct(n, m, n_y, *map(pointer, arrays))
    keep: list[object] = [*arrays]
    if others is not None:
        structs = _substep_structs(others.known, keep)
        state.substeps = ctypes.addressof(structs)
        state.n_substeps = len(structs)
        dynamics = _dynamics_struct(others, keep)
        state.dynamics = ctypes.addressof(dynamics)
        keep += [structs, dynamics]
    function = address("cosim_linear_step")
    outputs = address("cosim_linear_outputs")
    return NativeStep(
        function,
        state,
        n_y=n_y,
        memory=memory,
        keep=tuple(keep),
        outputs=outputs,
        memory_is_state=True,
    )


def _substep_structs(
    substeps: Mapping[float, DiscretizedDynamics], keep: list[object]
) -> ctypes.Array[SubstepStruct]:
    """Return the structs of discretizations by their steps; ``keep`` gets their memory."""
    structs = (SubstepStruct * len(substeps))()
    for struct, (h, substep) in zip(structs, substeps.items(), strict=True):
        arrays = _together(substep.Ad, substep.B0, substep.B1)
        keep += arrays
        struct.h = h
        struct.Ad, struct.B0, struct.B1 = map(pointer, arrays)
    return structs


def _dynamics_struct(others: OtherSteps, keep: list[object]) -> DynamicsStruct:
    """Return the struct of what is discretized where it is needed; ``keep`` gets its memory."""
    n, m = others.B.shape
    augmented = n + 2 * m
    held = np.array(others.held, np.uint8)
    work = np.zeros(4 * augmented**2)
    results = (np.zeros(n * n), np.zeros(n * m), np.zeros(n * m), work)
    A, B, *memory = _together(others.A, others.B, *results)
    keep += [held, A, B, *memory]
    struct = DynamicsStruct(pointer(A), pointer(B), pointer(held), others.step)
    struct.Ad, struct.B0, struct.B1, struct.work = map(pointer, memory)
    return struct


def delay_step(steps: int, width: int) -> NativeStep:
    """Build a delay of the input by ``steps`` communication steps.

    Its memory is the index of the row due now and a ring of ``steps`` rows.
    """
    memory = np.zeros(1 + steps * width)
    state = DelayStruct(steps, width, pointer(memory))
    function = address("cosim_delay_step")
    outputs = address("cosim_delay_refresh")
    return NativeStep(
        function, state, n_y=width, memory=memory, outputs=outputs, memory_is_state=True
    )


def _contiguous(values: NDArray[Any]) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, np.float64)


def _together(*arrays: NDArray[Any]) -> list[NDArray[np.float64]]:
    """Copy arrays into one piece of memory; return them flat."""
    flat = np.concatenate([np.ravel(array) for array in arrays]).astype(np.float64)
    ends = np.cumsum([np.size(array) for array in arrays])
    return np.split(flat, ends[:-1])
