"""The steps of ``functions.c``: components without memory, and rows that were drawn ahead."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import Structure, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.blocks.wrapping import InnerStruct, inner_struct
from cosim.native.library import address, int32, pointer
from cosim.native.numerics.expression import Program
from cosim.native.numerics.programs import program_array
from cosim.native.step import DOUBLE, NativeStep

Extrapolation: TypeAlias = Literal["error", "hold", "linear"]

_EXTRAPOLATION: Final[dict[Extrapolation, int]] = {
    "error": 0,
    "hold": 1,
    "linear": 2,
}  # COSIM_REFUSE, ...


class _InstantStruct(Structure):
    """cosim_instant."""

    _fields_ = tuple((name, c_void_p) for name in ("at", "self"))


class _SumStruct(Structure):
    """cosim_signed_sum."""

    _fields_ = (("count", c_int32), ("width", c_int32), ("signs", c_void_p))


class _GainStruct(Structure):
    """cosim_gain."""

    _fields_ = (("rows", c_int32), ("columns", c_int32), ("K", c_void_p))


class _LimitsStruct(Structure):
    """cosim_limits."""

    _fields_ = (("width", c_int32), ("lower", c_double), ("upper", c_double))


class _ProductsStruct(Structure):
    """cosim_products."""

    _fields_ = (("count", c_int32), ("width", c_int32), ("divides", c_void_p))


class _ThresholdStruct(Structure):
    """cosim_threshold."""

    _fields_ = (("width", c_int32), ("threshold", c_double))


class _AxisStruct(Structure):
    """cosim_axis."""

    _fields_ = (("count", c_int64), ("points", c_void_p), ("near", c_int64))


class _LookUpStruct(Structure):
    """cosim_look_up."""

    _fields_ = (
        *((name, c_int32) for name in ("inputs", "outside")),
        *((name, c_void_p) for name in ("axes", "values")),
    )


class _TableStruct(Structure):
    """cosim_table."""

    _fields_ = (
        *((name, c_int32) for name in ("width", "holds", "extrapolates")),
        ("count", c_int64),
        *((name, c_void_p) for name in ("t", "y", "slopes")),
        ("near", c_int64),
    )


class _RecordedStruct(Structure):
    """cosim_recorded."""

    _fields_ = (
        ("width", c_int32),
        *((name, c_int64) for name in ("count", "stride")),
        *((name, c_void_p) for name in ("t", "rows")),
        ("near", c_int64),
    )


class _LinearResponseStruct(Structure):
    """cosim_linear_response."""

    _fields_ = (
        *((name, c_int32) for name in ("states", "element")),
        *((name, c_void_p) for name in ("factor", "G", "c", "beta")),
    )


class _LinearSourceStruct(Structure):
    """cosim_linear_source."""

    _fields_ = (
        *((name, c_int32) for name in ("count", "responses")),
        *((name, c_void_p) for name in ("programs", "terms", "work")),
    )


class _ModulatedStruct(Structure):
    """cosim_modulated."""

    _fields_ = (
        ("inner", InnerStruct),
        *((name, c_int32) for name in ("width", "products")),
        *((name, c_void_p) for name in ("element", "alpha", "values")),
    )


class _DrawnStruct(Structure):
    """cosim_drawn."""

    _fields_ = (
        ("count", c_int64),
        ("width", c_int32),
        *((name, c_void_p) for name in ("rows", "next")),
    )


def _instant_step(function: str, state: Structure, n_y: int, *keep: object) -> NativeStep:
    """Build the step of a component without memory, by the name of its function."""
    instant = _InstantStruct(address(function), ctypes.addressof(state))
    no_memory = np.zeros(0)
    return NativeStep(
        address("cosim_instant_step"),
        instant,
        n_y=n_y,
        memory=no_memory,
        keep=(state, *keep),
        outputs=address("cosim_instant_outputs"),
        memory_is_state=True,
    )


def sum_step(signs: Sequence[float], width: int) -> NativeStep:
    """Build ``y = sum_i signs_i u_i``, added in their order, of inputs of ``width`` elements."""
    factors = np.array(signs, np.float64)
    state = _SumStruct(len(factors), width, pointer(factors))
    return _instant_step("cosim_sum_at", state, width, factors)


def gain_step(K: Matrix) -> NativeStep:
    """Build ``y = K u``, added in the order of the inputs."""
    matrix = np.array(K, np.float64, order="C")
    rows, columns = matrix.shape
    state = _GainStruct(rows, columns, pointer(matrix))
    return _instant_step("cosim_gain_at", state, rows, matrix)


def limit_step(lower: float, upper: float, width: int) -> NativeStep:
    """Build ``y = min(max(u, lower), upper)``."""
    state = _LimitsStruct(width, lower, upper)
    return _instant_step("cosim_limit_at", state, width)


def product_step(divides: Sequence[bool], width: int) -> NativeStep:
    """Build the product of inputs, or the quotient by those that ``divides`` names.

    It declines where one of these is 0.
    """
    flags = int32(divides)
    state = _ProductsStruct(len(flags), width, pointer(flags))
    return _instant_step("cosim_product_at", state, width, flags)


def switch_step(threshold: float, width: int) -> NativeStep:
    """Build ``y = u1`` where ``control >= threshold``, else ``y = u2``."""
    state = _ThresholdStruct(width, threshold)
    return _instant_step("cosim_switch_at", state, width)


def look_up_step(
    grid: Sequence[Vector], values: Matrix, extrapolation: Extrapolation
) -> NativeStep:
    """Build the linear interpolation of one or two inputs on a grid.

    With "error" it declines outside of the grid.
    """
    axes_type = _AxisStruct * len(grid)
    axes = axes_type()
    keep: list[object] = [axes]
    for axis, points in zip(axes, grid, strict=True):
        array = np.array(points, np.float64)
        axis.count = len(array)
        axis.points = pointer(array)
        keep.append(array)
    table = np.array(values, np.float64, order="C")
    state = _LookUpStruct(
        len(grid), _EXTRAPOLATION[extrapolation], ctypes.addressof(axes), pointer(table)
    )
    return _instant_step("cosim_look_up_at", state, 1, table, *keep)


def table_step(
    t: Vector, y: Matrix, slopes: Matrix, *, hold: bool, extrapolate: bool
) -> NativeStep:
    """Build a table over t; without ``extrapolate`` it declines outside of it.

    Parameters
    ----------
    t : Vector, shape (N,)
    y, slopes : Matrix, shape (N, n)
        Values at the instants, and slopes from there on.
    hold, extrapolate : bool
    """
    arrays = [np.array(array, np.float64, order="C") for array in (t, y, slopes)]
    width = y.shape[1]
    pointers = map(pointer, arrays)
    state = _TableStruct(width, int(hold), int(extrapolate), len(t), *pointers)
    return _instant_step("cosim_table_at", state, width, *arrays)


@final
class RecordedStep:
    """Rows of a recording; the step declines before the first one and after the last one.

    Parameters
    ----------
    width : int
        Of a row.
    """

    def __init__(self, width: int) -> None:
        self._state = _RecordedStruct(width)
        # The step keeps what it points to: the rows of this.
        self.step = _instant_step("cosim_recorded_at", self._state, width, self)

    def take(self, t: Vector, rows: Matrix) -> None:
        """Take rows (N, n), which may be strided, at t (N,), in place of those before."""
        instants = np.ascontiguousarray(t, np.float64)
        values = rows if rows.strides[-1] == DOUBLE else np.ascontiguousarray(rows, np.float64)
        self._taken = (instants, values)
        self._state.count = len(values)
        self._state.stride = values.strides[0] // DOUBLE
        self._state.t = pointer(instants)
        self._state.rows = values.ctypes.data
        self._state.near = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearResponse:
    """A term factor(t) c' expm(G t) beta of one element of a signal.

    Parameters
    ----------
    factor : Program
    G : Matrix, shape (v, v)
        [1/s]
    c, beta : Vector, shape (v,)
    element : int
    """

    factor: Program
    G: Matrix
    c: Vector
    beta: Vector
    element: int


def linear_source_step(
    programs: Sequence[Program], responses: Sequence[LinearResponse]
) -> NativeStep:
    """Build a source: an expression in t for each element, and responses that are added."""
    of_programs = program_array(programs)
    terms_type = _LinearResponseStruct * max(len(responses), 1)
    terms = terms_type()
    factors = program_array([term.factor for term in responses])
    keep: list[object] = [of_programs, *programs, factors, terms]
    most = 0
    for i, term in enumerate(responses):
        given = (term.G, term.c, term.beta)
        matrices = [np.array(array, np.float64, order="C") for array in given]
        n = len(term.beta)
        factor = ctypes.addressof(factors[i])
        terms[i] = _LinearResponseStruct(n, term.element, factor, *map(pointer, matrices))
        keep += [term.factor, *matrices]
        most = max(most, n)
    work = np.empty(4 * most**2)
    state = _LinearSourceStruct(
        len(programs),
        len(responses),
        ctypes.addressof(of_programs),
        ctypes.addressof(terms),
        pointer(work),
    )
    return _instant_step("cosim_linear_source_at", state, len(programs), work, *keep)


def modulated_step(
    source: NativeStep, elements: Sequence[int], alphas: Sequence[int]
) -> NativeStep:
    """Build a source whose last outputs are multiplied by inputs and added to the first ones.

    Parameters
    ----------
    source : NativeStep
        Of a component without memory.
    elements, alphas : sequence of int
        Of each product: the element of y that it is added to, and the input.
    """
    products = len(elements)
    width = source.n_y - products
    to = int32(elements)
    by = int32(alphas)
    values = np.empty(source.n_y)
    indices = (pointer(to), pointer(by))
    state = _ModulatedStruct(inner_struct(source), width, products, *indices, pointer(values))
    return _instant_step("cosim_modulated_at", state, width, source, to, by, values)


def drawn_step(rows: Matrix) -> NativeStep:
    """Build a step that takes row after row, shape (N, n), and declines where none is left.

    Its memory is the number of the next row, at least 1: its outputs are those of the last one.
    """
    count, width = rows.shape
    memory = np.ones(1)
    state = _DrawnStruct(count, width, pointer(rows), pointer(memory))
    return NativeStep(
        address("cosim_drawn_step"),
        state,
        n_y=width,
        memory=memory,
        keep=(rows,),
        outputs=address("cosim_drawn_outputs"),
    )
