"""Unknown-input observer design (13)-(18), its realization with one derivative filter (19)-(20), and the start time (36)-(38).

Any number of inputs, disturbances and outputs. With `w = y - C4 u` and `G = (C3 B_2a)^+`::

    delta = G (w' - C3 A_a x_a - C3 B_1a u),    F = B_2a G,    M = (I - F C3) A_a,    N = (I - F C3) B_1a

The derivatives of y and u are needed only together, in w', so **one** filter on w gives what two filters on y and u give (19)::

    q' = filter_rate (w - q),    w' is taken as filter_rate (w - q)

The modes of (M, C3) that C3 does not see are the invariant zeros of (A_a, B_2a, C3); no L moves them. In coordinates `[W, V]`,
V the unobservable subspace and W its complement, `M - L C3` is block triangular: `W'M W - W'L C3 W` and `V'M V`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.conditions import check_detectable, check_hurwitz, decoupling_matrix
from cosim.theory.descriptor import ComplexVector, ReducedSystem
from cosim.theory.geometry import orthogonal_complement, output_nulling, without_rounding
from cosim.theory.placement import place


@dataclass(frozen=True, eq=False, kw_only=True)
class ObserverDesign:
    """The matrices of the observer (16)-(18).

    Shapes: ``F (n_a, n_y)``, ``M (n_a, n_a)``, ``N (n_a, n_u)``, ``L (n_a, n_y)``, ``G (n_d, n_y)``. ``eigenvalues`` are those of
    `M - L C3` [1/s], ``fixed_modes`` those of them that no L can move, ``lambda_obs`` (37) [1/s], ``filter_rate`` (19) [rad/s].
    """

    F: Matrix
    M: Matrix
    N: Matrix
    L: Matrix
    G: Matrix
    eigenvalues: ComplexVector
    fixed_modes: ComplexVector
    lambda_obs: float
    filter_rate: float


@dataclass(frozen=True, eq=False)
class StateSpace:
    """The linear system `x' = A x + B u, y = C x + D u`."""

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix


@dataclass(frozen=True)
class IdentificationStartTime:
    """When identification may start (36)-(38), all [s]."""

    T_obs: float
    T_f: float
    D_max: float
    T_id: float


def design(
    reduced: ReducedSystem,
    *,
    L: ArrayLike | None = None,
    poles: Sequence[complex] | None = None,
    filter_rate: float,
) -> ObserverDesign:
    """Design the observer (14)-(18) with a given gain or with given poles.

    Parameters
    ----------
    reduced : ReducedSystem
        The model the observer believes.
    L : ArrayLike, optional
        Gain, shape ``(n_a, n_y)`` or, with one output, ``(n_a,)``.
    poles : sequence of complex, optional
        Eigenvalues [1/s] of `M - L C3` on the observable part: as many as are not fixed. Exactly one of ``L`` and ``poles``.
    filter_rate : float
        `lambda_f` of the derivative filter (19) [rad/s].

    Raises
    ------
    AssumptionError
        If (11) or (14) does not hold, if a mode that no L can move is not stable, if L or the poles do not fit or leave
        `M - L C3` not Hurwitz, or if the filter rate is not positive.
    """
    if not 0.0 < filter_rate < math.inf:
        raise AssumptionError(
            f"(19): filter_rate = {filter_rate:g}; needed a positive finite rate [rad/s]"
        )
    if (L is None) == (poles is None):
        raise AssumptionError(
            "(17): give either L or poles, not both"
            if poles is not None
            else "(17): neither L nor poles given; needed one of them"
        )
    G = decoupling_matrix(reduced)
    F = reduced.B_2a @ G
    M, N = (
        reduced.A_a - F @ (reduced.C3 @ reduced.A_a),
        reduced.B_1a - F @ (reduced.C3 @ reduced.B_1a),
    )
    V = output_nulling(M, np.zeros((len(M), 0)), reduced.C3, np.zeros((len(reduced.C3), 0)))
    W = orthogonal_complement(V)
    fixed_modes = _sorted_eigenvalues(V.T @ M @ V)
    check_detectable(fixed_modes, M)
    observable, seen = W.T @ M @ W, reduced.C3 @ W
    gain = (
        _gain(L, reduced.C3.T.shape)
        if poles is None
        else W @ place(observable, seen, poles, fixed_modes)
    )
    movable = _sorted_eigenvalues(observable - W.T @ gain @ seen)
    check_hurwitz(movable, M - gain @ reduced.C3, fixed_modes)
    eigenvalues = np.sort_complex(np.concatenate([movable, fixed_modes]))
    return ObserverDesign(
        F=frozen(F, 2),
        M=frozen(M, 2),
        N=frozen(N, 2),
        L=frozen(gain, 2),
        G=frozen(G, 2),
        eigenvalues=eigenvalues,
        fixed_modes=fixed_modes,
        lambda_obs=float(np.abs(eigenvalues.real).min()),
        filter_rate=float(filter_rate),
    )


def realize(reduced: ReducedSystem, observer: ObserverDesign) -> StateSpace:
    """Write observer, filter and reconstruction (18)-(20), (8) as one linear system.

    Returns
    -------
    StateSpace
        Inputs (u, y), states (z, q) with q of the size of y, outputs (x_a hat, delta hat, x_b hat, z, q).
    """
    n, m, p = len(reduced.A_a), reduced.B_1a.shape[1], len(reduced.C3)
    F, G, rate = observer.F, observer.G, observer.filter_rate
    U = np.hstack([np.eye(m), np.zeros((m, p))])  # u of (u, y)
    Y = np.hstack([-reduced.C4, np.eye(p)])  # w = y - C4 u
    Z, Q = np.eye(n, n + p), np.eye(n + p)[n:]  # z, q of (z, q)
    closed = observer.M - observer.L @ reduced.C3
    x_hat = Z, without_rounding(F @ Y, np.abs(F) @ np.abs(Y))
    w_dot = -rate * Q, rate * Y
    delta_hat = (
        G @ (w_dot[0] - reduced.C3 @ reduced.A_a @ x_hat[0]),
        G @ (w_dot[1] - reduced.C3 @ reduced.A_a @ x_hat[1] - reduced.C3 @ reduced.B_1a @ U),
    )
    x_b_hat = (
        reduced.Kx @ x_hat[0] + reduced.Kd @ delta_hat[0],
        without_rounding(
            reduced.Kx @ x_hat[1] + reduced.Ku @ U + reduced.Kd @ delta_hat[1],
            np.abs(reduced.Kx) @ np.abs(x_hat[1])
            + np.abs(reduced.Ku) @ U
            + np.abs(reduced.Kd) @ np.abs(delta_hat[1]),
        ),
    )
    return StateSpace(
        A=frozen(np.vstack([closed @ x_hat[0], w_dot[0]]), 2),
        B=frozen(np.vstack([closed @ x_hat[1] + observer.N @ U + observer.L @ Y, w_dot[1]]), 2),
        C=frozen(np.vstack([x_hat[0], delta_hat[0], x_b_hat[0], Z, Q]), 2),
        D=frozen(np.vstack([x_hat[1], delta_hat[1], x_b_hat[1], np.zeros((n + p, m + p))]), 2),
    )


def initial_state_map(
    reduced: ReducedSystem,
    observer: ObserverDesign,
    *,
    x_a0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
) -> tuple[Vector, Matrix]:
    """Give the start of the realized observer as `x(0) = X0 + Xw [u(0); y(0)]`.

    Parameters
    ----------
    reduced, observer : ReducedSystem, ObserverDesign
        The model and the design.
    x_a0 : ArrayLike, optional
        `x_a hat(0)`, shape ``(n_a,)``; left out: the shortest one with `C3 x_a hat(0) = y(0) - C4 u(0)`.
    q0 : ArrayLike, optional
        Filter state q(0), shape ``(n_y,)``; left out: `y(0) - C4 u(0)`, so that the filter starts without a transient.

    Returns
    -------
    tuple of Vector and Matrix
        X0, shape ``(n_a + n_y,)``, and Xw, shape ``(n_a + n_y, n_u + n_y)``.

    Raises
    ------
    AssumptionError
        If a given start has the wrong size or is not finite.
    """
    n, p = len(reduced.A_a), len(reduced.C3)
    Y = np.hstack([-reduced.C4, np.eye(p)])
    from_w = np.zeros((n, p)) if x_a0 is not None else np.linalg.pinv(reduced.C3)
    x_a = np.zeros(n) if x_a0 is None else _start_vector("x_a0", x_a0, n)
    q = np.zeros(p) if q0 is None else _start_vector("q0", q0, p)
    X0 = np.concatenate([x_a, q])
    Xw = np.vstack([(from_w - observer.F) @ Y, Y if q0 is None else np.zeros_like(Y)])
    return frozen(X0, 1), frozen(Xw, 2)


def identification_start_time(
    *,
    lambda_obs: float,
    filter_rate: float,
    delays: Sequence[float],
    epsilon_observer: float,
    epsilon_filter: float,
) -> IdentificationStartTime:
    """Give the time after which the transients have left the regression, `T_id = T_obs + T_f + D_max` (36)-(38).

    Parameters
    ----------
    lambda_obs, filter_rate : float
        Slowest observer rate (37) [1/s] and filter rate (19) [rad/s].
    delays : sequence of float
        `D_j` [s].
    epsilon_observer, epsilon_filter : float
        Fractions of the initial errors that may remain, each in (0, 1).

    Raises
    ------
    AssumptionError
        If a rate is not positive, a fraction not in (0, 1), or there is no delay.
    """
    for name, rate in (("lambda_obs", lambda_obs), ("filter_rate", filter_rate)):
        if not 0.0 < rate < math.inf:
            raise AssumptionError(f"(36)-(38): {name} = {rate:g}; needed a positive finite rate")
    for name, fraction in (
        ("epsilon_observer", epsilon_observer),
        ("epsilon_filter", epsilon_filter),
    ):
        if not 0.0 < fraction < 1.0:
            raise AssumptionError(f"(36)-(38): {name} = {fraction:g}; needed a fraction in (0, 1)")
    if not delays:
        raise AssumptionError("(36): no delays; needed at least one")
    T_obs, T_f, D_max = (
        math.log(1.0 / epsilon_observer) / lambda_obs,
        math.log(1.0 / epsilon_filter) / filter_rate,
        max(delays),
    )
    return IdentificationStartTime(T_obs=T_obs, T_f=T_f, D_max=D_max, T_id=T_obs + T_f + D_max)


def _gain(L: ArrayLike | None, shape: tuple[int, ...]) -> Matrix:
    gain = np.asarray(L, dtype=np.float64)
    if gain.ndim == 1 and shape[1] == 1:
        gain = gain[:, None]
    if gain.shape != shape:
        raise AssumptionError(
            f"(17): L has shape {gain.shape}; needed {shape}: one row per dynamic state, one column per output"
        )
    if not np.isfinite(gain).all():
        raise AssumptionError(f"(17): L = {gain.tolist()}; needed finite numbers")
    return gain


def _sorted_eigenvalues(matrix: Matrix) -> ComplexVector:
    return (
        np.sort_complex(np.linalg.eigvals(matrix).astype(np.complex128))
        if matrix.size
        else np.zeros(0, dtype=np.complex128)
    )


def _start_vector(name: str, values: ArrayLike, size: int) -> Vector:
    vector = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if vector.shape != (size,):
        raise AssumptionError(f"(18): {name} has shape {vector.shape}; needed ({size},)")
    if not np.isfinite(vector).all():
        raise AssumptionError(f"(18): {name} = {vector.tolist()}; needed finite numbers")
    return vector
