"""What a step of foreign code changes of its process is put back: ``process.h``."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_size_t, c_void_p
from typing import Final

from cosim.native.library import address, declare, library
from cosim.native.memory import place_struct
from cosim.native.step import NativeStep, RollbackStruct

declare(
    {
        "cosim_process_size": (c_size_t, ()),
        "cosim_process_save": (None, (c_void_p, c_int32)),
        "cosim_process_restore": (c_int32, (c_void_p, c_int32)),
    }
)

process_size: Final = library.cosim_process_size
process_save: Final = library.cosim_process_save
process_restore: Final = library.cosim_process_restore


class GuardedStruct(Structure):
    """cosim_guarded."""

    _fields_ = (
        *((name, c_void_p) for name in ("process", "step", "outputs", "save", "restore", "self")),
        ("changes", c_int32),
        ("time", c_double),
        ("distrusted", c_int32),
    )


def guarded_step(step: NativeStep) -> tuple[NativeStep, GuardedStruct]:
    """Return a step that puts the floating-point unit back after a step, and what it finds.

    The step needs a guard, and ``process`` of the struct the memory of the guard's process.
    """
    struct = place_struct(GuardedStruct)
    struct.step = step.function
    struct.outputs = step.outputs
    struct.self = step.address

    def rollback() -> RollbackStruct | None:
        inner = step.rollback()
        if inner is None:
            return None
        struct.save = inner.save
        struct.restore = inner.restore
        functions = ("cosim_guarded_save", "cosim_guarded_restore")
        return RollbackStruct(*map(address, functions))

    guarded = NativeStep(
        address("cosim_guarded_step"),
        struct,
        n_y=step.n_y,
        memory=step.memory,
        keep=(step,),
        outputs=address("cosim_guarded_outputs") if step.outputs else 0,
        rollback=rollback,
        left_outputs=step.left_outputs,
    )
    return guarded, struct
