"""The structs of ``stage.h``: components that advance together in one call."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_int64, c_void_p
from typing import Final

from cosim.arrays import Matrix, Vector
from cosim.native.library import declare, library, pointer

KINDS: Final = {
    "keep": 0,
    "gather": 1,
    "advance": 2,
    "refresh": 3,
    "check": 4,
    "save": 5,
    "begin": 6,
    "restore": 7,
    "solve": 8,
    "gather together": 9,
    "advance together": 10,
    "record": 11,
    "right": 12,
}
"""COSIM_KEEP and so on."""
HERE: Final = 0  # COSIM_HERE and so on
DONE: Final = 1
OVER: Final = 2


class CopyStruct(Structure):
    """cosim_copy."""

    _fields_ = tuple((name, c_int32) for name in ("to", "from"))


class WideCopyStruct(Structure):
    """cosim_wide_copy."""

    _fields_ = tuple((name, c_int32) for name in ("to", "from", "count"))


class TermStruct(Structure):
    """cosim_term."""

    _fields_ = (("from", c_int32), ("gain", c_double))


class SumStruct(Structure):
    """cosim_sum."""

    _fields_ = (
        ("terms", c_void_p),
        *((name, c_int32) for name in ("to", "n_terms", "plain", "converts")),
        ("offset", c_double),
        *((name, c_double) for name in ("factor1", "offset1", "offset2", "factor2")),
    )


class JumpStruct(Structure):
    """cosim_jump."""

    _fields_ = (("column", c_int32), ("limit", c_int32))


class MemberStruct(Structure):
    """cosim_member."""

    _fields_ = (
        *((name, c_void_p) for name in ("advance", "outputs", "self")),
        *((name, c_int32) for name in ("u", "n_u", "y", "n_y")),
        *((name, c_int32) for name in ("n_copies", "n_wide", "n_sums", "n_torn", "takes_latest")),
        *((name, c_void_p) for name in ("copies", "wide_copies", "sums")),
        *((name, c_void_p) for name in ("optional", "seconds", "overridden", "gains", "overrides")),
        *((name, c_void_p) for name in ("torn", "tried", "rollback", "jumps", "right", "limits")),
        *((name, c_int32) for name in ("n_jumps", "n_limits")),
        *((name, c_void_p) for name in ("has_jumped", "left_outputs")),
    )


class OperationStruct(Structure):
    """cosim_operation."""

    _fields_ = (("members", c_void_p), ("kind", c_int32), ("count", c_int32))


class SegmentStruct(Structure):
    """cosim_segment."""

    _fields_ = (
        ("operations", c_void_p),
        *((name, c_int64) for name in ("count", "first", "cascade")),
        ("unknowns", c_void_p),
    )


class UnknownsStruct(Structure):
    """cosim_unknowns."""

    _fields_ = (
        *((name, c_void_p) for name in ("solver", "w")),
        *((name, c_int64) for name in ("sweep", "restore")),
        *((name, c_int32) for name in ("status", "stopped")),
    )


class HeldStruct(Structure):
    """cosim_held."""

    _fields_ = (
        *((name, c_void_p) for name in ("step", "outputs", "self")),
        ("n_u", c_int32),
        *((name, c_void_p) for name in ("held", "u")),
    )


class StageStruct(Structure):
    """cosim_stage."""

    _fields_ = (
        ("segments", c_void_p),
        *((name, c_int64) for name in ("n_segments", "width", "tile")),
        *((name, c_void_p) for name in ("t", "rows")),
        ("h", c_double),
        *((name, c_int64) for name in ("completed", "segment", "step", "operation")),
        *((name, c_int64) for name in ("suspicious", "origin")),
        ("origin_value", c_double),
    )


declare(
    {
        "cosim_stage_run": (c_int64, (c_void_p, c_int64, c_int32)),
        "cosim_accumulate": (None, (c_int64, c_int64, *[c_void_p] * 4)),
    }
)


def accumulate(rows: Matrix, counts: Vector, sums: Vector, squares: Vector) -> None:
    """Add up rows, shape (n, width), one after the other; see ``cosim_accumulate``.

    Parameters
    ----------
    rows : Matrix, shape (n, width)
    counts, sums, squares : Vector, shape (width,)
        Are added to: how many values there are, their sum, and the sum of their squares.
    """
    n_rows, width = rows.shape
    library.cosim_accumulate(n_rows, width, *map(pointer, (rows, counts, sums, squares)))
