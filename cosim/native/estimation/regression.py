"""The regression (21)-(25), and its least squares (33)-(35): ``regression.c``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import c_double, c_int32, c_void_p
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.native.estimation.alphas import PastAlphas
from cosim.native.library import address, declare, int32, library, pointer
from cosim.native.step import NativeStep


class RegressorStruct(ctypes.Structure):
    """cosim_regressor."""

    _fields_ = (
        *((name, c_int32) for name in ("rows", "terms", "factors")),
        *((name, c_void_p) for name in ("steps", "alphas", "row", "factor", "sign", "memory")),
    )


class RecoveryStruct(ctypes.Structure):
    """cosim_recovery."""

    _fields_ = (
        ("kind", c_int32),
        ("index", c_int32 * 3),
        ("theta", c_int32 * 2),
        ("sign", c_double * 3),
        ("spacing", c_double),
    )


class LeastSquaresStruct(ctypes.Structure):
    """cosim_least_squares."""

    _fields_ = (
        *((name, c_int32) for name in ("unknowns", "groups", "parameters", "held")),
        ("start", c_double),
        ("prior", c_double),
        ("recovery", c_void_p),
        ("memory", c_void_p),
    )


declare(
    {
        "cosim_regressor_outputs": (None, (c_void_p, c_double, c_void_p, c_void_p)),
        "cosim_least_squares_start": (None, (c_void_p, c_void_p)),
    }
)


@dataclass(frozen=True, slots=True)
class RegressorConstants:
    """The numbers of cosim_regressor.

    Parameters
    ----------
    alphas : PastAlphas
        The distinct known factors, one a group, a delay and the lag of delta ago.
    steps : sequence of int
        The delays in communication steps.
    row : array of int, shape (terms,)
        Row of delta.
    factor : array of int, shape (terms, factors)
        Rows of the alphas as ``group * rows + row``.
    sign : array of float, shape (terms,)
        Sign of each term.
    """

    alphas: PastAlphas
    steps: Sequence[int]
    row: NDArray[np.integer]
    factor: NDArray[np.integer]
    sign: NDArray[np.floating]

    @property
    def memory(self) -> int:
        """The number of doubles that change."""
        ring = max(self.steps)
        scratch = len(self.alphas.alphas) * len(self.steps)
        return 1 + ring + scratch + self.alphas.memory


def regressor_struct(
    constants: RegressorConstants, memory: Vector
) -> tuple[RegressorStruct, tuple[object, ...]]:
    """Return cosim_regressor, and what must outlive it."""
    alphas, keep_alphas = constants.alphas.struct()
    steps = int32(constants.steps)
    row = int32(constants.row)
    factor = int32(constants.factor)
    sign = np.array(constants.sign, np.float64)
    n_terms, n_factors = np.shape(constants.factor)
    products = (pointer(row), pointer(factor), pointer(sign))
    state = RegressorStruct(
        len(constants.steps),
        n_terms,
        n_factors,
        pointer(steps),
        ctypes.addressof(alphas),
        *products,
        pointer(memory),
    )
    return state, (alphas, *keep_alphas, steps, row, factor, sign, memory)


class RegressorStep:
    """The products mu (21)-(25) over a ring of delayed samples."""

    def __init__(self, constants: RegressorConstants) -> None:
        memory = np.zeros(constants.memory)
        state, keep = regressor_struct(constants, memory)
        function = address("cosim_regressor_step")
        outputs = address("cosim_regressor_refresh")
        self.step = NativeStep(
            function, state, n_y=state.terms, memory=memory, keep=keep, outputs=outputs
        )

    def reset(self) -> None:
        """Forget the past."""
        self.step.memory[:] = 0.0

    def outputs(self, t: float, u: Vector) -> Vector:
        """Compute mu at the time reached ``t`` [s], from delta and the signals among the alphas."""
        y = np.empty(self.step.n_y)
        u = np.ascontiguousarray(u, np.float64)
        state = ctypes.addressof(self.step.state)
        library.cosim_regressor_outputs(state, t, pointer(u), pointer(y))
        return y


@dataclass(frozen=True, slots=True)
class RecoveryConstants:
    """How theta of one group follows from the estimates: the numbers of cosim_recovery.

    The recurrence is `sum_k sign_k chi[index_k] f(t - D - k spacing) = 0`.

    Parameters
    ----------
    kind : int
        1 one exponential, 2 two exponentials, 3 one sine.
    index : tuple of int
        Indices into chi.
    theta : tuple of int
        Where the results belong.
    sign : tuple of float
        Signs of the terms.
    spacing : float
        Distance of neighboring delays [s].
    """

    kind: int
    index: tuple[int, ...]
    theta: tuple[int, ...]
    sign: tuple[float, ...]
    spacing: float


@dataclass(frozen=True, slots=True)
class LeastSquaresConstants:
    """The numbers of cosim_least_squares.

    Parameters
    ----------
    unknowns : int
        Number of eta, q.
    start_time : float
        First instant that counts [s].
    information : float
        1/P0, before the data; 0: none.
    recovery : sequence of RecoveryConstants
        The formulas of theta.
    held : bool
        Rows have a zero-order hold (rectangle rule) instead of linear interpolation (trapezoid
        rule).
    """

    unknowns: int
    start_time: float
    information: float
    recovery: Sequence[RecoveryConstants]
    held: bool

    @property
    def parameters(self) -> int:
        """The number of theta."""
        return sum(len(formula.theta) for formula in self.recovery)

    @property
    def prior(self) -> float:
        """The square root of the information before the data."""
        return float(np.sqrt(self.information))

    @property
    def memory(self) -> int:
        """The number of doubles that change."""
        return (self.unknowns + 1) * (self.unknowns + 2)


class LeastSquares:
    """Least squares (33)-(35) in information form, accumulated by Givens rotations."""

    def __init__(self, constants: LeastSquaresConstants) -> None:
        recovery = constants.recovery
        formulas = recovery_array(recovery)
        memory = np.zeros(constants.memory)
        n_eta = constants.unknowns
        n_theta = constants.parameters
        held = int(constants.held)
        state = LeastSquaresStruct(
            n_eta, len(recovery), n_theta, held, constants.start_time, constants.prior
        )
        state.recovery = ctypes.addressof(formulas)
        state.memory = pointer(memory)
        n_y = n_theta + n_eta
        function = address("cosim_least_squares_step")
        self.step = NativeStep(function, state, n_y=n_y, memory=memory, keep=(formulas,))

    def initialize(self) -> Vector:
        """Forget the past and return the outputs, which have no value yet."""
        y = np.empty(self.step.n_y)
        state = ctypes.addressof(self.step.state)
        library.cosim_least_squares_start(state, pointer(y))
        return y


def recovery_array(recovery: Sequence[RecoveryConstants]) -> ctypes.Array[RecoveryStruct]:
    """Return the structs of formulas."""
    array_type = RecoveryStruct * max(len(recovery), 1)
    formulas = array_type()
    for formula, numbers in zip(formulas, recovery, strict=False):
        formula.kind = numbers.kind
        formula.spacing = numbers.spacing
        formula.index[: len(numbers.index)] = numbers.index
        formula.theta[: len(numbers.theta)] = numbers.theta
        formula.sign[: len(numbers.sign)] = numbers.sign
    return formulas
