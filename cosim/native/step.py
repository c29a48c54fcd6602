"""A component's C step function bound to its state, and the kernels that are there."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref, c_int32
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.expression import Program
from cosim.native.library import (
    DelayStruct,
    ExpressionStruct,
    LeastSquaresStruct,
    LinearStruct,
    ProgramStruct,
    RecoveryStruct,
    RegressorStruct,
    address,
    int32,
    library,
    pointer,
)

NO_VALUE = 1  # COSIM_NO_VALUE


class NativeStep:
    """A step function of the C signature of ``cosim.h`` with its state.

    Parameters
    ----------
    function : int
        Address of the step function.
    state : ctypes.Structure
        What ``self`` points to.
    n_y : int
        Number of outputs it writes.
    memory : Vector
        All of its changing state.
    keep : sequence of object
        Arrays that ``state`` points into.
    """

    def __init__(
        self,
        function: int,
        state: ctypes.Structure,
        *,
        n_y: int,
        memory: Vector,
        keep: Sequence[object] = (),
    ) -> None:
        self.function = function
        self.state = state
        self.n_y = n_y
        self.memory = memory
        self.status = 0
        self._address = ctypes.addressof(state)
        self._keep = tuple(keep)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance over the K steps between the K+1 times ``t``; fewer rows than K: stopped there, the reason in ``status``."""
        steps = len(t) - 1
        if u.strides[-1] != 8 and u.shape[1] > 1:
            u = np.ascontiguousarray(u)
        y = np.empty((steps, self.n_y))
        status = c_int32()
        done: int = library.cosim_cascade(
            self.function,
            self._address,
            steps,
            t.ctypes.data,
            h,
            u.ctypes.data,
            u.strides[0] // 8,
            y.ctypes.data,
            self.n_y,
            byref(status),
        )
        self.status = status.value
        return y[:done]

    def save(self) -> Vector:
        """Copy the state."""
        return self.memory.copy()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self.memory[:] = state


@dataclass(frozen=True, slots=True)
class DiscretizedDynamics:
    """x(t+h) = Ad x(t) + B0 u(t) + B1 u(t+h), exact for straight-line (or held) inputs."""

    Ad: Matrix
    B0: Matrix
    B1: Matrix


def first_order_hold(A: Matrix, B: Matrix, h: float, held: Mask) -> DiscretizedDynamics:
    """Discretize x' = A x + B u exactly over a step of ``h`` seconds.

    Parameters
    ----------
    A : Matrix, shape (n, n)
    B : Matrix, shape (n, m)
    h : float
        Communication step [s].
    held : Mask, shape (m,)
        Inputs that keep their value at the start of the step; the others move in straight lines.
    """
    n, m = B.shape
    A, B = np.ascontiguousarray(A, np.float64), np.ascontiguousarray(B, np.float64)
    Ad, B0, B1 = np.empty((n, n)), np.empty((n, m)), np.empty((n, m))
    work = np.empty(4 * (n + 2 * m) ** 2)
    mask = (ctypes.c_uint8 * max(m, 1))(*map(int, held))
    library.cosim_first_order_hold(
        n, m, pointer(A), pointer(B), h, mask, pointer(Ad), pointer(B0), pointer(B1), pointer(work)
    )
    return DiscretizedDynamics(Ad, B0, B1)


def matrix_exponential(M: Matrix) -> Matrix:
    """Matrix exponential in fixed order: the same bits on every processor."""
    M = np.ascontiguousarray(M, np.float64)
    E, work = np.empty_like(M), np.empty(2 * M.size)
    library.cosim_exponential(len(M), pointer(M), pointer(E), pointer(work))
    return E


def affine(pairs: Sequence[tuple[Matrix, Vector]]) -> Vector:
    """Sum of matrix-vector products in fixed order, without BLAS."""
    y = np.zeros(pairs[0][0].shape[0])
    for M, v in pairs:
        M, v = np.ascontiguousarray(M, np.float64), np.ascontiguousarray(v, np.float64)
        library.cosim_multiply_add(M.shape[0], M.shape[1], pointer(M), pointer(v), pointer(y))
    return y


def linear_step(discrete: DiscretizedDynamics, C: Matrix, D: Matrix) -> NativeStep:
    """Step a discretized linear system; memory: x (n), scratch (n)."""
    arrays = [
        np.ascontiguousarray(M, np.float64) for M in (discrete.Ad, discrete.B0, discrete.B1, C, D)
    ]
    memory = np.zeros(2 * len(discrete.Ad) + 1)
    n, m, p = len(discrete.Ad), discrete.B0.shape[1], len(C)
    state = LinearStruct(n, m, p, *map(pointer, arrays), pointer(memory))
    return NativeStep(address("cosim_linear_step"), state, n_y=p, memory=memory, keep=arrays)


def delay_step(steps: int, width: int) -> NativeStep:
    """Give the input ``steps`` communication steps later; memory: the row due now, ring of ``steps`` rows."""
    memory = np.zeros(1 + steps * width)
    return NativeStep(
        address("cosim_delay_step"),
        DelayStruct(steps, width, pointer(memory)),
        n_y=width,
        memory=memory,
    )


def evaluate(program: Program, t: float) -> float:
    """Evaluate an expression at one instant."""
    value: float = library.cosim_evaluate(ctypes.byref(_program(program)), t)
    return value


def _program(program: Program) -> ProgramStruct:
    return ProgramStruct(len(program.code), pointer(program.code), pointer(program.constants))


