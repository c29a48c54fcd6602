"""Linear models, and their exact solver.

The solver discretizes a model for inputs that are interpolated linearly between communication
points, by the matrix exponential: there is no error but rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, check_design
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface
from cosim.errors import GraphError
from cosim.native.numerics.linear import (
    DiscretizedDynamics,
    OtherSteps,
    affine,
    first_order_hold,
    linear_step,
)
from cosim.native.step import NativeStep


@dataclass(frozen=True, slots=True)
class LinearModel:
    """``x' = A x + B u``, ``y = C x + D u``, with the initial state ``x = X0 + Xu u``.

    Parameters
    ----------
    interface : Interface
        n_u inputs, n_y outputs; its feedthrough is that of D.
    states : tuple of str
        Names of the n_x states.
    A, B, C, D : Matrix, shapes (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u)
    X0, Xu : shapes (n_x,), (n_x, n_u)
    """

    interface: Interface
    states: tuple[str, ...]
    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    X0: Vector
    Xu: Matrix

    def __post_init__(self) -> None:
        n_x = len(self.states)
        n_u = self.interface.n_u
        n_y = self.interface.n_y
        _check_shape("A", self.A, (n_x, n_x))
        _check_shape("B", self.B, (n_x, n_u))
        _check_shape("C", self.C, (n_y, n_x))
        _check_shape("D", self.D, (n_y, n_u))
        _check_shape("X0", self.X0, (n_x,))
        _check_shape("Xu", self.Xu, (n_x, n_u))

    @property
    def arrays(self) -> dict[str, Matrix]:
        """The numbers of the model by name."""
        return {"A": self.A, "B": self.B, "C": self.C, "D": self.D, "X0": self.X0, "Xu": self.Xu}

    def initial(self, t: float, u: Vector) -> Vector:
        """Return the initial state."""
        return self.X0 + affine([(self.Xu, u)])

    def derivatives(self, t: float, x: Vector, u: Vector) -> Vector:
        """Return x' = A x + B u."""
        return affine([(self.A, x), (self.B, u)])

    def outputs(self, t: float, x: Vector, u: Vector) -> Vector:
        """Return y = C x + D u."""
        return affine([(self.C, x), (self.D, u)])


@dataclass(frozen=True, slots=True)
class DescriptorModel:
    """A linear model, and the descriptor form from which its algebraic variables z were eliminated.

    ::

        [x']   [     ]     [     ]     [     ]
        [y ] = [ by_x] x + [ by_z] z + [ by_u] u
        [0 ]   [     ]     [     ]     [     ]

    Parameters
    ----------
    reduced : LinearModel
    algebraic : str
        The output that is z, n_z elements.
    by_x, by_z, by_u : Matrix, shapes (n, n_x), (n, n_z), (n, n_u)
        n = n_x + n_y + n_z rows.
    """

    reduced: LinearModel
    algebraic: str
    by_x: Matrix
    by_z: Matrix
    by_u: Matrix

    def __post_init__(self) -> None:
        interface = self.reduced.interface
        algebraic = interface.output_columns()[self.algebraic]
        n_x = len(self.reduced.states)
        n_z = algebraic.stop - algebraic.start
        rows = n_x + interface.n_y + n_z
        _check_shape("by_x", self.by_x, (rows, n_x))
        _check_shape("by_z", self.by_z, (rows, n_z))
        _check_shape("by_u", self.by_u, (rows, interface.n_u))

    @property
    def arrays(self) -> dict[str, Matrix]:
        """The numbers of the descriptor form by name."""
        return {"by_x": self.by_x, "by_z": self.by_z, "by_u": self.by_u}


def _check_shape(name: str, matrix: Matrix, needed: tuple[int, ...]) -> None:
    if matrix.shape != needed:
        raise GraphError(f"matrix {name}: expected shape {needed}, got {matrix.shape}")


