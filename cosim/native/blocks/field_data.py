"""The step of ``field_data.c``: samples at instants of their own."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, addressof, c_double, c_int32, c_int64, c_void_p

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.native.library import address, pointer
from cosim.native.step import NativeStep


class _LineStruct(Structure):
    """cosim_line."""

    _fields_ = (
        ("count", c_int64),
        *((name, c_void_p) for name in ("t", "values")),
        ("near", c_int64),
    )


class _FieldDataStruct(Structure):
    """cosim_field_data."""

    _fields_ = (
        *((name, c_int32) for name in ("elements", "most", "hold")),
        ("lines", c_void_p),
        ("count", c_int64),
        ("columns", c_void_p),
        ("end", c_double),
        ("before", c_void_p),
        ("near", c_int64),
    )


def field_data_step(
    lines: Sequence[tuple[Vector, Vector]], columns: Matrix, *, most: int, end: float, hold: bool
) -> NativeStep:
    """Build the values between samples, and the samples of each step.

    Its memory is the communication point before the last; NaN: there is none.

    Parameters
    ----------
    lines : sequence of (Vector, Vector)
        Instants [s] and values of each element.
    columns : Matrix, shape (elements + 1, N)
        Samples, NaN where there is none, and in the last row their instants [s].
    most : int
        Samples that can be in one step.
    end : float
        The last instant at which all is measured [s].
    hold : bool
        A zero-order hold between samples; else straight lines.
    """
    structs = (_LineStruct * len(lines))()
    keep: list[object] = [structs]
    for i, line in enumerate(lines):
        t, values = [np.ascontiguousarray(array, np.float64) for array in line]
        structs[i] = _LineStruct(len(t), pointer(t), pointer(values))
        keep += [t, values]
    rows = np.ascontiguousarray(columns, np.float64)
    memory = np.array([NAN])
    elements = len(lines)
    state = _FieldDataStruct(
        elements,
        most,
        hold,
        addressof(structs),
        rows.shape[1],
        pointer(rows),
        end,
        pointer(memory),
    )
    n_y = elements + (elements + 1) * most
    function = address("cosim_field_data_step")
    return NativeStep(function, state, n_y=n_y, memory=memory, keep=(rows, *keep))
