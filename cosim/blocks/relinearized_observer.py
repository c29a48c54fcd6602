"""The unknown-input observer of a nonlinear plant, designed anew wherever its estimate is.

At every communication point the plant is linearized at the estimate of x and delta there, and the
observer (14)-(20) is designed on what that gives,

    x' = A x + B_1 u + B_2 delta + c,    y = C x + C_4 u + C_5 delta + d,

c and d as one more input, the constant 1. Over a communication step that observer is stepped
exactly. What goes on from one design to the next are the estimate of x and the difference w - q of
the filter, so that the estimate is continuous and satisfies

    x_hat' = f(x_hat, u, delta_hat) + L (y - g(x_hat, u, delta_hat))

at the points; z and q are those of the design at hand. It is of second order in the step where
y is linear in x: a local model is that of Rosenbrock and Euler. Else it is of first order, for what
y bends within a step is taken for a motion of x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.signals import Interface
from cosim.errors import CosimError, RunError
from cosim.native.numerics.linear import affine, first_order_hold
from cosim.theory.observers.observer import (
    ObserverDesign,
    StateSpace,
    delta_rows,
    initial_state_map,
    realize,
)
from cosim.theory.plants.descriptor import ReducedSystem


class NonlinearModel(Protocol):
    """A plant that is linearized where it is asked to."""

    @property
    def x(self) -> Vector:
        """Its own initial state."""

    @property
    def delta(self) -> Vector:
        """Its own initial disturbance."""

    def local(self, t: float, x: Vector, u: Vector, delta: Vector) -> ReducedSystem:
        """Linearize at a point; the last input of the result is the constant 1."""


@dataclass(frozen=True, eq=False)
class _LocalObserver:
    """The observer that was designed at a point.

    Parameters
    ----------
    reduced : ReducedSystem
    design : ObserverDesign
    system : StateSpace
        Inputs (u, 1, y), states (z, q).
    """

    reduced: ReducedSystem
    design: ObserverDesign
    system: StateSpace

    def w(self, v: Vector) -> Vector:
        """Return w = y - C4 (u, 1) of the inputs."""
        n_u = self.reduced.C4.shape[1]
        return v[n_u:] - affine([(self.reduced.C4, v[:n_u])])

    def outputs(self, x: Vector, v: Vector) -> Vector:
        """Return the outputs of the states (z, q)."""
        return affine([(self.system.C, x), (self.system.D, v)])


@dataclass(frozen=True, eq=False)
class _Reached:
    """The observer of the step that led to an instant, and its states (z, q) there."""

    observer: _LocalObserver
    x: Vector


class RelinearizedObserver:
    """Inputs u and y, outputs those of the observer that is not designed anew.

    Parameters
    ----------
    model : NonlinearModel
    design : callable
        Designs the observer on a local model; AssumptionError where that cannot be.
    interface : Interface
        Of the observer that is designed on one local model.
    x_a0 : Vector, shape (n_a,), optional
        Initial estimate; by default the closest to the model's own that is consistent with y(0).

    Raises
    ------
    RunError
        From ``initialize``, where no observer can be designed at the initial estimate.
    Stopped
        From ``advance``, where none can be at a later one, or the model fails there.
    """

    def __init__(
        self,
        model: NonlinearModel,
        design: Callable[[ReducedSystem], ObserverDesign],
        interface: Interface,
        x_a0: Vector | None = None,
    ) -> None:
        self._model = model
        self._design = design
        self._x_a0 = x_a0
        self._last: tuple[float, bytes, _Reached, _Reached, Vector] | None = None
        inputs = tuple(signal.name for signal in interface.inputs)
        # the point of the next design, and so all of it, follows from y
        feedthrough = dict.fromkeys((signal.name for signal in interface.outputs), inputs)
        self.interface = Interface(
            interface.inputs,
            interface.outputs,
            feedthrough,
            prepares=True,
            rollback=True,
            continuous=True,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Take the step; there is no design that holds for a whole run."""
        self._held = self._with_constant(held.astype(np.float64)) > 0.0
        self._held[self._constant] = False
        return {}

    @property
    def _constant(self) -> int:
        """The column of the constant 1 in the inputs of a local observer: behind u."""
        return self.interface.n_u - self.interface.by_name["y"].size

    def _with_constant(self, u: Vector) -> Vector:
        constant = self._constant
        return np.concatenate([u[:constant], [1.0], u[constant:]])

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at the initial estimate, the filter without a transient."""
        v = self._with_constant(u)
        try:
            x_a = self._x_a0
            if x_a is None:
                x_a = self._consistent(t, v)
            observer = self._designed(t, x_a, v, self._model.delta)
        except (CosimError, np.linalg.LinAlgError) as error:
            raise RunError(f"at t = {t} s: {error}") from error
        w = observer.w(v)
        z = x_a - affine([(observer.design.F, w)])
        self._reached = _Reached(observer, np.concatenate([z, w]))
        return self.outputs(t, u)

    def _consistent(self, t: float, v: Vector) -> Vector:
        """Return the state closest to the model's own that is consistent with y."""
        x = self._model.x
        observer = self._designed(t, x, v, self._model.delta)
        _, Xw = initial_state_map(observer.reduced, observer.design)
        # the shortest state for the y that is still to be explained: y - C x - ...
        rest = observer.w(v) - observer.reduced.C3 @ x
        inputs = np.concatenate([np.zeros(len(v) - len(rest)), rest])
        shortest: Vector = Xw[: len(x)] @ inputs + observer.design.F @ rest
        return x + shortest

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs at the time reached."""
        _, y = self._at(t, u)
        return y.copy()

    def _at(self, t: float, u: Vector) -> tuple[_Reached, Vector]:
        """Return the observer that is designed at the estimate of now, and its outputs."""
        key = u.tobytes()
        if self._last is not None:
            then, inputs, reached, result, y = self._last
            if reached is self._reached and then == t and inputs == key:
                return result, y
        result, y = self._redesigned(t, self._with_constant(u))
        self._last = (t, key, self._reached, result, y)
        return result, y

    def _redesigned(self, t: float, v: Vector) -> tuple[_Reached, Vector]:
        before = self._reached.observer
        n_a = len(before.design.F)
        z = self._reached.x[:n_a]
        w = before.w(v)
        x_a = z + affine([(before.design.F, w)])
        of_filter = w - self._reached.x[n_a:]
        delta = before.outputs(self._reached.x, v)[delta_rows(before.reduced)]
        observer = self._designed(t, x_a, v, delta)
        w = observer.w(v)
        states = np.concatenate([x_a - affine([(observer.design.F, w)]), w - of_filter])
        return _Reached(observer, states), observer.outputs(states, v)

    def _designed(self, t: float, x_a: Vector, v: Vector, delta: Vector) -> _LocalObserver:
        reduced = self._model.local(t, x_a, v[: self._constant], delta)
        design = self._design(reduced)
        return _LocalObserver(reduced, design, realize(reduced, design))

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times, with a design for each step."""
        rows: list[Vector] = []
        for k in range(len(t) - 1):
            try:
                self._step(float(t[k]), h, u[k], u[k + 1])
                rows.append(self.outputs(float(t[k + 1]), u[k + 1]))
            except (CosimError, np.linalg.LinAlgError) as error:
                completed = np.array(rows).reshape(len(rows), self.interface.n_y)
                where = ", ".join(f"{value:.6g}" for value in self._estimate(u[k + 1]))
                raise Stopped(
                    completed,
                    f"linearized at the estimate x_a = [{where}] at t = {t[k + 1]:g} s: {error}",
                ) from error
        return np.array(rows).reshape(len(rows), self.interface.n_y)

    def _estimate(self, u: Vector) -> Vector:
        """Return the estimate of x_a by the design that is there."""
        observer = self._reached.observer
        v = self._with_constant(u)
        n_a = len(observer.design.F)
        return self._reached.x[:n_a] + affine([(observer.design.F, observer.w(v))])

    def _step(self, t: float, h: float, u0: Vector, u1: Vector) -> None:
        now, _ = self._at(t, u0)
        system = now.observer.system
        discrete = first_order_hold(system.A, system.B, h, self._held)
        v0 = self._with_constant(u0)
        v1 = self._with_constant(u1)
        x = affine([(discrete.Ad, now.x), (discrete.B0, v0), (discrete.B1, v1)])
        self._reached = _Reached(now.observer, x)

    def save(self) -> _Reached:
        """Return the state; it does not change."""
        return self._reached

    def restore(self, state: _Reached) -> None:
        """Go back to a saved state."""
        self._reached = state
