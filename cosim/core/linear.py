"""Solvers: how a model's state moves over one communication step.

``exact`` is the discretization of a linear model for straight-line inputs, by the matrix exponential: no error but rounding. The
others integrate any model, and run on over communication points: see :class:`Solver`.
"""

from __future__ import annotations

from dataclasses import dataclass

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import GraphError
from cosim.native.step import DiscretizedDynamics, NativeStep, affine, first_order_hold, linear_step


@dataclass(frozen=True, slots=True)
class LinearModel:
    """``x' = A x + B u``, ``y = C x + D u``, started at ``x = X0 + Xu u``.

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
        n, m, p = len(self.states), self.interface.n_u, self.interface.n_y
        shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "X0": (n,), "Xu": (n, m)}
        for name, needed in shapes.items():
            if getattr(self, name).shape != needed:
                raise GraphError(
                    f"matrix {name}: found shape {getattr(self, name).shape}, needed {needed}"
                )

    @property
    def arrays(self) -> dict[str, Matrix]:
        """The numbers of the model by name."""
        return {"A": self.A, "B": self.B, "C": self.C, "D": self.D, "X0": self.X0, "Xu": self.Xu}

    def initial(self, t: float, u: Vector) -> Vector:
        """Give the state at the start."""
        return self.X0 + affine([(self.Xu, u)])

    def derivatives(self, t: float, x: Vector, u: Vector) -> Vector:
        """Give x' = A x + B u."""
        return affine([(self.A, x), (self.B, u)])

    def outputs(self, t: float, x: Vector, u: Vector) -> Vector:
        """Give y = C x + D u."""
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
    by_x, by_z, by_u : Matrix, shapes (n_x + n_y + n_z, n_x), (n_x + n_y + n_z, n_z), (n_x + n_y + n_z, n_u)
    """

    reduced: LinearModel
    algebraic: str
    by_x: Matrix
    by_z: Matrix
    by_u: Matrix

    def __post_init__(self) -> None:
        n_x, face = len(self.reduced.states), self.reduced.interface
        n_z = (
            face.output_columns()[self.algebraic].stop - face.output_columns()[self.algebraic].start
        )
        for name, columns in (("by_x", n_x), ("by_z", n_z), ("by_u", face.n_u)):
            found, needed = getattr(self, name).shape, (n_x + face.n_y + n_z, columns)
            if found != needed:
                raise GraphError(f"matrix {name}: found shape {found}, needed {needed}")

    @property
    def arrays(self) -> dict[str, Matrix]:
        """The numbers of the descriptor form by name."""
        return {"by_x": self.by_x, "by_z": self.by_z, "by_u": self.by_u}


class Linear:
    """A linear model with its exact solver: a component that steps natively.

    Parameters
    ----------
    model : LinearModel
    """

    def __init__(self, model: LinearModel) -> None:
        self.model = model
        self.interface = model.interface

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize, or take the recorded matrices."""
        if recorded:
            arrays = dict(recorded)
        else:
            discrete = first_order_hold(self.model.A, self.model.B, h, held)
            arrays = {**self.model.arrays, "Ad": discrete.Ad, "B0": discrete.B0, "B1": discrete.B1}
        self._arrays = arrays
        self._step: NativeStep = linear_step(
            DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"]), arrays["C"], arrays["D"]
        )
        return arrays

    @property
    def state(self) -> Vector:
        """The state x, shape (n_x,), to read and to write."""
        return self._step.memory[: len(self.model.states)]

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at the model's initial state."""
        self.state[:] = self._arrays["X0"] + affine([(self._arrays["Xu"], u)])
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give y = C x + D u."""
        return affine([(self._arrays["C"], self.state), (self._arrays["D"], u)])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        return self._step.advance(t, h, u)

    def save(self) -> Vector:
        """Copy the state."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._step.restore(state)


def start_dependencies(
    inputs: Interface, C: Matrix, D: Matrix, Xu: Matrix
) -> dict[str, tuple[str, ...]]:
    """Read off the zeros of C, Xu and D what outputs depend on at the start, where it is more than feeds through."""
    direct, pattern = feedthrough_of(inputs, D), ((C != 0.0) @ (Xu != 0.0)) | (D != 0.0)
    return {
        output: names
        for output, names in feedthrough_of(inputs, pattern).items()
        if names != direct[output]
    }


def feedthrough_of(inputs: Interface, D: Matrix | Mask) -> dict[str, tuple[str, ...]]:
    """Read the feedthrough of an interface off the nonzero blocks of D, shape (n_y, n_u)."""
    columns, rows = inputs.input_columns(), inputs.output_columns()
    return {
        output: tuple(name for name, c in columns.items() if D[r, c].any())
        for output, r in rows.items()
    }
