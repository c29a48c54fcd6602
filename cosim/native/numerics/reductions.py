"""What is kept of the values of expressions over rows, as the rows come: ``reductions.c``."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from ctypes import addressof, byref, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from cosim.arrays import NAN, Matrix, Nanoseconds, Vector
from cosim.native.library import declare, int32, library
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.instructions import RowInstructions
from cosim.native.step import DOUBLE

PARTS: Final = ("ends", "low", "high", "sum", "squares", "shifted", "integral", "kept")
"""What can be kept of values, beside their count; the bits of reductions.c in their order."""
_NUMBERS: Final = (
    *("first", "last", "low", "high", "sum", "squares"),
    *("shifted_sum", "shifted_squares", "integral"),
)
_NOTHING: Final = np.empty((2, 0))
_CHUNK: Final = 128  # COSIM_CHUNK
_FIRST_ROOM: Final = 1024  # values that are kept before more memory is taken


class HoldStruct(ctypes.Structure):
    """cosim_hold."""

    _fields_ = (("duration_ns", c_int64), ("since_ns", c_int64), ("is_holding", c_int32))


class ReductionStruct(ctypes.Structure):
    """cosim_reduction."""

    _fields_ = (
        *((name, c_int32) for name in ("values", "parts")),
        ("count", c_int64),
        *((name, c_double) for name in _NUMBERS),
        *((name, c_double) for name in ("before", "t_before")),
        *((name, c_void_p) for name in ("kept", "kept_times")),
    )


class ReductionsStruct(ctypes.Structure):
    """cosim_reductions."""

    _fields_ = (
        *((name, c_void_p) for name in ("instructions", "holds", "reductions", "registers")),
        *((name, c_int32) for name in ("n_instructions", "n_reductions")),
    )


declare({"cosim_reduce_rows": (None, (c_void_p, c_int64, c_void_p, c_void_p, c_void_p, c_int64))})


@dataclass(frozen=True, eq=False)
class RowReduction:
    """What to keep of the values of an expression, or of how often a condition is true.

    Parameters
    ----------
    parts : tuple of str
        Of ``PARTS``; the count is always there.
    values : Program or ConditionProgram
        With columns of the rows; of a condition 1 where it is true, else 0.
    where : ConditionProgram or None
        Only rows where it is true; None: all.
    """

    parts: tuple[str, ...]
    values: Program | ConditionProgram
    where: ConditionProgram | None = None


@dataclass(frozen=True, eq=False)
class KeptValues:
    """What was kept of some values; what is not among the parts of its reduction has no meaning.

    Parameters
    ----------
    count : int
        How many there are; 0: nothing else has a meaning either.
    first, last, low, high, sum, squares : float
    shifted_sum, shifted_squares : float
        Of the differences to the first value.
    integral : float
        Trapezoidal rule over rows that follow each other and have a value both.
    values, times : Vector, shape (count,)
        All of them with their instants [s].
    """

    count: int
    first: float
    last: float
    low: float
    high: float
    sum: float
    squares: float
    shifted_sum: float
    shifted_squares: float
    integral: float
    values: Vector
    times: Vector


@final
class RowReductions:
    """Reduces rows as they come; begins anew for every run.

    Parameters
    ----------
    reductions : sequence of RowReduction
    """

    def __init__(self, reductions: Sequence[RowReduction]) -> None:
        compiled = RowInstructions()
        parts: dict[int, int] = {}
        self._registers = []
        for item in reductions:
            register = compiled.add(item.values, item.where)
            self._registers.append(register)
            parts[register] = parts.get(register, 0) | _bits(item.parts)
        self._places = {register: place for place, register in enumerate(parts)}
        self._reductions = (ReductionStruct * max(len(parts), 1))()
        for struct, (register, bits) in zip(self._reductions, parts.items(), strict=False):
            struct.values = register
            struct.parts = bits
        self._holds = (HoldStruct * max(len(compiled.durations_ns), 1))()
        for hold, duration_ns in zip(self._holds, compiled.durations_ns, strict=False):
            hold.duration_ns = duration_ns
        self._code = int32(compiled.instructions)
        self._memory = np.zeros((compiled.n_registers, _CHUNK))
        for register, value in compiled.constants.items():
            self._memory[register] = value
        self._kept = {
            place: np.empty((2, _FIRST_ROOM))
            for place, bits in enumerate(parts.values())
            if bits & _bits(("kept",))
        }
        self._struct = ReductionsStruct(
            self._code.ctypes.data,
            addressof(self._holds),
            addressof(self._reductions),
            self._memory.ctypes.data,
            len(self._code),
            len(parts),
        )
        self.begin()

    def begin(self) -> None:
        """Forget all rows."""
        for hold in self._holds:
            hold.is_holding = 0
        for reduction in self._reductions:
            reduction.count = 0
            for name in ("sum", "squares", "shifted_sum", "shifted_squares", "integral"):
                setattr(reduction, name, 0.0)
            reduction.low = math.inf
            reduction.high = -math.inf
            reduction.before = NAN
            reduction.t_before = NAN

    def add(self, time_ns: Nanoseconds, t: Vector, rows: Matrix) -> None:
        """Go on over the next rows.

        Parameters
        ----------
        time_ns : Nanoseconds, shape (N,)
        t : Vector, shape (N,)
            The same instants [s].
        rows : Matrix, shape (N, width)
            May be strided; the elements of a row may not.
        """
        count = len(rows)
        if not count:
            return
        assert time_ns.flags.c_contiguous
        assert t.flags.c_contiguous
        assert rows.strides[1] == DOUBLE
        for place in self._kept:
            self._take_room(place, count)
        library.cosim_reduce_rows(
            byref(self._struct),
            count,
            time_ns.ctypes.data,
            t.ctypes.data,
            rows.ctypes.data,
            rows.strides[0] // DOUBLE,
        )

    def _take_room(self, place: int, count: int) -> None:
        """Take memory for some more values, where it is needed."""
        reduction = self._reductions[place]
        room = self._kept[place]
        needed = reduction.count + count
        if needed > room.shape[1]:
            room = np.empty((2, max(needed, 2 * room.shape[1])))
            room[:, : reduction.count] = self._kept[place][:, : reduction.count]
            self._kept[place] = room
        reduction.kept, reduction.kept_times = (row.ctypes.data for row in room)

    def kept(self, number: int) -> KeptValues:
        """Return what was kept of the rows so far for the reduction of a number.

        Its arrays are used again by the rows that follow.
        """
        place = self._places[self._registers[number]]
        struct = self._reductions[place]
        values, times = self._kept.get(place, _NOTHING)[:, : struct.count]
        numbers = {name: getattr(struct, name) for name in _NUMBERS}
        return KeptValues(struct.count, values=values, times=times, **numbers)


def _bits(parts: Sequence[str]) -> int:
    bits = 0
    for part in parts:
        bits |= 1 << PARTS.index(part)
    return bits
