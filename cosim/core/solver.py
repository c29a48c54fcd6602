"""Solvers: how a model's state moves over one communication step.

``exact`` is the discretisation of a linear model for straight-line inputs, by the matrix exponential: no error but rounding. The
others integrate any model, and run on over communication points: see :class:`Solver`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import GraphError, RunError
from cosim.native.step import HeldDiscretisation, NativeStep, affine, first_order_hold, linear

ADAPTIVE: Final = ("RK45", "DOP853", "Radau", "BDF", "LSODA")  # scipy.integrate
TOLERANT: Final = (*ADAPTIVE, "CVode")  # what keeps to a relative tolerance
STEPPING: Final = ("rk4", *TOLERANT)  # for any model
SOLVERS: Final = ("exact", *STEPPING)

Slope: TypeAlias = Callable[[float, Vector], Vector]  # (t, x) -> x'


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
        n_z = face.output_columns()[self.algebraic].stop - face.output_columns()[self.algebraic].start
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


def start_dependencies(inputs: Interface, C: Matrix, D: Matrix, Xu: Matrix) -> dict[str, tuple[str, ...]]:
    """Read off the zeros of C, Xu and D what outputs depend on at the start, where it is more than feeds through."""
    direct, pattern = feedthrough_of(inputs, D), ((C != 0.0) @ (Xu != 0.0)) | (D != 0.0)
    return {output: names for output, names in feedthrough_of(inputs, pattern).items() if names != direct[output]}


def feedthrough_of(inputs: Interface, D: Matrix | Mask) -> dict[str, tuple[str, ...]]:
    """Read the feedthrough of an interface off the nonzero blocks of D, shape (n_y, n_u)."""
    columns, rows = inputs.input_columns(), inputs.output_columns()
    return {output: tuple(name for name, c in columns.items() if D[r, c].any()) for output, r in rows.items()}


class Solver(Protocol):
    """Moves ``x' = f(t, x)`` on step by step, and runs on: what it learnt of the solution it keeps until it is started anew.

    ``f`` is asked for no time beyond the ``t_end`` of a step. It may change its slope there, but not its value: then the solver
    is to be started anew.
    """

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` [s] with ``x``; the absolute tolerance of a state is ``rtol`` times its nominal value."""
        ...

    def step(self, t_end: float) -> float:
        """Take one step of the solver's own length, to ``t_end`` at most; give the time reached.

        Raises
        ------
        RunError
            Where the solver fails; with its own words.
        """
        ...

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step, shape (n_x,)."""
        ...

    def save(self) -> object:
        """Copy the state; a solver whose state cannot be copied starts anew here, as it will after ``restore``."""
        ...

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        ...


def rk4(f: Slope, t0: float, t1: float, x: Vector) -> Vector:
    """Integrate over one step with the classical Runge-Kutta method of order 4 (Kutta, 1901)."""
    h, t = t1 - t0, 0.5 * (t0 + t1)
    k1 = f(t0, x)
    k2 = f(t, x + 0.5 * h * k1)
    k3 = f(t, x + 0.5 * h * k2)
    k4 = f(t1, x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@final
class RungeKutta:
    """``rk4``: one step to wherever the step may end; the state within it is that of a shorter step.

    Parameters
    ----------
    f : callable
        x' at t and x.
    """

    def __init__(self, f: Slope) -> None:
        self._f = f
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t``; there are no tolerances to keep."""
        self._begin = self._end = (t, x)

    def step(self, t_end: float) -> float:
        """Take one step to ``t_end``."""
        self._begin = self._end
        self._end = t_end, rk4(self._f, self._begin[0], t_end, self._begin[1])
        return t_end

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step."""
        return self._end[1] if t == self._end[0] else rk4(self._f, self._begin[0], t, self._begin[1])

    def save(self) -> object:
        """Copy the state: where it is."""
        return self._end

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        self._begin = self._end = state  # type: ignore[assignment]


@final
class Adaptive:
    """One of scipy's error-controlled solvers.

    scipy's object is kept, and its bound moved on from step to step. LSODA starts anew at every bound: before scipy 1.17 all
    LSODA solvers of a process share one memory, so that two of them cannot run on in turns.

    Parameters
    ----------
    method : str
        One of ``ADAPTIVE``.
    f : callable
        x' at t and x.
    rtol : float
        Relative tolerance of the state.
    """

    def __init__(self, method: str, f: Slope, *, rtol: float) -> None:
        import scipy.integrate

        self._class, self._method, self._f, self._rtol = getattr(scipy.integrate, method), method, f, rtol
        self._runs_on = method != "LSODA"
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with ``x``."""
        self._first, self._nominals = (t, x), nominals
        self._solver: Any = None

    def step(self, t_end: float) -> float:
        """Take one step, to ``t_end`` at most."""
        try:
            solver = self._bounded(t_end)
            message = solver.step()
        except (ValueError, np.linalg.LinAlgError) as error:  # scipy's linear algebra refuses what is not finite
            raise RunError(f"solver {self._method}: {error}") from error
        if solver.status == "failed":
            raise RunError(f"solver {self._method}: {message}")
        self._dense: Any = None
        return float(solver.t)

    def _bounded(self, t_end: float) -> Any:
        solver = self._solver
        if solver is not None and solver.status == "finished" and not self._runs_on:
            self._first, solver = (solver.t, solver.y), None
        if solver is None:
            atol = self._rtol * self._nominals
            self._solver = solver = self._class(self._f, *self._first, t_end, rtol=self._rtol, atol=atol)
        elif self._runs_on:
            solver.t_bound, solver.status = t_end, "running"
        return solver

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step."""
        solver = self._solver
        if t == solver.t:
            return np.array(solver.y)
        if self._dense is None:
            self._dense = solver.dense_output()
        return np.array(self._dense(t))

    def save(self) -> object:
        """Copy the state: every array of scipy's object, the rest of which is never written to."""
        solver = self._solver
        if solver is not None and not self._runs_on:
            self.start(float(solver.t), np.array(solver.y), self._nominals)
        return self._first, self._nominals, self._solver, None if self._solver is None else _copied(vars(self._solver))

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        kept: dict[str, Any]
        self._first, self._nominals, self._solver, kept = state  # type: ignore[misc]
        if self._solver is not None:
            vars(self._solver).update(_copied(kept))


def _copied(attributes: dict[str, Any]) -> dict[str, Any]:
    copies = {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in attributes.items()}
    if "K_extended" in copies:  # DOP853 writes its stages to K, the beginning of K_extended, and interpolates from that
        copies["K"] = copies["K_extended"][: len(copies["K"])]
    return copies


@final
class Stateless:
    """The solver of a model without continuous states: time just moves."""

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin anywhere."""

    def step(self, t_end: float) -> float:
        """Go to ``t_end``."""
        return t_end

    def at(self, t: float) -> Vector:
        """Give no states."""
        return np.empty(0)

    def save(self) -> object:
        """Copy nothing."""
        return None

    def restore(self, state: object) -> None:
        """Go back to nothing."""
