"""The step of ``window.c``: a linear system, and weighted sums over a window of steps."""

from __future__ import annotations

import ctypes
from ctypes import c_int32, c_void_p
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.library import address, declare, library, pointer
from cosim.native.numerics.linear import DiscretizedDynamics, LinearStruct
from cosim.native.step import NativeStep


class WindowStruct(ctypes.Structure):
    """cosim_window."""

    _fields_ = (
        ("linear", LinearStruct),
        *((name, c_int32) for name in ("taps", "width")),
        *((name, c_void_p) for name in ("Jx", "J0", "J1", "weights", "memory")),
    )


declare({"cosim_window_outputs": (None, (c_void_p, c_void_p, c_void_p))})


@dataclass(frozen=True, slots=True)
class WindowConstants:
    """The numbers of cosim_window.

    Parameters
    ----------
    discrete : DiscretizedDynamics
        n states, m inputs.
    C, D : Matrix, shapes (p, n), (p, m)
        Outputs of the system.
    Jx, J0, J1 : Matrix, shapes (width, n), (width, m), (width, m)
        The increment over a step is ``Jx x(t) + J0 u(t) + J1 u(t+h)``.
    weights : Vector
        Of the increments, the oldest first.
    """

    discrete: DiscretizedDynamics
    C: Matrix
    D: Matrix
    Jx: Matrix
    J0: Matrix
    J1: Matrix
    weights: Vector

    @property
    def matrices(self) -> tuple[Matrix, ...]:
        """Those of the system, in their order there."""
        return (self.discrete.Ad, self.discrete.B0, self.discrete.B1, self.C, self.D)

    @property
    def increments(self) -> tuple[Matrix, ...]:
        """Those of the increments, and the weights, in their order there."""
        return (self.Jx, self.J0, self.J1, self.weights)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """States, inputs and outputs of the system."""
        n, m = self.discrete.B0.shape
        return n, m, len(self.C)

    @property
    def width(self) -> int:
        """The number of sums."""
        return len(self.Jx)

    @property
    def memory(self) -> int:
        """The number of doubles that change."""
        return window_memory(len(self.discrete.Ad), len(self.weights), self.width)


def window_memory(n: int, taps: int, width: int) -> int:
    """Return the number of doubles that change, for ``n`` states and a window of ``taps``."""
    return 2 * n + 1 + width + taps * width


class WindowStep:
    """A linear system and the weighted sums; its memory begins with the state."""

    def __init__(self, constants: WindowConstants) -> None:
        matrices = [np.ascontiguousarray(matrix) for matrix in constants.matrices]
        increments = [np.ascontiguousarray(matrix) for matrix in constants.increments]
        memory = np.zeros(constants.memory)
        linear = LinearStruct(*constants.sizes, *map(pointer, [*matrices, memory]))
        taps = len(constants.weights)
        pointers = map(pointer, [*increments, memory])
        state = WindowStruct(linear, taps, constants.width, *pointers)
        n_y = len(constants.C) + constants.width
        keep = (*matrices, *increments)
        function = address("cosim_window_step")
        outputs = address("cosim_window_refresh")
        self.step = NativeStep(
            function,
            state,
            n_y=n_y,
            memory=memory,
            keep=keep,
            outputs=outputs,
            memory_is_state=True,
        )

    def start(self, x0: Vector) -> None:
        """Begin with the state ``x0`` and an empty window."""
        self.step.memory[:] = 0.0
        self.step.memory[: len(x0)] = x0

    def outputs(self, u: Vector) -> Vector:
        """Compute the outputs for inputs ``u`` at the time reached."""
        inputs = np.ascontiguousarray(u)
        y = np.empty(self.step.n_y)
        state = ctypes.addressof(self.step.state)
        library.cosim_window_outputs(state, pointer(inputs), pointer(y))
        return y
