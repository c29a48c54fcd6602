"""A component's C step function bound to its state, and the kernels of the package."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from ctypes import byref, c_double, c_int32, c_void_p
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.estimation.alphas import PastAlphas, program_array, program_struct
from cosim.native.library import (
    DelayStruct,
    ExpressionStruct,
    LeastSquaresStruct,
    LinearStruct,
    RecoveryStruct,
    RegressorStruct,
    address,
    int32,
    library,
    pointer,
)
from cosim.native.numerics.expression import Program

NO_VALUE = 1  # COSIM_NO_VALUE
FULL = 5  # COSIM_FULL
OUTSIDE = 6  # COSIM_OUTSIDE
DOUBLE = 8  # bytes
WORDS_PER_NORMAL = 2  # random words that one Gaussian number takes
LARGEST_MEMORY = 2**27  # values in a component's memory or in a matrix, 1 GiB


# cosim_outputs of stage.h
_OUTPUTS: Final = ctypes.CFUNCTYPE(c_int32, c_void_p, c_double, c_void_p, c_void_p)


class Guard(Protocol):
    """Puts back what steps of foreign code change of the process that they run in."""

    @property
    def binaries(self) -> frozenset[str]:
        """What the code is known by: no two threads may be in one at once."""
        ...

    def begin(self) -> None:
        """Remember the process before a call of compiled code that does many steps."""
        ...

    def end(self, t: float) -> None:
        """Put back and report what that call changed; it began at ``t`` [s]."""
        ...

    def joined(self, others: Sequence[Guard]) -> Guard:
        """Return one for the steps of all."""
        ...


class NativeStep:
    """A step function of the C signature of ``cosim.h`` with its state.

    Parameters
    ----------
    function : int
        Address of the step function.
    state : ctypes.Structure
        The constants and pointers that ``self`` points to.
    n_y : int
        Number of outputs that it writes.
    memory : Vector
        All of its changing state.
    keep : sequence of object
        Arrays that ``state`` points into; they live as long as the step.
    outputs : int
        Address of a function that evaluates the outputs again (``cosim_outputs`` of ``stage.h``);
        0: there is none.
    guard : Guard or None
        Of foreign code.

    Attributes
    ----------
    address : int
        Of ``state``.
    """

    def __init__(
        self,
        function: int,
        state: ctypes.Structure,
        *,
        n_y: int,
        memory: Vector,
        keep: Sequence[object] = (),
        outputs: int = 0,
        guard: Guard | None = None,
    ) -> None:
        self.function = function
        self.guard = guard
        self.outputs = outputs
        self.state = state
        self.n_y = n_y
        self.memory = memory
        self.status = 0
        self.address = ctypes.addressof(state)
        self._keep = tuple(keep)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance over K communication steps of ``h`` seconds.

        Parameters
        ----------
        t : Vector
            Communication points [s], shape ``(K + 1,)``.
        h : float
            Communication step [s].
        u : Matrix
            Inputs at these points, shape ``(K + 1, n_u)``.

        Returns
        -------
        Matrix
            Outputs at ``t[1:]``, shape ``(K, n_y)``; fewer rows where it stopped before the end,
            for the reason in ``status``.
        """
        steps = len(t) - 1
        n_u = u.shape[1]
        if u.strides[-1] != DOUBLE and n_u > 1:
            u = np.ascontiguousarray(u)
        y = np.empty((steps, self.n_y))
        status = c_int32()
        step = (self.function, self.address)
        points = (steps, t.ctypes.data, h)
        row_distance = u.strides[0] // DOUBLE
        inputs = (u.ctypes.data, row_distance)
        outputs = (y.ctypes.data, self.n_y)
        with self._guarded(float(t[0])):
            completed: int = library.cosim_cascade(*step, *points, *inputs, *outputs, byref(status))
        self.status = status.value
        return y[:completed]

    def advance_through(
        self, t: Vector, h: float, u: Matrix, resume: Callable[[int], None]
    ) -> Matrix:
        """Advance over K communication steps, also behind those that the function declines.

        Parameters are those of :meth:`advance`; ``resume`` is called with the number of a step that
        was declined, and makes it possible.

        Returns
        -------
        Matrix
            Outputs at ``t[1:]``, shape ``(K, n_y)``.
        """
        steps = len(t) - 1
        rows = np.empty((steps, self.n_y))
        completed = 0
        while completed < steps:
            y = self.advance(t[completed:], h, u[completed:])
            end = completed + len(y)
            rows[completed:end] = y
            completed = end
            if self.status:
                resume(completed)
        return rows

    def outputs_at(self, t: float, u: Vector) -> Vector | None:
        """Return the outputs at ``t`` [s], the time reached, for inputs ``u``.

        None: there is no function that evaluates them, or it declines.
        """
        if not self.outputs:
            return None
        inputs = _contiguous(u)
        y = np.empty(self.n_y)
        with self._guarded(t):
            status = _OUTPUTS(self.outputs)(self.address, t, pointer(inputs), pointer(y))
        return None if status else y

    @contextmanager
    def _guarded(self, t: float) -> Iterator[None]:
        """Put back what foreign code changes of the process in a call that begins at ``t`` [s]."""
        if self.guard is None:
            yield
            return
        self.guard.begin()
        try:
            yield
        finally:
            self.guard.end(t)

    def save(self) -> Vector:
        """Copy the state."""
        return self.memory.copy()

    def restore(self, state: Vector) -> None:
        """Return to a saved state."""
        self.memory[:] = state


