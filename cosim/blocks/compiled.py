"""A component whose step is a compiled function of one's own: C, or a ``@cfunc`` of numba.

The functions have the signatures of the package's own kernels::

    int32_t step(double *memory, double t0, double t1, double h,
                 const double *u0, const double *u1, double *y);
    int32_t outputs(double *memory, double t, const double *u, double *y);

``step`` advances from ``t0`` to ``t1`` (``h`` seconds apart) with inputs ``u0`` and ``u1`` there,
and writes the outputs at ``t1``; an input with a zero-order hold is the same in both, and then
``outputs`` is called, too. ``outputs`` writes those at ``t``, the time reached, for inputs
``u``, and changes nothing. The whole state is in ``memory``. Both return 0, or the number of an
error, which ends the run; a step that returns one must not have changed the memory.

In numba, with ``p = "CPointer(float64)"``, a step is made by
``@cfunc(f"int32({p}, float64, float64, float64, {p}, {p}, {p})")``, and the outputs by
``@cfunc(f"int32({p}, float64, {p}, {p})")``. ``numba.carray`` makes arrays of the pointers, and
``.address`` is what is needed here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.signals import Interface
from cosim.errors import RunError, UsageError
from cosim.native.library import address, pointer
from cosim.native.stages.stage import HeldStruct
from cosim.native.step import NativeStep


class CompiledFunction:
    """Advances by a compiled function, in compiled stages without Python.

    Parameters
    ----------
    interface : Interface
        The signals and what feeds through; the rest is declared here.
    step, outputs : int
        Addresses of the functions.
    memory : ArrayLike, shape (n,)
        The initial state.
    keep : object, optional
        What must live as long as the functions: the library that they are in, the ``cfunc``.

    Raises
    ------
    UsageError
        If an address is none, or the memory is not one vector of finite numbers.
    """

    def __init__(
        self,
        interface: Interface,
        *,
        step: int,
        outputs: int,
        memory: ArrayLike = (),
        keep: object = None,
    ) -> None:
        _check_address("step", step)
        _check_address("outputs", outputs)
        self.interface = replace(interface, prepares=True, rollback=True, native=True)
        self._initial = _checked_memory(memory)
        self._memory = np.zeros(len(self._initial) + 1)  # an address also where there is no state
        self._addresses = (step, outputs, pointer(self._memory))
        self._keep = keep
        self.prepare(0.0, np.zeros(interface.n_u, np.bool_), {})

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Take which inputs have a zero-order hold; nothing is designed."""
        flags = held.astype(np.uint8)
        scratch = np.empty(len(flags))
        state = HeldStruct(*self._addresses, len(flags), pointer(flags), pointer(scratch))
        self._step = NativeStep(
            address("cosim_held_step"),
            state,
            n_y=self.interface.n_y,
            memory=self._memory,
            keep=(flags, scratch, self._keep),
            outputs=address("cosim_held_outputs"),
            memory_is_state=True,
        )
        return {}

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Return an empty design: the function gets the length of its step."""
        return {}

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set the initial state."""
        self._memory[:-1] = self._initial
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return what the function writes.

        Raises
        ------
        RunError
            If it returns an error.
        """
        y = self._step.outputs_at(t, u)
        if y is None:
            raise RunError("its compiled function of the outputs returned an error")
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        y = self._step.advance(t, h, u)
        if self._step.status:
            raise Stopped(y, f"its compiled step returned error {self._step.status}")
        return y

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def save(self) -> Vector:
        """Copy the state."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._step.restore(state)


def _check_address(name: str, address: object) -> None:
    if type(address) is not int or address <= 0:
        raise UsageError(
            f"{name}: expected the address of a compiled function, such as ctypes.cast(function, "
            f"ctypes.c_void_p).value, or .address of a cfunc of numba, got {address!r}"
        )


def _checked_memory(memory: ArrayLike) -> Vector:
    values = np.array(memory, np.float64)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise UsageError(
            f"memory: expected a vector of finite numbers, the initial state, got {memory!r}"
        )
    return values
