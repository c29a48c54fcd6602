"""The steps of ``wrapping.c``: components inside others."""

from __future__ import annotations

from ctypes import Structure, c_int32, c_void_p

from cosim.arrays import Vector
from cosim.native.library import address, pointer
from cosim.native.step import NativeStep


class InnerStruct(Structure):
    """cosim_inner."""

    _fields_ = tuple((name, c_void_p) for name in ("step", "outputs", "self"))


class KeptStruct(Structure):
    """cosim_kept."""

    _fields_ = (("inner", InnerStruct), ("width", c_int32), ("last", c_void_p))


def inner_struct(step: NativeStep) -> InnerStruct:
    """Return the struct of a step inside another, which it must not outlive."""
    return InnerStruct(step.function, step.outputs, step.address)


def kept_step(step: NativeStep, last: Vector) -> NativeStep:
    """Build a step whose outputs stay until the next one; its memory is ``last``, these outputs.

    Whatever else changes is in the memory of ``step``.
    """
    state = KeptStruct(inner_struct(step), step.n_y, pointer(last))
    return NativeStep(
        address("cosim_kept_step"),
        state,
        n_y=step.n_y,
        memory=last,
        keep=(step,),
        outputs=address("cosim_kept_outputs"),
    )
