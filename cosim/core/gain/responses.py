"""A component linearized by what its steps answer: for those that show nothing but their ports.

It goes through the same steps again and again, each time with one input a little higher, or lower,
over the first of them, and goes back in between. Half the differences of the outputs are its
response to a pulse, G_1, G_2, ... of a step each::

    G_1 = C Bt + D,    G_k = C Ad^(k-1) Bt    for k > 1

From these follow the states that inputs reach and outputs show, as many as the responses need (B.
L. Ho and R. E. Kalman, Regelungstechnik 14, 1966: from the singular values of the matrix of G_2,
G_3, ... in diagonals), and from Ad and Bt the system in continuous time, by the logarithm of::

    [ Ad  Bt ]
    [  0   I ]

What decays within a step belongs to D. The result has to predict the outputs for other inputs, or
there is none: the component is then not linear near this point, or has more states than are looked
for, or is not the same when it has gone back.
"""

from __future__ import annotations

from typing import Final, Generic, Protocol

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Component, Rollback, State
from cosim.core.gain.member_step import member_step
from cosim.core.linearization import InputUse, Linearized

MOST_STATES: Final = 8
STEPS: Final = 2 * MOST_STATES + 1
RELATIVE: Final = 2.0**-10  # of an input, or of 1: how much higher or lower it is
SMALLEST: Final = 1e-7  # of the largest singular value: what is beyond rounding and tolerances
PREDICTED: Final = 1e-4  # relative error of a prediction that is still one
ROOTS: Final = 40  # of a matrix, until it is near the identity


class Returning(Component, Rollback[State], Protocol[State]):
    """A component that can go back."""


def linearized_by_responses(
    component: Returning[State],
    t: float,
    h: float,
    u: Vector,
    *,
    held: Mask,
    latest: Mask,
    use: InputUse,
) -> Linearized | None:
    """Linearize a component at its state; None: there is no linear system that does what it does.

    It is back in its state then.

    Parameters
    ----------
    component : Returning
        Prepared and initialized.
    t : float
        The time reached [s].
    h : float
        Communication step [s].
    u : Vector, shape (n_u,)
        Inputs at ``t``.
    held : Mask, shape (n_u,)
        Which inputs have a zero-order hold.
    latest : Mask, shape (n_u,)
        Which of the others have their value at the end over a step.
    use : InputUse
        How the rest is taken through a step.

    Raises
    ------
    RunError
        If the component fails.
    """
    trial = _Trial(component, t, h, u, held)
    columns = trial.changing()
    pulses = []
    for column in columns:
        pulse = np.zeros((STEPS, 2, len(u)))
        pulse[0, :, column] = trial.sizes[column]
        pulses.append(trial.response(pulse) / trial.sizes[column])
    n_y = component.interface.n_y
    G = np.zeros((STEPS, n_y, len(u)))
    for column, response in zip(columns, pulses, strict=True):
        G[:, :, column] = response
    if not np.isfinite(G).all():
        return None
    realized = _realized(G, h)
    if realized is None:
        return None
    A, B, C, D = realized
    follows = trial.follows(D)
    linearized = Linearized(A, B, C, D, input_use=use, corrected=follows, latest=latest)
    return linearized if trial.confirms(linearized) else None


