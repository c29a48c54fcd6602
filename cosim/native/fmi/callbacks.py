"""The structs of ``callbacks.h``: what a loaded FMU calls back."""

from __future__ import annotations

from ctypes import (
    POINTER,
    Structure,
    c_char,
    c_char_p,
    c_double,
    c_int32,
    c_int64,
    c_size_t,
    c_void_p,
)

from cosim.native.library import declare


class MessageStruct(Structure):
    """cosim_message."""

    _fields_ = (
        ("time", c_double),
        ("status", c_int32),
        ("category", c_char * 100),
        ("text", c_char * 1001),
    )


class MessagesStruct(Structure):
    """cosim_messages."""

    _fields_ = (
        *((name, c_void_p) for name in ("next", "key", "ring")),
        *((name, c_int32) for name in ("size", "first", "count", "accepts_unknown")),
        ("dropped", c_int64),
        ("now", c_double),
        ("name", c_char_p),
    )


class InterpolationStruct(Structure):
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


_MESSAGES = POINTER(MessagesStruct)

declare(
    {
        "cosim_messages_open": (None, (_MESSAGES,)),
        "cosim_messages_close": (None, (_MESSAGES,)),
        "cosim_messages_take": (c_int32, (_MESSAGES, POINTER(MessageStruct))),
        "cosim_messages_last": (c_int32, (_MESSAGES, POINTER(MessageStruct))),
        "cosim_messages_dropped": (c_int64, (_MESSAGES,)),
    }
)
