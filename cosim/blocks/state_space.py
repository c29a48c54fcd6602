"""Linear systems given by their matrices: a controller, and a system in discrete time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.linear import LinearModel, feedthrough_of, with_dependencies
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.numerics.linear import DiscretizedDynamics, affine, linear_step
from cosim.native.step import NativeStep


@dataclass(frozen=True, slots=True)
class SystemMatrices:
    """The matrices of a system with n states, m inputs and p outputs y, whose state is shown too.

    Parameters
    ----------
    A, B, x0 : shapes (n, n), (n, m), (n,)
    C, D : Matrix, shapes (p + n, n), (p + n, m)
        The rows of the outputs, then those of the state.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    x0: Vector

    def signals(self, unit: str | None) -> tuple[Signal, Signal, Signal]:
        """Return the input u and the outputs y, in ``unit``, and x."""
        n, m = self.B.shape
        u = Signal("u", m, role="input")
        y = Signal("y", len(self.C) - n, unit)
        x = Signal("x", n, role="state")
        return u, y, x


def system_matrices(
    kind: str, *, A: Matrix, B: Matrix, C: Matrix, D: Matrix | None, x0: Vector | None
) -> SystemMatrices:
    """Complete the matrices of a system; ``kind`` is what messages call it.

    Parameters
    ----------
    kind : str
    A, B, C : Matrix
        Shapes ``(n, n)``, ``(n, m)``, ``(p, n)``.
    D : Matrix or None
        Shape ``(p, m)``; None: 0.
    x0 : Vector or None
        Initial state, shape ``(n,)``; None: 0.

    Raises
    ------
    UsageError
        If the shapes do not fit together.
    """
    n = len(A)
    m = B.shape[1]
    p = len(C)
    if D is None:
        D = np.zeros((p, m))
    if x0 is None:
        x0 = np.zeros(n)
    _check_shape(kind, "A", A, (n, n))
    _check_shape(kind, "B", B, (n, m))
    _check_shape(kind, "C", C, (p, n))
    _check_shape(kind, "D", D, (p, m))
    _check_shape(kind, "x0", x0, (n,))
    C_x = np.eye(n)
    D_x = np.zeros((n, m))
    outputs_of_x = np.vstack([C, C_x])
    outputs_of_u = np.vstack([D, D_x])
    return SystemMatrices(A, B, outputs_of_x, outputs_of_u, x0)


def _check_shape(kind: str, name: str, array: Matrix | Vector, needed: tuple[int, ...]) -> None:
    if array.shape != needed:
        raise UsageError(f"{kind}: {name}: expected shape {needed}, got {array.shape}")


def controller(
    *,
    A: Matrix,
    B: Matrix,
    C: Matrix,
    D: Matrix | None = None,
    x0: Vector | None = None,
    unit: str | None = None,
) -> LinearModel:
    """Build ``x' = A x + B u``, ``y = C x + D u``: input u, output y, and the state x as an output.

    Parameters are those of :func:`system_matrices`; ``unit`` is that of y.

    Raises
    ------
    UsageError
        If the shapes do not fit together.
    """
    system = system_matrices("controller", A=A, B=B, C=C, D=D, x0=x0)
    u, y, x = system.signals(unit)
    matrices = (system.A, system.B, system.C, system.D, system.x0, np.zeros_like(system.B))
    model = LinearModel(Interface((u,), (y, x)), tuple(x.elements), *matrices)
    return with_dependencies(model)


class DiscreteStateSpace:
    """``x+ = A x + B u``, ``y = C x + D u``: x changes at every step, by u at its start.

    In a scenario a step is a sample period: ``Sampled(DiscreteStateSpace(system), n, hold=True)``.

    Parameters
    ----------
    system : SystemMatrices
    unit : str, optional
        The unit of y.
    """

    def __init__(self, system: SystemMatrices, *, unit: str | None = None) -> None:
        self.system = system
        u, y, x = system.signals(unit)
        feedthrough = feedthrough_of(Interface((u,), (y, x)), system.D)
        self.interface = Interface(
            (u,), (y, x), feedthrough, rollback=True, native=True, linearizable=True
        )
        self._step = linear_step(self.dynamics, system.C, system.D)

    @property
    def dynamics(self) -> DiscretizedDynamics:
        """What a step does; u at its end does not matter."""
        B1 = np.zeros(self.system.B.shape)
        return DiscretizedDynamics(self.system.A, self.system.B, B1)

    @property
    def _state(self) -> Vector:
        return self._step.memory[: len(self.system.x0)]

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set the initial state."""
        self._state[:] = self.system.x0
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y and x."""
        return affine([(self.system.C, self._state), (self.system.D, u)])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K steps."""
        return self._step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return the matrices."""
        system = self.system
        return Linearized(
            system.A,
            system.B,
            system.C,
            system.D,
            input_use="start",
            is_discrete=True,
            own_steps=1,
        )

    def save(self) -> Vector:
        """Copy the state."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._step.restore(state)
