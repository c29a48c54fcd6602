"""The compiled kernels, loaded through ctypes."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from ctypes import (
    POINTER,
    c_char,
    c_char_p,
    c_double,
    c_int32,
    c_int64,
    c_size_t,
    c_uint8,
    c_void_p,
)
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError
from cosim.native.build import HERE, LIBRARY


class ProgramStruct(ctypes.Structure):
    """cosim_program."""

    _fields_ = (("length", c_int32), ("code", c_void_p), ("constants", c_void_p))


class LinearStruct(ctypes.Structure):
    """cosim_linear."""

    _fields_ = (
        *((name, c_int32) for name in ("n", "m", "p")),
        *((name, c_void_p) for name in ("Ad", "B0", "B1", "C", "D", "memory")),
    )


class WindowStruct(ctypes.Structure):
    """cosim_window."""

    _fields_ = (
        ("linear", LinearStruct),
        *((name, c_int32) for name in ("taps", "width")),
        *((name, c_void_p) for name in ("Jx", "J0", "J1", "weights", "memory")),
    )


class DelayStruct(ctypes.Structure):
    """cosim_delay."""

    _fields_ = (("steps", c_int32), ("width", c_int32), ("memory", c_void_p))


class IntegratorStruct(ctypes.Structure):
    """cosim_integrator."""

    _fields_ = (
        ("width", c_int32),
        *((name, c_double) for name in ("lower", "upper")),
        *((name, c_void_p) for name in ("held", "memory")),
    )


class PidStruct(ctypes.Structure):
    """cosim_pid."""

    _fields_ = (
        *((name, c_double) for name in ("gain", "integral_gain", "derivative_gain")),
        *((name, c_double) for name in ("setpoint_weight", "derivative_weight")),
        *((name, c_double) for name in ("filter_rate", "tracking_rate")),
        *((name, c_double) for name in ("lower", "upper", "initial_integral")),
        *((name, c_void_p) for name in ("held", "memory")),
    )


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


class ExpressionStruct(ctypes.Structure):
    """cosim_expression."""

    _fields_ = (("count", c_int32), ("programs", c_void_p))


class AlphasStruct(ctypes.Structure):
    """cosim_alphas."""

    _fields_ = (
        *((name, c_int32) for name in ("count", "signals")),
        *((name, c_void_p) for name in ("element", "programs")),
    )


class PastAlphasStruct(ctypes.Structure):
    """cosim_past_alphas."""

    _fields_ = (
        *((name, c_int32) for name in ("count", "signals")),
        *((name, c_void_p) for name in ("element", "programs")),
        *((name, c_int32) for name in ("rows", "depth")),
        *((name, c_void_p) for name in ("age", "steps", "part")),
    )


class RegressorStruct(ctypes.Structure):
    """cosim_regressor."""

    _fields_ = (
        *((name, c_int32) for name in ("rows", "terms", "factors")),
        *((name, c_void_p) for name in ("steps", "alphas", "row", "factor", "sign", "memory")),
    )


class RecoveryStruct(ctypes.Structure):
    """cosim_recovery."""

    _fields_ = (
        ("kind", c_int32),
        ("index", c_int32 * 3),
        ("theta", c_int32 * 2),
        ("sign", c_double * 3),
        ("spacing", c_double),
    )


class LeastSquaresStruct(ctypes.Structure):
    """cosim_least_squares."""

    _fields_ = (
        *((name, c_int32) for name in ("unknowns", "groups", "parameters", "held")),
        ("start", c_double),
        ("prior", c_double),
        ("recovery", c_void_p),
        ("memory", c_void_p),
    )


class MessageStruct(ctypes.Structure):
    """cosim_message."""

    _fields_ = (
        ("time", c_double),
        ("status", c_int32),
        ("category", c_char * 100),
        ("text", c_char * 1001),
    )


class MessagesStruct(ctypes.Structure):
    """cosim_messages."""

    _fields_ = (
        *((name, c_void_p) for name in ("next", "key", "ring")),
        *((name, c_int32) for name in ("size", "first", "count", "accepts_unknown")),
        ("dropped", c_int64),
        ("now", c_double),
    )


class InterpolationStruct(ctypes.Structure):
    """cosim_interpolation."""

    _fields_ = (
        *((name, c_void_p) for name in ("set", "instance", "references")),
        ("count", c_size_t),
        ("size", c_size_t),
        *((name, c_void_p) for name in ("start", "slope", "values")),
        ("t0", c_double),
        ("h", c_double),
        ("last_request", c_double),
        ("status", c_int32),
    )


_POINTER = c_void_p  # to doubles, or to the state of a step
_INT = c_int32

Signature: TypeAlias = tuple[Any, tuple[Any, ...]]  # result, arguments

# as in cosim.h, fmi.h and process.h
_SIGNATURES: dict[str, Signature] = {
    "cosim_cascade": (
        c_int64,
        (
            _POINTER,
            _POINTER,
            c_int64,
            _POINTER,
            c_double,
            _POINTER,
            c_int64,
            _POINTER,
            c_int64,
            POINTER(_INT),
        ),
    ),
    "cosim_multiply": (None, (_INT, _INT, _POINTER, _POINTER, _POINTER)),
    "cosim_multiply_add": (None, (_INT, _INT, _POINTER, _POINTER, _POINTER)),
    "cosim_invert": (_INT, (_INT, _POINTER, _POINTER)),
    "cosim_exponential": (None, (_INT, _POINTER, _POINTER, _POINTER)),
    "cosim_first_order_holds": (
        None,
        (
            c_int64,
            _INT,
            _INT,
            _POINTER,
            _POINTER,
            _POINTER,
            POINTER(c_uint8),
            _POINTER,
            _POINTER,
            _POINTER,
            _POINTER,
        ),
    ),
    "cosim_window_outputs": (None, (_POINTER, _POINTER, _POINTER)),
    "cosim_pid_start": (None, (_POINTER, _POINTER)),
    "cosim_pid_outputs": (None, (_POINTER, _POINTER, _POINTER)),
    "cosim_method_named": (_INT, (c_char_p, POINTER(MethodStruct))),
    "cosim_runge_kutta_memory": (c_int64, (POINTER(MethodStruct), _INT)),
    "cosim_runge_kutta_start": (_INT, (_POINTER, c_double, _POINTER, _POINTER)),
    "cosim_runge_kutta_step": (_INT, (_POINTER, c_double, POINTER(c_double))),
    "cosim_runge_kutta_at": (_INT, (_POINTER, c_double, _POINTER)),
    "cosim_evaluate": (c_double, (POINTER(ProgramStruct), c_double)),
    "cosim_normal": (None, (c_int64, _POINTER, _POINTER)),
    "cosim_regressor_outputs": (None, (_POINTER, c_double, _POINTER, _POINTER)),
    "cosim_least_squares_start": (None, (_POINTER, _POINTER)),
    "cosim_messages_open": (None, (POINTER(MessagesStruct),)),
    "cosim_messages_close": (None, (POINTER(MessagesStruct),)),
    "cosim_messages_take": (_INT, (POINTER(MessagesStruct), POINTER(MessageStruct))),
    "cosim_messages_last": (_INT, (POINTER(MessagesStruct), POINTER(MessageStruct))),
    "cosim_messages_dropped": (c_int64, (POINTER(MessagesStruct),)),
    "cosim_process_size": (c_size_t, ()),
    "cosim_process_save": (None, (_POINTER, _INT)),
    "cosim_process_restore": (_INT, (_POINTER, _INT)),
}


def _load() -> Any:
    path = HERE / LIBRARY
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise UsageError(
            f"the compiled kernels {path} cannot be loaded ({error}); run 'pip install -e .' again"
        ) from error
    return library


library = _load()


def declare(signatures: Mapping[str, Signature]) -> None:
    """Declare functions of the library, as in its headers."""
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments


declare(_SIGNATURES)


def address(function: str) -> int:
    """Return the address of a function of the library, for C."""
    value = ctypes.cast(getattr(library, function), c_void_p).value
    assert value is not None
    return value


def pointer(array: NDArray[Any]) -> int:
    """Return the address of a contiguous array's data; the array must outlive its use."""
    assert array.flags.c_contiguous
    return array.ctypes.data


def int32(values: Any) -> NDArray[np.int32]:
    """Copy to a contiguous int32 array."""
    return np.ascontiguousarray(values, np.int32)
