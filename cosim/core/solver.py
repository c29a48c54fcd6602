"""Solvers: how a model's state moves over one communication step.

``exact`` is the discretisation of a linear model for straight-line inputs, by the matrix exponential: no error but rounding. The
others integrate any model, with the inputs on straight lines inside the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import GraphError, RunError
from cosim.native.step import HeldDiscretisation, NativeStep, affine, first_order_hold, linear

ADAPTIVE: Final = ("RK45", "DOP853", "Radau", "BDF", "LSODA")  # scipy.integrate
SOLVERS: Final = ("exact", "rk4", *ADAPTIVE)

Derivative: TypeAlias = Callable[[float, Vector, Vector], Vector]  # (t, x, u) -> x'
Integrator: TypeAlias = Callable[[Derivative, float, float, Vector, Vector, Vector], Vector]  # (f, t0, t1, x, u0, u1) -> x(t1)


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
                raise GraphError(f"matrix {name}: found shape {getattr(self, name).shape}, needed {needed}")

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
        """Discretise, or take the recorded matrices."""
        if recorded:
            arrays = dict(recorded)
        else:
            discrete = first_order_hold(self.model.A, self.model.B, h, held)
            arrays = {**self.model.arrays, "Ad": discrete.Ad, "B0": discrete.B0, "B1": discrete.B1}
        self._arrays = arrays
        self._step: NativeStep = linear(HeldDiscretisation(arrays["Ad"], arrays["B0"], arrays["B1"]), arrays["C"], arrays["D"])
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


def feedthrough_of(inputs: Interface, D: Matrix | Mask) -> dict[str, tuple[str, ...]]:
    """Read the feedthrough of an interface off the nonzero blocks of D, shape (n_y, n_u)."""
    columns, rows = inputs.input_columns(), inputs.output_columns()
    return {output: tuple(name for name, c in columns.items() if D[r, c].any()) for output, r in rows.items()}


def start_dependencies(inputs: Interface, C: Matrix, D: Matrix, Xu: Matrix) -> dict[str, tuple[str, ...]]:
    """Read off the zeros of C, Xu and D what outputs depend on at the start, where it is more than feeds through."""
    direct, pattern = feedthrough_of(inputs, D), ((C != 0.0) @ (Xu != 0.0)) | (D != 0.0)
    return {output: names for output, names in feedthrough_of(inputs, pattern).items() if names != direct[output]}


def rk4(f: Derivative, t0: float, t1: float, x: Vector, u0: Vector, u1: Vector) -> Vector:
    """Integrate over one step with the classical Runge-Kutta method of order 4 (Kutta, 1901)."""
    h, t, u = t1 - t0, 0.5 * (t0 + t1), 0.5 * (u0 + u1)
    k1 = f(t0, x, u0)
    k2 = f(t, x + 0.5 * h * k1, u)
    k3 = f(t, x + 0.5 * h * k2, u)
    k4 = f(t1, x + h * k3, u1)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def adaptive(method: str, *, rtol: float = 1e-9, atol: float = 1e-12) -> Integrator:
    """Give one of scipy's error-controlled solvers as an integrator over one communication step.

    Parameters
    ----------
    method : str
        One of ``ADAPTIVE``.
    rtol, atol : float
        Relative and absolute tolerance of the state.

    Raises
    ------
    RunError
        From the integrator, where the solver fails; with the solver's own words.
    """
    import scipy.integrate

    solver_class = getattr(scipy.integrate, method)

    def integrate(f: Derivative, t0: float, t1: float, x: Vector, u0: Vector, u1: Vector) -> Vector:
        slope = (u1 - u0) / (t1 - t0)
        solver = solver_class(lambda t, x: f(t, x, u0 + (t - t0) * slope), t0, x, t1, rtol=rtol, atol=atol)
        while solver.status == "running":
            message = solver.step()
        if solver.status == "failed":
            raise RunError(f"solver {method}: {message}")
        reached: Vector = np.array(solver.y)
        return reached

    return integrate


def integrator(solver: str, *, rtol: float = 1e-9, atol: float = 1e-12) -> Integrator:
    """Give a solver by name."""
    return rk4 if solver == "rk4" else adaptive(solver, rtol=rtol, atol=atol)
