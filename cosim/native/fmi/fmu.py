"""The structs of ``fmu.h``: a loaded FMU that compiled code calls by address."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_int64, c_size_t, c_ssize_t, c_void_p
from typing import Final

import numpy as np
from numpy.typing import DTypeLike

from cosim.native.fmi.callbacks import MessageStruct
from cosim.native.library import declare

DECLINED: Final = 20  # COSIM_DECLINED
CALL_FAILED: Final = 21  # COSIM_CALL_FAILED

FLOAT64: Final = 0  # COSIM_FLOAT64
_CARRIERS: Final = (
    np.float64,
    np.float32,
    np.int8,
    np.uint8,
    np.int16,
    np.uint16,
    np.int32,
    np.uint32,
    np.int64,
    np.uint64,
    np.bool_,
)


class CallStruct(Structure):
    """cosim_fmu_call."""

    _fields_ = (
        ("function", c_void_p),
        ("warned", c_int32),
        ("has_message", c_int32),
        ("time", c_double),
        ("message", MessageStruct),
    )


class FmuStruct(Structure):
    """cosim_fmu."""

    _fields_ = (
        ("instance", c_void_p),
        *((name, c_int32) for name in ("version", "forbidden", "may_go_back")),
        *((name, c_void_p) for name in ("messages", "failed")),
        ("status", c_int32),
    )


class GroupStruct(Structure):
    """cosim_fmu_group."""

    _fields_ = (
        *((name, c_void_p) for name in ("get", "set", "references")),
        *((name, c_size_t) for name in ("count", "size")),
        ("columns", c_void_p),
        ("first", c_ssize_t),
        *((name, c_int32) for name in ("carrier", "boolean")),
        ("values", c_void_p),
    )


class VariablesStruct(Structure):
    """cosim_fmu_variables."""

    _fields_ = (
        ("groups", c_void_p),
        ("count", c_int64),
        *((name, c_void_p) for name in ("get", "set", "references")),
        *((name, c_size_t) for name in ("n_references", "size")),
        ("first", c_ssize_t),
    )

    @property
    def is_direct(self) -> bool:
        """Whether they are handed over where they stand in the vector."""
        return bool(self.get)


class DirectionalStruct(Structure):
    """cosim_fmu_directional."""

    _fields_ = (
        *((name, c_void_p) for name in ("call", "unknowns", "knowns")),
        *((name, c_size_t) for name in ("n_unknowns", "n_knowns")),
        *((name, c_size_t) for name in ("unknowns_size", "knowns_size")),
    )


class SlopesStruct(Structure):
    """cosim_fmu_slopes."""

    _fields_ = (
        *((name, c_void_p) for name in ("call", "references")),
        *((name, c_size_t) for name in ("count", "size")),
        *((name, c_void_p) for name in ("orders", "columns", "start", "values", "interpolation")),
    )


class StepStruct(Structure):
    """cosim_fmu_step."""

    _fields_ = (
        *((name, c_void_p) for name in ("function", "call")),
        *((name, c_int32) for name in ("event_mode", "status")),
        *((name, c_void_p) for name in ("event_needed", "terminate", "early_return")),
        *((name, c_void_p) for name in ("last_successful_time", "interpolation", "set")),
    )


def carrier(dtype: DTypeLike) -> int:
    """Return the number of the type that carries a value: COSIM_FLOAT64 and so on."""
    return _CARRIERS.index(np.dtype(dtype).type)


declare(
    {
        "cosim_fmu_record_warning": (None, (c_void_p, c_void_p)),
        "cosim_fmu_set_any": (c_int32, (c_void_p, c_void_p, c_void_p)),
        "cosim_fmu_get_any": (c_int32, (c_void_p, c_void_p, c_void_p)),
        "cosim_fmu_directional_derivative": (
            c_int32,
            (c_void_p, c_void_p, c_void_p, c_void_p),
        ),
    }
)
