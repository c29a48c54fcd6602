"""The step of ``compensator.c``: a compensator between two estimates of theta."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, c_int32, c_void_p
from dataclasses import dataclass

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.native.library import address, int32, pointer
from cosim.native.step import NativeStep


@dataclass(frozen=True, eq=False, kw_only=True)
class CompensatorConstants:
    """The numbers of cosim_compensator that do not change.

    Parameters
    ----------
    before : Matrix, shape (n_u, known)
    lower, upper : Vector, shape (n_u,)
    states : int
        n_w, of the internal model.
    known, regulated : sequence of int
        Columns of the inputs: what is fed back, and the regulated outputs.
    reference, theta, standard_error : int
        First columns of the references, the estimates and their standard errors.
    parameters : int
    follows : bool
        There is an internal model, which follows the estimates.
    """

    before: Matrix
    lower: Vector
    upper: Vector
    states: int
    known: Sequence[int]
    regulated: Sequence[int]
    reference: int
    theta: int
    standard_error: int
    parameters: int
    follows: bool


class _CompensatorStruct(Structure):
    """cosim_compensator."""

    _fields_ = (
        *((name, c_int32) for name in ("n_u", "n_w", "known", "regulated", "parameters")),
        *((name, c_int32) for name in ("follows", "reference", "theta", "standard_error")),
        *((name, c_void_p) for name in ("known_columns", "regulated_columns")),
        *((name, c_void_p) for name in ("before", "lower", "upper")),
        *((name, c_void_p) for name in ("X", "minus_K_w", "generator", "checked")),
        *((name, c_void_p) for name in ("memory", "work")),
    )


class CompensatorStep:
    """The step of a compensator; it declines where an estimate is to be checked.

    Attributes
    ----------
    step : NativeStep
    u, w, theta : Vector, shapes (n_u,), (n_w,), (P,)
        What changes, and is the output, with ``is_active``.
    X, minus_K_w, generator : Matrix
        Shapes (n_w, known), (n_u, n_w), (n_w, n_w + regulated + n_u), at the present theta.
    checked : Matrix, shape (2, P)
        The estimates that were checked last, and their standard errors.
    """

    def __init__(self, constants: CompensatorConstants) -> None:
        n_u = len(constants.before)
        n_w = constants.states
        n_known = len(constants.known)
        parameters = constants.parameters
        driving = n_w + len(constants.regulated) + n_u
        given = (constants.before, constants.lower, constants.upper)
        arrays = [np.array(array, np.float64, order="C") for array in given]
        columns = [int32(constants.known), int32(constants.regulated)]
        self.X = np.zeros((n_w, n_known))
        self.minus_K_w = np.zeros((n_u, n_w))
        self.generator = np.zeros((n_w, driving))
        self.checked = np.full((2, parameters), NAN)
        memory = np.zeros(n_u + n_w + 1 + parameters)
        self.u = memory[:n_u]
        self.w = memory[n_u : n_u + n_w]
        self._active = memory[n_u + n_w : n_u + n_w + 1]
        self.theta = memory[n_u + n_w + 1 :]
        work = np.zeros(n_known + n_w + n_u + driving)
        gains = (self.X, self.minus_K_w, self.generator, self.checked)
        state = _CompensatorStruct(
            n_u,
            n_w,
            n_known,
            len(constants.regulated),
            parameters,
            int(constants.follows),
            constants.reference,
            constants.theta,
            constants.standard_error,
            *map(pointer, columns),
            *map(pointer, arrays),
            *map(pointer, gains),
            pointer(memory),
            pointer(work),
        )
        self.step = NativeStep(
            address("cosim_compensator_step"),
            state,
            n_y=len(memory),
            memory=memory,
            keep=(*columns, *arrays, *gains, work),
            outputs=address("cosim_compensator_outputs"),
        )

    @property
    def is_active(self) -> bool:
        """Whether the internal model is in use."""
        return bool(self._active[0])

    @is_active.setter
    def is_active(self, is_active: bool) -> None:
        self._active[0] = is_active
