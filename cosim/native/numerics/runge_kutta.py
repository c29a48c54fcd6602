"""Explicit Runge-Kutta methods: the kernel of ``runge_kutta.c`` for functions in Python."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import CFUNCTYPE, POINTER, byref, c_char_p, c_double, c_int32, c_int64, c_void_p
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.errors import RunError
from cosim.native.library import declare, library, pointer

FIXED_STEP: Final = ("euler", "rk4")  # take the steps they are given
EMBEDDED: Final = ("RK23", "RK45", "DOP853")  # estimate their error and keep to a tolerance
EXPLICIT: Final = (*FIXED_STEP, *EMBEDDED)

RightHandSide: TypeAlias = Callable[[float, Vector], Vector]  # (t, x) -> x'

STEP_TOO_SMALL: Final = 2  # COSIM_STEP_TOO_SMALL
FAILED: Final = -1  # of a right-hand side that raised
NUMBER: Final = 8  # bytes
TIME: Final = 1  # where the time reached stands in the memory
PROPOSED: Final = 2  # where the step stands that the tolerance allows
NUMBERS: Final = 5  # that stand before vectors of n
STATE: Final = 2  # which of those is the state reached

_RIGHT_HAND_SIDE: Final = CFUNCTYPE(c_int32, c_void_p, c_double, c_void_p, c_void_p)


class MethodStruct(ctypes.Structure):
    """cosim_method."""

    _fields_ = (
        *((name, c_int32) for name in ("stages", "extra", "dense", "root")),
        *((name, c_void_p) for name in ("c", "a", "e", "e_low", "d")),
    )


class RungeKuttaStruct(ctypes.Structure):
    """cosim_runge_kutta."""

    _fields_ = (
        *((name, c_void_p) for name in ("method", "f", "model")),
        ("n", c_int32),
        ("rtol", c_double),
        ("evaluations", c_int64),
        ("memory", c_void_p),
    )


_METHOD = POINTER(MethodStruct)

declare(
    {
        "cosim_method_named": (c_int32, (c_char_p, _METHOD)),
        "cosim_runge_kutta_memory": (c_int64, (_METHOD, c_int32)),
        "cosim_runge_kutta_start": (c_int32, (c_void_p, c_double, c_void_p, c_void_p)),
        "cosim_runge_kutta_step": (c_int32, (c_void_p, c_double, POINTER(c_double))),
        "cosim_runge_kutta_at": (c_int32, (c_void_p, c_double, c_void_p)),
    }
)


@final
class RungeKutta:
    """An explicit Runge-Kutta method; see :class:`cosim.fmi.driving.solvers.Solver`.

    A method that takes the steps it is given goes to wherever a step may end, and a state within it
    is that of a shorter step; the others interpolate.

    Parameters
    ----------
    method : str
        One of ``EXPLICIT``.
    f : callable
        x' at t and x; it must not keep x, which is memory of the solver.
    n : int
        Number of states, at least 1.
    rtol : float
        Relative tolerance of the state.
    """

    def __init__(self, method: str, f: RightHandSide, n: int, *, rtol: float) -> None:
        self._tableau = MethodStruct()
        unknown = library.cosim_method_named(method.encode(), byref(self._tableau))
        assert not unknown
        numbers = library.cosim_runge_kutta_memory(byref(self._tableau), n)
        self._method = method
        self._f = f
        self._n = n
        self._memory = np.zeros(numbers)
        self._begin = self._memory.ctypes.data
        self._vectors: dict[int, Vector] = {}  # within the memory, by address
        self._raised: BaseException | None = None
        self._reached = c_double()
        # C holds no reference to it.
        self._callback = _RIGHT_HAND_SIDE(self._evaluate)
        function = ctypes.cast(self._callback, c_void_p)
        tableau = ctypes.addressof(self._tableau)
        self._state = RungeKuttaStruct(tableau, function, None, n, rtol, 0, self._begin)
        self._completed = 0  # evaluations, as Python counts them
        self._address = ctypes.addressof(self._state)
        self.start(0.0, np.zeros(n), np.ones(n))

    @property
    def evaluations(self) -> int:
        """The number of evaluations of f so far."""
        return self._completed

    @property
    def x(self) -> NDArray[np.float64]:
        """The state reached, shape (n,), to read and to write."""
        first = NUMBERS + STATE * self._n
        return self._memory[first : first + self._n]

    @property
    def proposed(self) -> float:
        """The step that its tolerance allows [s], after a step that may have been cut short."""
        return float(self._memory[PROPOSED])

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` [s] with ``x``."""
        begin = np.ascontiguousarray(x, np.float64)
        scale = np.ascontiguousarray(nominals, np.float64)
        library.cosim_runge_kutta_start(self._address, t, pointer(begin), pointer(scale))

    def step(self, t_end: float) -> float:
        """Take one step, to ``t_end`` at most; return the time reached.

        Raises
        ------
        RunError
            If the tolerance needs a step below the spacing of numbers.
        """
        status = library.cosim_runge_kutta_step(self._address, t_end, byref(self._reached))
        self._check(status)
        if status == STEP_TOO_SMALL:
            raise self.too_small_a_step()
        return self._reached.value

    def too_small_a_step(self) -> RunError:
        """Return the error of a tolerance that needs too small a step where it is now."""
        return RunError(
            f"solver {self._method}: at t = {self._memory[TIME]} s the tolerance requires steps "
            "below floating-point resolution"
        )

    def compiled(self, f: int, model: int) -> RungeKuttaStruct:
        """Return the same solver, in the same state, of a compiled right-hand side.

        Parameters
        ----------
        f : int
            Address of a ``cosim_right_hand_side``.
        model : int
            Its first argument.
        """
        tableau = ctypes.addressof(self._tableau)
        return RungeKuttaStruct(tableau, f, model, self._n, self._state.rtol, 0, self._begin)

    def at(self, t: float) -> Vector:
        """Return the state at a time within the last step, shape (n,)."""
        x = np.empty(self._n)
        self._check(library.cosim_runge_kutta_at(self._address, t, pointer(x)))
        return x

    def save(self) -> Vector:
        """Copy the state."""
        return self._memory.copy()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._memory[:] = state

    def _check(self, status: int) -> None:
        """Raise what the right-hand side raised: it could not pass through C."""
        if self._state.evaluations != self._completed:
            # Ctrl-C came before the first statement of ``_evaluate``, where ctypes drops it.
            self._completed = self._state.evaluations
            raise KeyboardInterrupt
        error = self._raised
        if status == FAILED and error is not None:
            self._raised = None
            raise error

    def _evaluate(self, _: int | None, t: float, x: int, dx: int) -> int:
        """Compute x' for the kernel; ``x`` and ``dx`` are addresses in its memory."""
        try:
            self._vector(dx)[:] = self._f(t, self._vector(x))
        except BaseException as error:
            self._raised = error
            return FAILED
        finally:
            self._completed += 1
        return 0

    def _vector(self, address: int) -> Vector:
        vector = self._vectors.get(address)
        if vector is None:
            first = (address - self._begin) // NUMBER
            vector = self._memory[first : first + self._n]
            self._vectors[address] = vector
        return vector
