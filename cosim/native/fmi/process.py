"""What a step of foreign code changes of its process is put back: ``process.h``."""

from __future__ import annotations

import os
from ctypes import (
    Structure,
    c_char_p,
    c_double,
    c_int32,
    c_size_t,
    c_void_p,
    create_string_buffer,
)
from pathlib import Path
from typing import Final

from cosim.native.library import address, declare, library
from cosim.native.memory import place_struct
from cosim.native.step import NativeStep, RollbackStruct

declare(
    {
        "cosim_process_size": (c_size_t, ()),
        "cosim_process_save": (None, (c_void_p, c_int32, c_void_p)),
        "cosim_process_restore": (c_int32, (c_void_p, c_int32)),
        "cosim_report_deaths": (None, ()),
        "cosim_report_log": (None, (c_char_p,)),
        "cosim_running_text": (c_int32, (c_char_p, c_size_t)),
    }
)

reported_log: Path | None = None
process_size: Final = library.cosim_process_size
report_deaths: Final = library.cosim_report_deaths
process_save: Final = library.cosim_process_save
process_restore: Final = library.cosim_process_restore


class GuardedStruct(Structure):
    """cosim_guarded."""

    _fields_ = (
        *((name, c_void_p) for name in ("process", "called", "step", "outputs")),
        *((name, c_void_p) for name in ("save", "restore", "self")),
        ("changes", c_int32),
        ("time", c_double),
        ("distrusted", c_int32),
    )


def running_text() -> str:
    """Return which FMU is being called, and at what time; empty: none is. Any thread may ask."""
    text = create_string_buffer(1024)
    library.cosim_running_text(text, len(text))
    return text.value.decode("utf-8", "replace")


def report_log(path: Path | None) -> None:
    """Let a process that ends in an FMU say where the log of its run is; None: there is none."""
    global reported_log
    reported_log = path
    library.cosim_report_log(None if path is None else os.fsencode(path))


def guarded_step(step: NativeStep, called: int | None) -> tuple[NativeStep, GuardedStruct]:
    """Return a step that puts the floating-point unit back after a step, and what it finds.

    The step needs a guard, and ``process`` of the struct the memory of the guard's process.
    ``called``: the address of the FMU's messages, None where it is none.
    """
    struct = place_struct(GuardedStruct)
    struct.called = called
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
        own_rollback=rollback,
        left_outputs=step.left_outputs,
    )
    return guarded, struct
