"""The kernels of the adaptive laws: the gradient, and regressor extension and mixing."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from cosim.arrays import NAN, Vector
from cosim.native.estimation.regression import RecoveryConstants, recovery_array
from cosim.native.library import address, declare, library, pointer
from cosim.native.step import NativeStep

AdaptiveLaw: TypeAlias = Literal["gradient", "drem"]


class AdaptiveStruct(ctypes.Structure):
    """cosim_adaptive."""

    _fields_ = (
        *((name, c_int32) for name in ("unknowns", "groups", "parameters", "held")),
        *((name, c_double) for name in ("start", "gain", "forgetting")),
        *((name, c_void_p) for name in ("recovery", "memory")),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class AdaptiveConstants:
    """The numbers of cosim_adaptive.

    Parameters
    ----------
    unknowns : int
        Number of eta, q.
    recovery : sequence of RecoveryConstants
        The formulas of theta.
    start_time : float
        First instant that counts [s].
    gain : float
        [1/s]
    forgetting : float
        Time constant in which samples lose their weight [s].
    held : bool
        Rows have a zero-order hold instead of linear interpolation.
    """

    unknowns: int
    recovery: Sequence[RecoveryConstants]
    start_time: float
    gain: float
    forgetting: float
    held: bool

    @property
    def parameters(self) -> int:
        """The number of theta."""
        return sum(len(formula.theta) for formula in self.recovery)


class AdaptiveStep:
    """An adaptive law bound to its memory; outputs theta and eta."""

    def __init__(self, law: AdaptiveLaw, constants: AdaptiveConstants) -> None:
        formulas = recovery_array(constants.recovery)
        state = AdaptiveStruct(
            constants.unknowns,
            len(constants.recovery),
            constants.parameters,
            int(constants.held),
            constants.start_time,
            constants.gain,
            constants.forgetting,
            ctypes.addressof(formulas),
        )
        count_memory = getattr(library, f"cosim_{law}_memory")
        memory = np.zeros(int(count_memory(byref(state))))
        state.memory = pointer(memory)
        function = address(f"cosim_{law}_step")
        n_y = constants.parameters + constants.unknowns
        self.step = NativeStep(function, state, n_y=n_y, memory=memory, keep=(formulas,))

    def initialize(self) -> Vector:
        """Forget the past and return the outputs, which have no value yet."""
        self.step.memory[:] = 0.0
        return np.full(self.step.n_y, NAN)

    def save(self) -> Vector:
        """Copy the state."""
        return self.step.save()

    def restore(self, state: Vector) -> None:
        """Return to a saved state."""
        self.step.restore(state)


declare({f"cosim_{law}_memory": (c_int64, (c_void_p,)) for law in ("gradient", "drem")})
