"""The native step: a C step function of the signature of ``cosim.h``, bound to its state."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from ctypes import POINTER, byref, c_double, c_int32, c_int64, c_void_p
from dataclasses import KW_ONLY, dataclass, field
from typing import Final, Protocol

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.library import declare, library, pointer

NO_VALUE = 1  # COSIM_NO_VALUE
FULL = 5  # COSIM_FULL
OUTSIDE = 6  # COSIM_OUTSIDE
DOUBLE = 8  # bytes
LARGEST_MEMORY = 2**27  # values in a component's memory or in a matrix, 1 GiB


declare(
    {
        "cosim_cascade": (
            c_int64,
            (
                *(c_void_p, c_void_p, c_int64),  # step, self, steps
                *(c_void_p, c_double),  # t, h
                *(c_void_p, c_int64, c_void_p, c_int64),  # u, y, each with the distance of rows
                POINTER(c_int32),  # status
            ),
        )
    }
)


class RollbackStruct(ctypes.Structure):
    """cosim_rollback of ``stage.h``."""

    _fields_ = (
        *((name, c_void_p) for name in ("save", "restore", "memory", "saved")),
        ("count", c_int64),
        ("is_saved", c_int32),
    )


_UNGUARDED: Final = nullcontext()
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


@contextmanager
def _guarded(guard: Guard, t: float) -> Iterator[None]:
    """Put back what foreign code changes of the process in a call that begins at ``t`` [s]."""
    guard.begin()
    try:
        yield
    finally:
        guard.end(t)


@dataclass(eq=False)
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
        Its changing state.
    keep : tuple of object
        What ``state`` points into, which lives as long as the step: arrays, programs of
        expressions, the steps inside this one.
    outputs : int
        Address of a function that evaluates the outputs again (``cosim_outputs`` of ``stage.h``);
        0: there is none.
    guard : Guard or None
        Of foreign code.
    own_rollback : callable, optional
        Returns how compiled code goes back; left out: by a copy of ``memory``.
    memory_is_state : bool
        Whether ``memory`` is all of the state, so that a copy of it is one.
    left_outputs : (int, int), optional
        Where a component has its outputs before a jump at the end of the last step: the address of
        an int32, whether there was one, and that of all these outputs.

    Attributes
    ----------
    address : int
        Of ``state``.
    status : int
        Why the last call stopped before its end; 0: it did not.
    """

    function: int
    state: ctypes.Structure
    _: KW_ONLY
    n_y: int
    memory: Vector
    keep: tuple[object, ...] = ()
    outputs: int = 0
    guard: Guard | None = None
    own_rollback: Callable[[], RollbackStruct | None] | None = None
    memory_is_state: bool = False
    left_outputs: tuple[int, int] | None = None
    address: int = field(init=False)
    status: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        """Take the address of the state."""
        self.address = ctypes.addressof(self.state)

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
        inputs = np.ascontiguousarray(u, np.float64)
        y = np.empty(self.n_y)
        with self._guarded(t):
            status = _OUTPUTS(self.outputs)(self.address, t, pointer(inputs), pointer(y))
        return None if status else y

    def _guarded(self, t: float) -> AbstractContextManager[None]:
        return _UNGUARDED if self.guard is None else _guarded(self.guard, t)

    def rollback(self) -> RollbackStruct | None:
        """Return how compiled code copies the state and puts it back, in memory of its own.

        None: it cannot.
        """
        if self.own_rollback is not None:
            return self.own_rollback()
        if not self.memory_is_state:
            return None
        copy = np.zeros(max(1, len(self.memory)))
        self.keep = (*self.keep, copy)
        addresses = (pointer(self.memory), pointer(copy))
        return RollbackStruct(None, None, *addresses, len(self.memory), 0)

    def save(self) -> Vector:
        """Copy the state."""
        return self.memory.copy()

    def restore(self, state: Vector) -> None:
        """Return to a saved state."""
        self.memory[:] = state
