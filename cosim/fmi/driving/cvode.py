"""CVode of SUNDIALS: backward differentiation formulas of order 1 to 5, for stiff models too.

C. S. Woodward et al., SUNDIALS 7: https://sundials.readthedocs.io, chapter CVODE. The libraries are
those that fmpy brings.
"""

from __future__ import annotations

import platform
from ctypes import CFUNCTYPE, byref, c_double, c_int, c_void_p, cast
from typing import Any, Final, NamedTuple, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError, RunError
from cosim.native.numerics.runge_kutta import RightHandSide

ONE_STEP: Final = 2  # CV_ONE_STEP
FAILED: Final = -1  # return value of a right-hand side that cannot go on
NEVER: Final = -1  # maximum number of warnings


class CVodeState(NamedTuple):
    """What CVode starts from."""

    t: float
    x: Vector
    nominals: Vector


@final
class CVode:
    """CVode behind :class:`cosim.fmi.driving.solvers.Solver`.

    Its state cannot be copied: ``save`` makes it start anew.

    Parameters
    ----------
    f : callable
        x' at t and x.
    n : int
        Number of states, at least 1.
    rtol : float
        Relative tolerance of the state.

    Raises
    ------
    FmuError
        If fmpy has no SUNDIALS libraries for this machine.
    """

    def __init__(self, f: RightHandSide, n: int, *, rtol: float) -> None:
        self._context = c_void_p()  # first: whatever fails below, ``__del__`` finds it
        self._lib = _sundials()
        self._f = f
        self._n = n
        self._rtol = rtol
        self._arrays: dict[int, Vector] = {}  # by address
        self._raised: BaseException | None = None
        self._last_message = ""
        self._memory: Any = None  # of CVode itself, made at the first step
        self._vectors: list[Any] = []
        self._matrix: Any = None
        self._linear_solver: Any = None
        self._create_context()
        self._declare_functions()
        self._create_vectors_and_matrix()
        self.start(0.0, np.zeros(n), np.ones(n))

    def _create_context(self) -> None:
        lib = self._lib
        self._check(lib.SUNContext_Create(lib.SUN_COMM_NULL, byref(self._context)))
        core = lib.libraries.sundials_core
        # Before any other call, as the handler that a context comes with prints.
        core.SUNContext_ClearErrHandlers(self._context)
        # Kept as an attribute: C holds no reference to it.
        self._error_handler = lib.SUNErrHandlerFn(self._keep_message)
        self._check(lib.SUNContext_PushErrHandler(self._context, self._error_handler, None))

    def _declare_functions(self) -> None:
        """Declare the types of what fmpy does not declare."""
        library = self._lib.libraries.sundials_cvode
        self._data_pointer = self._lib.libraries.sundials_core.N_VGetArrayPointer
        self._data_pointer.argtypes = [c_void_p]
        self._data_pointer.restype = c_void_p
        self._set_stop_time = library.CVodeSetStopTime
        self._set_stop_time.argtypes = [c_void_p, c_double]
        self._interpolate = library.CVodeGetDky
        self._interpolate.argtypes = [c_void_p, c_double, c_int, self._lib.N_Vector]
        self._set_max_warnings = library.CVodeSetMaxHnilWarns
        self._set_max_warnings.argtypes = [c_void_p, c_int]

    def _create_vectors_and_matrix(self) -> None:
        lib = self._lib
        self._x = self._new_vector()
        self._atol = self._new_vector()
        self._interpolated = self._new_vector()
        signature = CFUNCTYPE(c_int, c_double, c_void_p, c_void_p, c_void_p)
        self._callback = signature(self._right_hand_side)
        self._matrix = lib.SUNDenseMatrix(self._n, self._n, self._context)
        self._linear_solver = lib.SUNLinSol_Dense(self._x, self._matrix, self._context)

    def _new_vector(self) -> Any:
        vector = self._lib.N_VNew_Serial(self._n, self._context)
        self._vectors.append(vector)
        return vector

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with ``x``."""
        self.restore(CVodeState(t, x, nominals))

    def step(self, t_end: float) -> float:
        """Take one step, to ``t_end`` at most."""
        if self._start_pending:
            self._start_integration()
        reached = c_double()
        # Without a stop time CVode would step beyond t_end and interpolate back.
        self._check(self._set_stop_time(self._memory, t_end))
        flag = self._lib.CVode(self._memory, t_end, self._x, byref(reached), ONE_STEP)
        if self._raised is not None:
            error = self._raised
            self._raised = None
            raise error
        self._check(min(flag, 0))  # positive ones are no failures: CV_TSTOP_RETURN
        self._t = reached.value
        return self._t

    def at(self, t: float) -> Vector:
        """Return the state at a time within the last step."""
        if t == self._t:
            return self._array(self._x).copy()
        self._check(self._interpolate(self._memory, t, 0, self._interpolated))
        return self._array(self._interpolated).copy()

    def save(self) -> CVodeState:
        """Start anew here."""
        if not self._start_pending:
            self.start(self._t, self._array(self._x).copy(), self._start.nominals)
        return self._start

    def restore(self, state: CVodeState) -> None:
        """Start anew where it was saved."""
        self._start = state
        self._start_pending = True

    def _start_integration(self) -> None:
        lib = self._lib
        t, x, nominals = self._start
        self._array(self._x)[:] = x
        self._array(self._atol)[:] = self._rtol * nominals
        if self._memory is None:
            self._memory = lib.CVodeCreate(lib.CV_BDF, self._context)
            callback = cast(self._callback, lib.CVRhsFn)
            self._check(lib.CVodeInit(self._memory, callback, t, self._x))
            self._check(lib.CVodeSVtolerances(self._memory, self._rtol, self._atol))
            self._check(lib.CVodeSetLinearSolver(self._memory, self._linear_solver, self._matrix))
            self._check(self._set_max_warnings(self._memory, NEVER))  # it would print them
        else:
            self._check(lib.CVodeReInit(self._memory, t, self._x))
            self._check(lib.CVodeSVtolerances(self._memory, self._rtol, self._atol))
        self._t = t
        self._start_pending = False

    def _right_hand_side(self, t: float, x: int, dx: int, _: object) -> int:
        """Compute x' for CVode; ``x`` and ``dx`` are addresses of its vectors."""
        try:
            self._at_address(dx)[:] = self._f(t, self._at_address(x))
        except BaseException as error:
            # None can pass through C, not even Ctrl-C: ``step`` raises it again.
            self._raised = error
            return FAILED
        return 0

    def _array(self, vector: Any) -> Vector:
        address = cast(vector, c_void_p).value
        assert address is not None
        return self._at_address(address)

    def _at_address(self, address: int) -> Vector:
        """Return the memory of one of CVode's vectors, which stay where they are."""
        array = self._arrays.get(address)
        if array is None:
            memory: Any = (c_double * self._n).from_address(self._data_pointer(address))
            array = np.frombuffer(memory, np.float64)
            self._arrays[address] = array
        return array

    def _keep_message(
        self, line: int, function: bytes, file: bytes, message: bytes, *_: object
    ) -> None:
        """Keep an error message of CVode for the exception that follows."""
        self._last_message = message.decode("utf-8", "replace")

    def _check(self, status: int) -> None:
        if status != 0:
            raise RunError(f"solver CVode: {self._last_message or f'status {status}'}")

    def __del__(self) -> None:
        if not self._context:
            return
        lib = self._lib
        core = lib.libraries.sundials_core
        if self._memory is not None:
            lib.CVodeFree(byref(c_void_p(self._memory)))
        # The context last: all the others were made in it.
        if self._linear_solver is not None:
            core.SUNLinSolFree(c_void_p(self._linear_solver))
        if self._matrix is not None:
            core.SUNMatDestroy(c_void_p(self._matrix))
        for vector in self._vectors:
            lib.N_VDestroy_Serial(vector)
        core.SUNContext_Free(byref(self._context))


def _sundials() -> Any:
    """Return fmpy's binding of SUNDIALS."""
    try:
        from fmpy import sundials
    except Exception as error:
        # No library for this machine: OSError. Another version of it: fmpy's bare Exception.
        machine = f"{platform.machine()}-{platform.system().lower()}"
        raise FmuError(
            f"solver 'CVode': fmpy has no SUNDIALS libraries for {machine} ({error}); "
            "use 'BDF' or 'Radau' for stiff models, else 'DOP853'"
        ) from error
    return sundials
