"""The struct of ``exact.h``: a linear model with its exact solver."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_void_p

from cosim.native.numerics.linear import LinearStruct


class ExactStruct(Structure):
    """cosim_exact."""

    _fields_ = (
        ("linear", LinearStruct),
        *((name, c_int32) for name in ("allowed", "moved", "n_events")),
        ("events", c_void_p),
        ("t", c_double),
        ("inputs", c_void_p),
    )