@dataclass(frozen=True, slots=True)
class DiscretizedDynamics:
    """The discretized dynamics `x(t+h) = Ad x(t) + B0 u(t) + B1 u(t+h)`.

    Shapes: ``Ad (n, n)``, ``B0 (n, m)``, ``B1 (n, m)``.
    """

    Ad: Matrix
    B0: Matrix
    B1: Matrix


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


def linear_step(discrete: DiscretizedDynamics, C: Matrix, D: Matrix) -> NativeStep:
    """Build the step of a discretized linear system with the outputs `y = C x + D u`.

    Its memory is x, shape ``(n,)``, and as much scratch.
    """
    n, m = discrete.B0.shape
    n_y = len(C)
    matrices = (discrete.Ad, discrete.B0, discrete.B1, C, D)
    # one behind the other: a thousand small systems would not fit into the cache otherwise
    arrays = _together(*matrices, np.zeros(2 * n + 1))
    memory = arrays[-1]
    state = LinearStruct(n, m, n_y, *map(pointer, arrays))
    function = address("cosim_linear_step")
    outputs = address("cosim_linear_outputs")
    return NativeStep(function, state, n_y=n_y, memory=memory, keep=arrays, outputs=outputs)


def delay_step(steps: int, width: int) -> NativeStep:
    """Build a delay of the input by ``steps`` communication steps.

    Its memory is the index of the row due now and a ring of ``steps`` rows.
    """
    memory = np.zeros(1 + steps * width)
    state = DelayStruct(steps, width, pointer(memory))
    function = address("cosim_delay_step")
    outputs = address("cosim_delay_refresh")
    return NativeStep(function, state, n_y=width, memory=memory, outputs=outputs)


def evaluate(program: Program, t: float) -> float:
    """Evaluate an expression at the instant ``t`` [s]."""
    struct = program_struct(program)
    value: float = library.cosim_evaluate(byref(struct), t)
    return value


def evaluate_at(programs: Sequence[Program], t: Vector) -> Matrix:
    """Evaluate expressions at instants ``t (N,)`` [s], shape ``(N, len(programs))``."""
    step = expression_step(programs)
    no_inputs = np.zeros((len(t) + 1, 0))
    ends_of_steps = np.concatenate([[0.0], t])  # where the first one begins does not matter
    return step.advance(ends_of_steps, 0.0, no_inputs)


def expression_step(programs: Sequence[Program]) -> NativeStep:
    """Build the step whose outputs are expressions in t; it has no memory."""
    n_y = len(programs)
    array = program_array(programs)
    state = ExpressionStruct(n_y, ctypes.addressof(array))
    function = address("cosim_expression_step")
    outputs = address("cosim_expression_refresh")
    no_memory = np.zeros(0)
    keep = (array, *programs)
    return NativeStep(function, state, n_y=n_y, memory=no_memory, keep=keep, outputs=outputs)


def normal(words: NDArray[np.uint64]) -> Vector:
    """Compute Gaussian numbers of mean 0 and deviation 1 from random words, two for each.

    numpy's own take the logarithm of the C library, and may change with its version.
    """
    count = len(words) // WORDS_PER_NORMAL
    y = np.empty(count)
    library.cosim_normal(count, pointer(words), pointer(y))
    return y


def _contiguous(values: NDArray[Any]) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, np.float64)


def _together(*arrays: NDArray[Any]) -> list[NDArray[np.float64]]:
    """Copy arrays into one piece of memory; return them flat."""
    flat = np.concatenate([np.ravel(array) for array in arrays]).astype(np.float64)
    ends = np.cumsum([np.size(array) for array in arrays])
    return np.split(flat, ends[:-1])


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
