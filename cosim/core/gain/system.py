"""How fast a loop grows by itself, whatever couples it: the system without a coupling error.

Components in continuous time are connected to one system, its algebraic loops eliminated: x' = A x.
Its poles are the eigenvalues of A. Where others are sampled or delayed, the growth is that of the
exact solution from sample to sample: the system in continuous time takes their outputs, which hold
(delayed ones are interpolated linearly) through a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Mask, Matrix
from cosim.core.gain.loop_map import LoopModel, product, slices, solved
from cosim.core.gain.member_step import MemberStep
from cosim.native.numerics.linear import first_order_hold


@dataclass(frozen=True, slots=True)
class ConnectedSystem:
    """The components in continuous time as one: x' = A x + B w, y = C x + D w; u = W y.

    Parameters
    ----------
    A, B, C, D : Matrix
        x are their states, w the outputs of the others, y the outputs of all.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix

    @property
    def poles(self) -> list[complex]:
        """The eigenvalues of A [1/s]."""
        poles: list[complex] = np.linalg.eigvals(self.A).tolist() if len(self.A) else []
        return poles


def reached_by(A: Matrix) -> Mask:
    """Return which states, as rows, may move where each, as a column, is not zero."""
    reached: Mask = (A != 0.0) | np.eye(len(A), dtype=np.bool_)
    done = 1
    while done < len(A):
        reached = reached @ reached
        done *= 2
    return reached


def connect(model: LoopModel) -> ConnectedSystem | None:
    """Connect the components in continuous time; None: their algebraic loop has no one solution."""
    outputs = model.outputs
    continuous = [number for number, member in enumerate(model.members) if member.is_continuous]
    states = slices([len(model.members[number].A) for number in continuous])
    n_x = states[-1].stop if states else 0
    n_y = outputs[-1].stop
    is_other = np.ones(n_y, np.bool_)
    of_x = np.zeros((n_y, n_x))
    of_y = np.zeros((n_y, n_y))
    for number, part in zip(continuous, states, strict=True):
        member = model.members[number]
        is_other[outputs[number]] = False
        of_x[outputs[number], part] = member.C
        of_y[outputs[number]] = member.D @ model.wiring[number]
    of_w = np.eye(n_y)[:, is_other]
    right = np.hstack([of_x, of_w])
    joined = solved(np.eye(n_y) - of_y, right)
    if joined is None:
        return None
    joined = np.where(reached_by(of_y) @ (right != 0.0), joined, 0.0)  # the rest is rounding
    C = joined[:, :n_x]
    D = joined[:, n_x:]
    A: Matrix = np.zeros((n_x, n_x))
    B = np.zeros((n_x, D.shape[1]))
    for number, part in zip(continuous, states, strict=True):
        member = model.members[number]
        by_y = member.B @ model.wiring[number]
        A[part, part] += member.A
        A[part] += by_y @ C
        B[part] += by_y @ D
    return ConnectedSystem(A, B, C, D)


def sampled_map(model: LoopModel, system: ConnectedSystem) -> Matrix | None:
    """Return what a period does to the exact solution; None: an algebraic loop has no solution."""
    maps = []
    for number in range(model.period):
        step = _ExactStep(model, system, model.steps(number)).map()
        if step is None:
            return None
        maps.append(step)
    return product(maps)


class _ExactStep:
    """A step of the coupled system: continuous states x, then the states s of all others."""

    def __init__(
        self, model: LoopModel, system: ConnectedSystem, steps: Sequence[MemberStep]
    ) -> None:
        self._model = model
        self._system = system
        self._steps = steps
        members = enumerate(model.members)
        self._others = [number for number, member in members if not member.is_continuous]
        sizes = [steps[number].n_s for number in self._others]
        n_x = len(system.A)
        self._x = slice(0, n_x)
        self._states = [slice(n_x + s.start, n_x + s.stop) for s in slices(sizes)]
        self._size = n_x + sum(sizes)
        widths = [len(model.members[number].D) for number in self._others]
        self._parts = slices(widths)

    def map(self) -> Matrix | None:
        """Return the map; None: the outputs of the others have no one solution at the start."""
        w0 = self._start()
        if w0 is None:
            return None
        units = np.eye(self._size)
        x = units[self._x]
        y0 = self._system.C @ x + self._system.D @ w0
        w1 = self._end(units, y0, w0)
        held = self._holds()
        discrete = first_order_hold(self._system.A, self._system.B, self._model.h, held)
        x1 = discrete.Ad @ x + discrete.B0 @ w0 + discrete.B1 @ w1
        y1 = self._system.C @ x1 + self._system.D @ w1
        result = [x1]
        for number, part in zip(self._others, self._states, strict=True):
            step = self._steps[number]
            wiring = self._model.wiring[number]
            result.append(step.S @ units[part] + step.S0 @ wiring @ y0 + step.S1 @ wiring @ y1)
        return np.vstack(result)

    def _start(self) -> Matrix | None:
        """Return the outputs of the others at the start, shape (n_w, size)."""
        n_w = self._system.D.shape[1]
        of_state = np.zeros((n_w, self._size))
        of_y = np.zeros((n_w, len(self._system.C)))
        for number, state, part in zip(self._others, self._states, self._parts, strict=True):
            step = self._steps[number]
            of_state[part, state] = step.Q
            of_y[part] = step.Q0 @ self._model.wiring[number]
        of_state[:, self._x] += of_y @ self._system.C
        return solved(np.eye(n_w) - of_y @ self._system.D, of_state) if n_w else of_state

    def _end(self, units: Matrix, y0: Matrix, w0: Matrix) -> Matrix:
        """Return the outputs of the others just before the end: those of delays go on."""
        w1 = w0.copy()
        for number, state, part in zip(self._others, self._states, self._parts, strict=True):
            if self._model.members[number].delay:
                step = self._steps[number]
                u0 = self._model.wiring[number] @ y0
                w1[part] = step.Y @ units[state] + step.Y0 @ u0
        return w1

    def _holds(self) -> Mask:
        """Return which outputs of the others hold through a step: all but those of delays."""
        held: list[bool] = []
        for number in self._others:
            member = self._model.members[number]
            held += [not member.delay] * len(member.D)
        return np.array(held, np.bool_)
