"""Compiled expressions, evaluated: ``expression.c``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, byref, c_double, c_int32, c_int64, c_void_p

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.library import address, declare, library, pointer
from cosim.native.numerics.expression import Program
from cosim.native.step import DOUBLE, NativeStep


class ProgramStruct(ctypes.Structure):
    """cosim_program."""

    _fields_ = (
        ("length", c_int32),
        *((name, c_void_p) for name in ("code", "constants", "cache")),
    )


class ExpressionStruct(ctypes.Structure):
    """cosim_expression."""

    _fields_ = (("count", c_int32), ("programs", c_void_p))


declare(
    {
        "cosim_evaluate": (c_double, (POINTER(ProgramStruct), c_double)),
        "cosim_evaluate_rows": (
            None,
            (POINTER(ProgramStruct), c_int64, c_void_p, c_void_p, c_int64, c_void_p),
        ),
    }
)


def program_struct(program: Program) -> ProgramStruct:
    """Return cosim_program; the program must outlive it."""
    code = pointer(program.code)
    constants = pointer(program.constants)
    return ProgramStruct(len(program.code), code, constants)


def program_array(programs: Sequence[object]) -> ctypes.Array[ProgramStruct]:
    """Return the structs of programs, which must outlive them; empty ones of all else."""
    array_type = ProgramStruct * max(len(programs), 1)
    array = array_type()
    for i, program in enumerate(programs):
        if isinstance(program, Program):
            array[i] = program_struct(program)
    return array


def evaluate(program: Program, t: float) -> float:
    """Evaluate an expression at the instant ``t`` [s]."""
    struct = program_struct(program)
    value: float = library.cosim_evaluate(byref(struct), t)
    return value


def evaluate_at(programs: Sequence[Program], t: Vector) -> Matrix:
    """Evaluate expressions at instants ``t (N,)`` [s], shape ``(N, len(programs))``."""
    step = expression_step(programs)
    no_inputs = np.zeros((len(t) + 1, 0))
    ends_of_steps = np.concatenate([[0.0], t])  # where the first one begins does not matter
    return step.advance(ends_of_steps, 0.0, no_inputs)


class RowProgram:
    """A program over the columns of rows.

    Parameters
    ----------
    program : Program
        With columns (:meth:`Program.with_columns`) that the rows have.
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self._struct = program_struct(program)

    def evaluate(self, t: Vector, rows: Matrix) -> Vector:
        """Return the values at instants ``t (N,)`` [s] with rows ``(N, width)``, shape ``(N,)``.

        Rows may be strided, the elements of a row may not.
        """
        values = np.empty(len(t))
        if not len(t):
            return values
        assert t.flags.c_contiguous
        assert rows.strides[1] == DOUBLE
        library.cosim_evaluate_rows(
            byref(self._struct),
            len(t),
            t.ctypes.data,
            rows.ctypes.data,
            rows.strides[0] // DOUBLE,
            values.ctypes.data,
        )
        return values


def expression_step(programs: Sequence[Program]) -> NativeStep:
    """Build the step whose outputs are expressions in t; it has no memory."""
    n_y = len(programs)
    array = program_array(programs)
    state = ExpressionStruct(n_y, ctypes.addressof(array))
    function = address("cosim_expression_step")
    outputs = address("cosim_expression_refresh")
    no_memory = np.zeros(0)
    keep = (array, *programs)
    return NativeStep(function, state, n_y=n_y, memory=no_memory, keep=keep, outputs=outputs)