class Linear:
    """A linear model with its exact solver: a component that steps natively.

    Parameters
    ----------
    model : LinearModel
    """

    def __init__(self, model: LinearModel) -> None:
        self.model = model
        self.interface = replace(
            model.interface,
            prepares=True,
            rollback=True,
            native=True,
            linearizable=True,
            substeps=True,
            continuous=True,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize, or take the recorded matrices."""
        arrays = dict(recorded) or self._discretized(h, held)
        check_design(arrays, self._shapes())
        self._arrays = arrays
        self._held = held
        self._h = h
        self._step = self._built_step()
        return arrays

    def prepare_substeps(self, lengths: Sequence[float], recorded: Design) -> Design:
        """Discretize for parts of a step, or take the recorded matrices, stacked."""
        arrays = dict(recorded) or self._discretized_substeps(lengths)
        n_x, n_u = self.model.B.shape
        by_u = (len(lengths), n_x, n_u)
        check_design(arrays, {"Ad": (len(lengths), n_x, n_x), "B0": by_u, "B1": by_u})
        known = {}
        matrices = (arrays["Ad"], arrays["B0"], arrays["B1"])
        for h, Ad, B0, B1 in zip(lengths, *matrices, strict=True):
            known[h] = DiscretizedDynamics(Ad, B0, B1)
        A = self._arrays["A"]
        B = self._arrays["B"]
        self._step = self._built_step(OtherSteps(A, B, self._held, self._h, known))
        return arrays

    def _built_step(self, others: OtherSteps | None = None) -> NativeStep:
        arrays = self._arrays
        discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
        return linear_step(discrete, arrays["C"], arrays["D"], others)

    def _discretized_substeps(self, lengths: Sequence[float]) -> dict[str, NDArray[np.float64]]:
        A = self._arrays["A"]
        B = self._arrays["B"]
        parts = [first_order_hold(A, B, h, self._held) for h in lengths]
        return {
            "Ad": np.stack([part.Ad for part in parts]),
            "B0": np.stack([part.B0 for part in parts]),
            "B1": np.stack([part.B1 for part in parts]),
        }

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        by_u = self.model.B.shape
        return {**shapes_of(self.model.arrays), "Ad": self.model.A.shape, "B0": by_u, "B1": by_u}

    def _discretized(self, h: float, held: Mask) -> dict[str, Matrix]:
        discrete = first_order_hold(self.model.A, self.model.B, h, held)
        return {**self.model.arrays, "Ad": discrete.Ad, "B0": discrete.B0, "B1": discrete.B1}

    @property
    def state(self) -> Vector:
        """The state x, shape (n_x,), to read and to write."""
        return self._step.memory[: len(self.model.states)]

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set the initial state of the model."""
        self.state[:] = self._arrays["X0"] + affine([(self._arrays["Xu"], u)])
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y = C x + D u."""
        return affine([(self._arrays["C"], self.state), (self._arrays["D"], u)])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        return self._step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return the matrices of the model, and x' at the state."""
        arrays = self._arrays
        own = Linearized(arrays["A"], arrays["B"], arrays["C"], arrays["D"])
        return own.at(self.state, u, own.A @ self.state + own.B @ u)

    def save(self) -> Vector:
        """Copy the state."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._step.restore(state)


def shapes_of(arrays: Mapping[str, Matrix]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of arrays by name."""
    return {name: array.shape for name, array in arrays.items()}


def with_dependencies(model: LinearModel) -> LinearModel:
    """Return the model with the feedthrough and initial dependencies that its matrices have."""
    ports = model.interface
    feedthrough = feedthrough_of(ports, model.D)
    initial = initial_dependencies(ports, model.C, model.D, model.Xu)
    interface = replace(ports, feedthrough=feedthrough, initial=initial)
    matrices = [np.ascontiguousarray(array, np.float64) for array in model.arrays.values()]
    return LinearModel(interface, model.states, *matrices)


def initial_dependencies(
    inputs: Interface, C: Matrix, D: Matrix, Xu: Matrix
) -> dict[str, tuple[str, ...]]:
    """Return what outputs depend on at initialization, where it is more than feeds through.

    Read off the zeros of C, Xu and D: the initial state follows the inputs by Xu.
    """
    direct = feedthrough_of(inputs, D)
    by_state = (C != 0.0) @ (Xu != 0.0)
    dependencies = feedthrough_of(inputs, by_state | (D != 0.0))
    return {output: names for output, names in dependencies.items() if names != direct[output]}


def feedthrough_of(inputs: Interface, D: Matrix | Mask) -> dict[str, tuple[str, ...]]:
    """Return the feedthrough of an interface by the nonzero blocks of D, shape (n_y, n_u)."""
    columns = inputs.input_columns()
    feedthrough = {}
    for output, rows in inputs.output_columns().items():
        feeding = [name for name, block in columns.items() if D[rows, block].any()]
        feedthrough[output] = tuple(feeding)
    return feedthrough
