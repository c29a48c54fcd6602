"""CVode of SUNDIALS, in the libraries that fmpy brings: backward differentiation formulas of order 1 to 5, for stiff models too.

C. S. Woodward et al., SUNDIALS 7: https://sundials.readthedocs.io, chapter CVODE.
"""

from __future__ import annotations

import platform
from ctypes import CFUNCTYPE, byref, c_double, c_int, c_void_p, cast
from typing import Any, Final, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError, RunError
from cosim.fmi.driving.solvers import Slope

ONE_STEP: Final = 2  # CV_ONE_STEP
FAILED: Final = -1  # what a right-hand side answers that cannot go on


@final
class CVode:
    """CVode behind :class:`cosim.core.linear.Solver`. Its state cannot be copied: ``save`` makes it start anew.

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

    def __init__(self, f: Slope, n: int, *, rtol: float) -> None:
        self._lib = lib = _sundials()
        self._f, self._n, self._rtol = f, n, rtol
        self._arrays: dict[int, Vector] = {}
        self._raised: BaseException | None = None
        self._words = ""
        self._context, self._memory = c_void_p(), None
        self._check(lib.SUNContext_Create(lib.SUN_COMM_NULL, byref(self._context)))
        core, library = lib.libraries.sundials_core, lib.libraries.sundials_cvode
        core.SUNContext_ClearErrHandlers(self._context)  # the first one prints
        self._hear = lib.SUNErrHandlerFn(self._listen)
        self._check(lib.SUNContext_PushErrHandler(self._context, self._hear, None))
        self._data = core.N_VGetArrayPointer
        self._data.argtypes, self._data.restype = [c_void_p], c_void_p
        self._stop, self._dense, self._warn = (
            library.CVodeSetStopTime,
            library.CVodeGetDky,
            library.CVodeSetMaxHnilWarns,
        )
        self._stop.argtypes, self._dense.argtypes = (
            [c_void_p, c_double],
            [c_void_p, c_double, c_int, lib.N_Vector],
        )
        self._warn.argtypes = [c_void_p, c_int]
        self._x, self._atol, self._within = (lib.N_VNew_Serial(n, self._context) for _ in range(3))
        self._callback = CFUNCTYPE(c_int, c_double, c_void_p, c_void_p, c_void_p)(self._slope)
        self._matrix = lib.SUNDenseMatrix(n, n, self._context)
        self._linear = lib.SUNLinSol_Dense(self._x, self._matrix, self._context)
        self.start(0.0, np.zeros(n), np.ones(n))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with ``x``."""
        self._first, self._fresh = (t, x, nominals), True

    def step(self, t_end: float) -> float:
        """Take one step, to ``t_end`` at most."""
        if self._fresh:
            self._begin(*self._first)
        reached = c_double()
        self._check(self._stop(self._memory, t_end))
        flag = self._lib.CVode(self._memory, t_end, self._x, byref(reached), ONE_STEP)
        if self._raised is not None:
            error, self._raised = self._raised, None
            raise error
        self._check(min(flag, 0))
        self._t = reached.value
        return self._t

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step."""
        if t == self._t:
            return self._array(self._x).copy()
        self._check(self._dense(self._memory, t, 0, self._within))
        return self._array(self._within).copy()

    def save(self) -> object:
        """Start anew here."""
        if not self._fresh:
            self.start(self._t, self._array(self._x).copy(), self._first[2])
        return self._first

    def restore(self, state: object) -> None:
        """Start anew where it was saved."""
        self.start(*state)  # type: ignore[misc]

    def _begin(self, t: float, x: Vector, nominals: Vector) -> None:
        lib = self._lib
        self._array(self._x)[:], self._array(self._atol)[:] = x, self._rtol * nominals
        if self._memory is None:
            self._memory = lib.CVodeCreate(lib.CV_BDF, self._context)
            self._check(lib.CVodeInit(self._memory, cast(self._callback, lib.CVRhsFn), t, self._x))
            self._check(lib.CVodeSVtolerances(self._memory, self._rtol, self._atol))
            self._check(lib.CVodeSetLinearSolver(self._memory, self._linear, self._matrix))
            self._check(self._warn(self._memory, -1))  # it prints them
        else:
            self._check(lib.CVodeReInit(self._memory, t, self._x))
            self._check(lib.CVodeSVtolerances(self._memory, self._rtol, self._atol))
        self._t, self._fresh = t, False

    def _slope(self, t: float, x: int, dx: int, _: object) -> int:
        try:
            self._at_address(dx)[:] = self._f(t, self._at_address(x))
        except (
            BaseException
        ) as error:  # none can pass through C, not even Ctrl-C: raised again behind it
            self._raised = error
            return FAILED
        return 0

    def _array(self, vector: Any) -> Vector:
        address = cast(vector, c_void_p).value
        assert address is not None
        return self._at_address(address)

    def _at_address(self, address: int) -> Vector:
        """Give the memory of one of CVode's vectors, which stay where they are."""
        found = self._arrays.get(address)
        if found is None:
            memory: Any = (c_double * self._n).from_address(self._data(address))
            found = self._arrays[address] = np.frombuffer(memory, np.float64)
        return found

    def _listen(self, line: int, function: bytes, file: bytes, text: bytes, *_: object) -> None:
        self._words = text.decode("utf-8", "replace")

    def _check(self, status: int) -> None:
        if status != 0:
            raise RunError(f"solver CVode: {self._words or f'status {status}'}")

    def __del__(self) -> None:
        lib = getattr(self, "_lib", None)
        if lib is None or not self._context:
            return
        core, memory = lib.libraries.sundials_core, self._memory
        if memory is not None:
            lib.CVodeFree(byref(c_void_p(memory)))
        for free, found in ((core.SUNLinSolFree, self._linear), (core.SUNMatDestroy, self._matrix)):
            free(c_void_p(found))
        for vector in (self._x, self._atol, self._within):
            lib.N_VDestroy_Serial(vector)
        core.SUNContext_Free(byref(self._context))


def _sundials() -> Any:
    try:
        from fmpy import sundials
    except Exception as error:  # no library for this machine: OSError; another version of it: fmpy's bare Exception
        machine = f"{platform.machine()}-{platform.system().lower()}"
        raise FmuError(
            f"solver 'CVode': fmpy has no SUNDIALS libraries for {machine} ({error}); use 'BDF' or 'Radau' for stiff models, "
            "else 'DOP853'"
        ) from error
    return sundials
