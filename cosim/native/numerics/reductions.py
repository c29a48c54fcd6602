"""What is kept of the values of expressions over rows, as the rows come: ``reductions.c``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import addressof, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, NamedTuple, final

import numpy as np

from cosim.arrays import NAN, Matrix, Nanoseconds, Vector
from cosim.instants import NANOSECONDS, StepNs
from cosim.native.library import declare, int32, library, pointer
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.instructions import RowInstructions
from cosim.native.step import DOUBLE

PARTS: Final = ("ends", "low", "high", "sum", "squares", "shifted", "integral", "kept")
"""What can be kept of values, beside their count; the bits of reductions.c in their order."""
_ENDS: Final = ("first", "last", "low", "high")
_N_SUMS: Final = 5  # COSIM_SUMS
_NOTHING: Final = np.empty(0)
_NO_END: Final = 2**63
_CHUNK: Final = 128  # COSIM_CHUNK
_LANES: Final = 4  # COSIM_LANES
_FIRST_ROOM: Final = 1024  # rows of which values are kept before more memory is taken


class HoldStruct(ctypes.Structure):
    """cosim_hold."""

    _fields_ = (("duration_ns", c_int64), ("since_ns", c_int64), ("is_holding", c_int32))


class ReductionStruct(ctypes.Structure):
    """cosim_reduction."""

    _fields_ = (
        *((name, c_int32) for name in ("values", "parts")),
        ("count", c_int64),
        *((name, c_double) for name in _ENDS),
        ("sums", c_double * _N_SUMS),
        ("lanes", c_double * (_N_SUMS * _LANES)),
        *((name, c_double) for name in ("before", "t_before")),
        ("kept", c_void_p),
    )


class ReductionsStruct(ctypes.Structure):
    """cosim_reductions."""

    _fields_ = (
        *((name, c_void_p) for name in ("instructions", "holds", "reductions", "registers")),
        *((name, c_int32) for name in ("n_instructions", "n_holds", "n_reductions")),
        ("n_rows", c_int64),
    )


declare(
    {
        "cosim_begin_reductions": (None, (c_void_p,)),
        "cosim_reduce_rows": (
            None,
            (c_void_p, c_int64, c_void_p, c_int64, c_int64, c_void_p, c_void_p, c_int64),
        ),
        "cosim_settled": (c_int64, (c_int64, c_void_p, c_double, c_double)),
    }
)


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


class KeptValues(NamedTuple):
    """What was kept of some values; what is not among the parts of its reduction has no meaning.

    Parameters
    ----------
    number : int
        How many there are; 0: nothing else has a meaning either.
    first, last, low, high, sum, squares : float
    shifted_sum, shifted_squares : float
        Of the differences to the first value.
    integral : float
        Trapezoidal rule over rows that follow each other and have a value both.
    rows : RowReductions
        What it was kept by.
    values : Vector, shape (N,)
        Of all rows, NaN where there is none.
    """

    number: int
    first: float
    last: float
    low: float
    high: float
    sum: float
    squares: float
    shifted_sum: float
    shifted_squares: float
    integral: float
    rows: RowReductions
    values: Vector

    def settled(self, band: float) -> float:
        """Return the instant [s] of the first value from which on all are near the last one.

        NaN: there is none.
        """
        count = len(self.values)
        place: int = library.cosim_settled(count, pointer(self.values), self.last, band)
        return NAN if place == count else self.rows.instant(place)


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
        self._durations_ns = tuple(compiled.durations_ns)
        self._code = int32(compiled.instructions)
        self._memory = np.zeros((compiled.n_registers, _CHUNK))
        for register, value in compiled.constants.items():
            self._memory[register] = value
        keeping = [place for place, bits in enumerate(parts.values()) if bits & _bits(("kept",))]
        self._kept = dict.fromkeys(keeping, _NOTHING)
        self._room = 0 if keeping else _NO_END
        self._n_rows = 0
        self._t = np.empty(_FIRST_ROOM)
        self._t_address = self._t.ctypes.data
        self._instants: tuple[int, int] | Nanoseconds = (0, 0)
        self._struct = ReductionsStruct(
            self._code.ctypes.data,
            addressof(self._holds),
            addressof(self._reductions),
            self._memory.ctypes.data,
            len(self._code),
            len(compiled.durations_ns),
            len(parts),
        )
        self._address = addressof(self._struct)
        self.begin()

    def begin(self, step_ns: StepNs = 1) -> None:
        """Forget all rows.

        Parameters
        ----------
        step_ns : int or Fraction
            Communication step of the run [ns]. Of a fraction stamps are rounded, and may be 1 ns
            less apart than a duration that is rounded, too.
        """
        self._n_rows = 0
        rounded = isinstance(step_ns, Fraction)
        for hold, duration_ns in zip(self._holds, self._durations_ns, strict=False):
            hold.duration_ns = duration_ns - rounded
        library.cosim_begin_reductions(self._address)

    def add(self, time_ns: Nanoseconds, rows: Matrix) -> None:
        """Go on over the next rows of a run; at once where it is known as a whole.

        Parameters
        ----------
        time_ns : Nanoseconds, shape (N,)
        rows : Matrix, shape (N, width)
            May be strided; the elements of a row may not.
        """
        self._instants = np.concatenate([self._instants, time_ns]) if self._n_rows else time_ns
        self._reduce(time_ns / NANOSECONDS, rows, pointer(time_ns), 0, 0)

    def add_regular(self, first_ns: int, step_ns: int, t: Vector, rows: Matrix) -> None:
        """Go on over the next rows, which are a step apart [ns], as all rows of the run are.

        Parameters
        ----------
        first_ns, step_ns : int
            Of these rows [ns].
        t : Vector, shape (N,)
            Their instants [s]; may be strided.
        rows : Matrix, shape (N, width)
            As of :meth:`add`.
        """
        if not self._n_rows:
            self._instants = (first_ns, step_ns)
        self._reduce(t, rows, None, first_ns, step_ns)

    def _reduce(
        self, t: Vector, rows: Matrix, time_ns: int | None, first_ns: int, step_ns: int
    ) -> None:
        count = len(rows)
        stride, size = rows.strides
        assert size == DOUBLE or rows.shape[1] == 1
        if self._n_rows + count > self._room:
            self._take_room(self._n_rows + count)
        if count > len(self._t):
            self._t = np.empty(count)
            self._t_address = self._t.ctypes.data
        self._t[:count] = t  # costs less than to ask for its address
        library.cosim_reduce_rows(
            self._address,
            count,
            time_ns,
            first_ns,
            step_ns,
            self._t_address,
            rows.ctypes.data,
            stride // DOUBLE,
        )
        self._n_rows += count

    def _take_room(self, needed: int) -> None:
        """Take memory for the values of so many rows, and more."""
        self._room = max(needed, 2 * self._room, _FIRST_ROOM)
        for place, values in self._kept.items():
            larger = np.empty(self._room)
            larger[: self._n_rows] = values[: self._n_rows]
            self._kept[place] = larger
            self._reductions[place].kept = larger.ctypes.data

    def kept(self, number: int) -> KeptValues:
        """Return what was kept of the rows so far for the reduction of a number.

        Its values stand in memory that the next run uses again.
        """
        place = self._places[self._registers[number]]
        struct = self._reductions[place]
        ends = [getattr(struct, name) for name in _ENDS]
        values = self._kept.get(place, _NOTHING)[: self._n_rows]
        return KeptValues._make([struct.count, *ends, *struct.sums, self, values])

    def instant(self, row: int) -> float:
        """Return the instant of a row of the run [s]."""
        if isinstance(self._instants, tuple):
            first_ns, step_ns = self._instants
            return (first_ns + row * step_ns) / NANOSECONDS
        return int(self._instants[row]) / NANOSECONDS


def _bits(parts: Sequence[str]) -> int:
    bits = 0
    for part in parts:
        bits |= 1 << PARTS.index(part)
    return bits