def _programs(programs: Sequence[Program]) -> ctypes.Array[ProgramStruct]:
    return (ProgramStruct * max(len(programs), 1))(*map(_program, programs))


def expression_step(programs: Sequence[Program]) -> NativeStep:
    """Give the values of expressions in t; no memory."""
    array = _programs(programs)
    state = ExpressionStruct(len(programs), ctypes.addressof(array))
    return NativeStep(
        address("cosim_expression_step"),
        state,
        n_y=len(programs),
        memory=np.zeros(0),
        keep=(array, *programs),
    )


@dataclass(frozen=True, slots=True)
class RegressorConstants:
    """What a regressor is made of: the numbers of cosim_regressor.

    Parameters
    ----------
    alphas : sequence of Program
        The distinct known functions, one a block.
    steps, delays : sequence of int, of float
        The delays in communication steps and in seconds.
    row, factor, sign : arrays, shapes (terms,), (terms, factors), (terms,)
        Row of delta; rows of the alphas as ``block * rows + row``; sign.
    """

    alphas: Sequence[Program]
    steps: Sequence[int]
    delays: Sequence[float]
    row: NDArray[np.integer]
    factor: NDArray[np.integer]
    sign: NDArray[np.floating]

    @property
    def memory(self) -> int:
        """Number of doubles that change."""
        return 1 + max(self.steps) + len(self.alphas) * len(self.steps)


class RegressorStep:
    """The products mu (21)-(25) over a ring of delayed samples."""

    def __init__(self, constants: RegressorConstants) -> None:
        programs = _programs(constants.alphas)
        arrays: tuple[NDArray[Any], ...] = (
            int32(constants.steps),
            np.array(constants.delays, np.float64),
            int32(constants.row),
            int32(constants.factor),
            np.array(constants.sign, np.float64),
        )
        memory = np.zeros(constants.memory)
        terms, factors = np.shape(constants.factor)
        lags, seconds, rows, table, signs = map(pointer, arrays)
        state = RegressorStruct(
            len(constants.steps),
            len(constants.alphas),
            terms,
            factors,
            lags,
            seconds,
            ctypes.addressof(programs),
            rows,
            table,
            signs,
            pointer(memory),
        )
        self.step = NativeStep(
            address("cosim_regressor_step"),
            state,
            n_y=terms,
            memory=memory,
            keep=(programs, *constants.alphas, *arrays),
        )

    def reset(self) -> None:
        """Forget the past."""
        self.step.memory[:] = 0.0

    def outputs(self, t: float, delta: float) -> Vector:
        """Give mu at ``t``, the instant reached, where the signal is ``delta``."""
        y = np.empty(self.step.n_y)
        library.cosim_regressor_outputs(ctypes.addressof(self.step.state), t, delta, pointer(y))
        return y


@dataclass(frozen=True, slots=True)
class RecoveryConstants:
    """How theta of one block follows from the estimates: sum_k sign_k chi[index_k] f(t - D - k spacing) = 0.

    ``kind``: 1 one exponential, 2 two exponentials, 3 one sine. ``theta``: where the results belong.
    """

    kind: int
    index: tuple[int, ...]
    theta: tuple[int, ...]
    sign: tuple[float, ...]
    spacing: float


@dataclass(frozen=True, slots=True)
class LeastSquaresConstants:
    """What an identifier is made of: the numbers of cosim_least_squares.

    Parameters
    ----------
    unknowns : int
        Number of eta, q.
    start : float
        First instant that counts [s].
    information : float
        1/P0, before the data; 0: none.
    recovery : sequence of RecoveryConstants
    held : bool
        Rows hold over a step (rectangle) instead of moving in straight lines (trapezoid).
    """

    unknowns: int
    start: float
    information: float
    recovery: Sequence[RecoveryConstants]
    held: bool

    @property
    def parameters(self) -> int:
        """Number of theta."""
        return sum(len(step.theta) for step in self.recovery)

    @property
    def prior(self) -> float:
        """Square root of the information before the data."""
        return float(np.sqrt(self.information))

    @property
    def memory(self) -> int:
        """Number of doubles that change."""
        return (self.unknowns + 1) * (self.unknowns + 2)


class LeastSquares:
    """Least squares (33)-(35) in information form, accumulated by Givens rotations."""

    def __init__(self, constants: LeastSquaresConstants) -> None:
        recovery = constants.recovery
        plans = (RecoveryStruct * max(len(recovery), 1))()
        for plan, step in zip(plans, recovery, strict=False):
            plan.kind, plan.spacing = step.kind, step.spacing
            plan.index[: len(step.index)] = step.index
            plan.theta[: len(step.theta)] = step.theta
            plan.sign[: len(step.sign)] = step.sign
        memory = np.zeros(constants.memory)
        state = LeastSquaresStruct(
            constants.unknowns,
            len(recovery),
            constants.parameters,
            int(constants.held),
            constants.start,
            constants.prior,
            ctypes.addressof(plans),
            pointer(memory),
        )
        n_y = constants.parameters + constants.unknowns
        self.step = NativeStep(
            address("cosim_least_squares_step"), state, n_y=n_y, memory=memory, keep=(plans,)
        )

    def initialize(self) -> Vector:
        """Forget the past; there is no estimate yet."""
        y = np.empty(self.step.n_y)
        library.cosim_least_squares_start(ctypes.addressof(self.step.state), pointer(y))
        return y
