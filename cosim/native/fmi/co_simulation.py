"""The structs of ``co_simulation.h`` and ``inner_step.h``."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_int64, c_void_p
from typing import Final

from cosim.native.fmi.fmu import DirectionalStruct, SlopesStruct, StepStruct, VariablesStruct
from cosim.native.library import declare

NOTHING: Final = 0  # COSIM_NOTHING and so on: what a step did that was left to the methods
STEPPED: Final = 1
UNREAD: Final = 2
COMPLETED: Final = 3
FAILED: Final = 4
SLOPES_FAILED: Final = 5
UNEVEN: Final = 32  # COSIM_UNEVEN


class InnerStepStruct(Structure):
    """cosim_inner_step."""

    _fields_ = (
        ("columns", c_void_p),
        *((name, c_int32) for name in ("n", "n_u", "watches", "begun", "changed", "is_shared")),
        *((name, c_int64) for name in ("steps", "input_changes", "outside_changes")),
        *((name, c_int64) for name in ("period", "repeats", "uneven")),
        ("ends", c_int64 * (UNEVEN + 1)),
        *((name, c_double) for name in ("least", "most")),
        *((name, c_void_p) for name in ("in_loop", "outputs", "inputs", "outputs_before")),
    )


class MessagesMarkStruct(Structure):
    """cosim_messages_mark."""

    _fields_ = (("first", c_int32), ("count", c_int32), ("dropped", c_int64))


class CoSimulationCopyStruct(Structure):
    """cosim_co_simulation_copy."""

    _fields_ = (
        *((name, c_void_p) for name in ("get", "set", "fmu_state", "values")),
        *((name, c_int32) for name in ("interpolates", "stepped", "ended")),
        ("next_event", c_double),
        ("inner_steps", c_double),
        ("inner_step", InnerStepStruct),
        ("messages", MessagesMarkStruct),
        ("has_warned", c_int32),
        ("watches", c_int32),
    )


class CoSimulationStruct(Structure):
    """cosim_co_simulation."""

    _fields_ = (
        ("fmu", c_void_p),
        *((name, c_int32) for name in ("plain", "initialized", "interpolates", "stepped", "ended")),
        *((name, c_int32) for name in ("n_u", "n_y", "n_event", "note")),
        *((name, c_double) for name in ("next_event", "first_event")),
        *((name, c_void_p) for name in ("get_state", "held", "latest", "outputs", "inputs")),
        *((name, c_void_p) for name in ("event_inputs", "inner_step")),
        ("inner_steps", c_double),
        ("feedthrough", DirectionalStruct),
        ("step_inputs", VariablesStruct),
        ("outputs_read", VariablesStruct),
        ("do_step", StepStruct),
        ("slopes", SlopesStruct),
        *((name, c_void_p) for name in ("fmu_state", "unknowns", "knowns")),
        *((name, c_void_p) for name in ("ramped", "event_columns", "scratch", "copy")),
        ("has_left", c_int32),
    )


declare({"cosim_inner_step_observe": (c_double, (c_void_p, c_void_p, c_void_p))})