class _Trial(Generic[State]):
    """Steps of a component from one state, with inputs that differ from those there by little."""

    def __init__(
        self, component: Returning[State], t: float, h: float, u: Vector, held: Mask
    ) -> None:
        self._component = component
        self._t = t
        self._h = h
        self._u = u
        self._held = held
        self._n_y = component.interface.n_y
        self._state = component.save()
        self.sizes = RELATIVE * np.maximum(1.0, np.abs(u))

    def changing(self) -> list[int]:
        """Return the inputs that can change by little: those of real numbers."""
        is_real: list[bool] = []
        for signal in self._component.interface.inputs:
            is_real += [signal.type == "real"] * signal.size
        return np.flatnonzero(is_real).tolist()

    def response(self, change: Matrix) -> Matrix:
        """Return how outputs change, shape (K, n_y), with inputs at both ends, shape (K, 2, n_u).

        Half the difference between what more and what less give, so that squares cancel.
        """
        return 0.5 * (self._outputs(change) - self._outputs(-change))

    def _outputs(self, change: Matrix) -> Matrix:
        self._component.restore(self._state)
        rows = np.empty((len(change), self._n_y))
        try:
            for k, ends in enumerate(change):
                times = self._t + self._h * np.array([k, k + 1])
                rows[k] = self._component.advance(times, self._h, self._u + ends)[0]
        finally:
            self._component.restore(self._state)
        return rows

    def follows(self, D: Matrix) -> Mask:
        """Return which outputs are evaluated again for other inputs: those that then change."""
        seen = np.zeros(self._n_y, np.bool_)
        for column in self.changing():
            higher = self._u.copy()
            higher[column] += self.sizes[column]
            lower = self._u.copy()
            lower[column] -= self.sizes[column]
            above = self._component.outputs(self._t, higher).copy()
            below = self._component.outputs(self._t, lower)
            seen |= above != below
        return seen | ~D.any(axis=1)

    def confirms(self, linearized: Linearized) -> bool:
        """Return whether a linearization predicts the outputs for inputs without any pattern."""
        rng = np.random.default_rng(0)
        change = self.sizes * rng.uniform(-1.0, 1.0, (STEPS, 2, len(self._u)))
        expected = self.response(change)
        step = member_step(linearized, self._h, self._held, "only")
        state = np.zeros((step.n_s, 1))
        predicted = np.empty_like(expected)
        for k, (u0, u1) in enumerate(change):
            state, y = step.advance(state, u0[:, np.newaxis], u1[:, np.newaxis])
            predicted[k] = y[:, 0]
        error = np.abs(predicted - expected).max(axis=0)
        size = np.abs(expected).max(axis=0)
        return bool((error <= PREDICTED * size + 1e-12).all())


def _realized(G: Matrix, h: float) -> tuple[Matrix, Matrix, Matrix, Matrix] | None:
    """Return A, B, C and D with these responses to pulses of a step; None: there are none."""
    _, n_y, n_u = G.shape
    scale = np.abs(G[1:]).max(axis=(0, 2))
    scale[scale == 0.0] = 1.0
    scaled = G / scale[:, np.newaxis]
    first = _diagonals(scaled[1:])
    U, values, V = np.linalg.svd(first)
    n = int((values > SMALLEST * max(values[0], 1.0)).sum()) if values.size else 0
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, n_u)), np.zeros((n_y, 0)), G[0]
    root = np.sqrt(values[:n])
    left = U[:, :n] / root
    right = V[:n].T / root
    Ad = left.T @ _diagonals(scaled[2:]) @ right
    C = (U[:n_y, :n] * root) * scale[:, np.newaxis]
    later = (V[:n, :n_u].T * root).T  # Ad Bt
    try:
        Bt = np.linalg.solve(Ad, later)
    except np.linalg.LinAlgError:
        return None
    joined = np.block([[Ad, Bt], [np.zeros((n_u, n)), np.eye(n_u)]])
    logarithm = matrix_logarithm(joined)
    if logarithm is None:
        return None
    A = logarithm[:n, :n] / h
    B = logarithm[:n, n:] / h
    return A, B, C, G[0] - C @ Bt


def _diagonals(G: Matrix) -> Matrix:
    """Return the matrix whose block (i, j) is G[i + j] (Hankel)."""
    rows = []
    for i in range(MOST_STATES):
        rows.append(np.hstack([G[i + j] for j in range(MOST_STATES)]))
    return np.vstack(rows)


def matrix_logarithm(M: Matrix) -> Matrix | None:
    """Return the principal logarithm; None: there is none, as of a negative eigenvalue.

    By square roots (E. Denman and A. Beavers, Appl. Math. Comput. 2, 1976) until M is near the
    identity, then by its series.
    """
    identity = np.eye(len(M))
    root = M
    for count in range(ROOTS):
        E = root - identity
        if np.abs(E).sum(axis=1).max() < 0.1:
            term = E
            total = E.copy()
            for k in range(2, 20):
                term = -term @ E
                total = total + term / k
            return np.asarray(2.0**count * total, np.float64)
        square_root = _square_root(root)
        if square_root is None:
            return None
        root = square_root
    return None


def _square_root(M: Matrix) -> Matrix | None:
    Y = M
    Z = np.eye(len(M))
    for _ in range(30):
        try:
            next_Y = 0.5 * (Y + np.linalg.inv(Z))
            Z = 0.5 * (Z + np.linalg.inv(Y))
        except np.linalg.LinAlgError:
            return None
        change = np.abs(next_Y - Y).max()
        Y = next_Y
        if not np.isfinite(Y).all():
            return None
        if change <= 1e-15 * np.abs(Y).max():
            break
    is_root = np.abs(Y @ Y - M).max() <= 1e-9 * max(1.0, float(np.abs(M).max()))
    return np.asarray(Y, np.float64) if is_root else None
