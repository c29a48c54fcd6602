"""The gain that predicts the outputs of an unstable plant without losing what they say.

The Kalman filter without process noise, in the unstable modes alone: ``x = V w``, whatever the
covariance of w is at first. Its innovations are white with the covariance ``S = R + C V P V' C'``,
so that least squares of the innovations, weighed by S, are those of the outputs, once x(0) is
unknown too: P then only says how the unknown x(0) is split between filter and fit. That holds for
samples at any distances and for those that are missing, as long as gain and S are those of each
sample (B. Anderson and J. Moore, Optimal Filtering, 1979, sections 3.1 and 4.4).

``L`` with ``L S L' = R`` gives the innovations the covariance of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.predictor import predictor_gains
from cosim.native.numerics.linear import first_order_holds

UNSEEN = 1e14  # condition of the information about the unstable modes


@dataclass(frozen=True, eq=False)
class Predictor:
    """Gains of intervals, and lower triangles for the samples at their ends.

    Parameters
    ----------
    K : shape (m, n, n_y)
        From the output at the beginning of an interval to the state at its end.
    L : shape (m, n_y, n_y)
    """

    K: NDArray[np.float64]
    L: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class UnstableModes:
    """``w' = transition w``, ``x = V w``; P is the stationary covariance of w as predicted."""

    transition: Matrix
    V: Matrix
    P: Matrix


def stationary_predictor(A: Matrix, C: Matrix, h: float, covariance: Matrix) -> Predictor:
    """Return the predictor for samples every ``h`` seconds, all outputs measured.

    Its gain moves every unstable mode z to 1/z and leaves the others.

    Raises
    ------
    AssumptionError
        If an unstable mode is not seen by the outputs.
    """
    modes = unstable_modes(A, C, h, covariance)
    seen = C @ modes.V
    S = seen @ modes.P @ seen.T + covariance
    inverse = np.linalg.inv(S)
    gain = modes.V @ modes.transition @ modes.P @ seen.T @ inverse
    root = np.linalg.cholesky(covariance)
    root_of_S = np.linalg.cholesky(S)
    L = np.tril(root @ np.linalg.inv(root_of_S))
    return Predictor(gain[np.newaxis], L[np.newaxis])


def time_varying_predictor(
    A: Matrix,
    C: Matrix,
    steps: Vector,
    index: NDArray[np.integer],
    measured: NDArray[np.bool_],
    covariance: Matrix,
) -> Predictor:
    """Return the predictor for samples at any distances, some of them missing.

    Parameters
    ----------
    A : Matrix, shape (n, n)
    C : Matrix, shape (n_y, n)
    steps : Vector
        Distances of samples [s].
    index : array of int, shape (N,)
        Which of them ends at each sample.
    measured : shape (N, n_y)
    covariance : Matrix, shape (n_y, n_y)

    Raises
    ------
    AssumptionError
        If an unstable mode is not seen by the outputs.
    """
    transitions = _transitions(A, steps)
    by_distance = np.argsort(steps[index[1:]])
    usual = int(by_distance[(len(index) - 1) // 2]) + 1
    modes = _unstable_modes(transitions[index[usual]], C, covariance)
    of_modes = modes.V.T @ transitions @ modes.V
    seen = C @ modes.V
    gains, L = predictor_gains(of_modes, seen, covariance, index, measured, modes.P)
    K = np.zeros((len(index), *C.T.shape))
    K[1:] = modes.V @ gains[:-1]
    return Predictor(K, L)


def unstable_modes(A: Matrix, C: Matrix, h: float, covariance: Matrix) -> UnstableModes:
    """Return the modes that a predictor for samples every ``h`` seconds is for.

    Raises
    ------
    AssumptionError
        If one is not seen by the outputs.
    """
    return _unstable_modes(_transitions(A, np.array([h]))[0], C, covariance)


def _transitions(A: Matrix, steps: Vector) -> NDArray[np.float64]:
    nothing = np.zeros((len(A), 0))
    return first_order_holds(A, nothing, steps, np.zeros(0, np.bool_))[0]


def _unstable_modes(Ad: Matrix, C: Matrix, covariance: Matrix) -> UnstableModes:
    """Return the unstable modes of ``x' = Ad x``.

    The inverse Y of P solves ``Y = F'(Y + C' R^-1 C) F`` with F the inverse of the unstable block.
    """
    from scipy.linalg import schur, solve_discrete_lyapunov  # takes long to import

    T, Z, count = schur(Ad, output="real", sort="ouc")
    unstable = T[:count, :count]
    V = Z[:, :count]
    seen = C @ V
    F = np.linalg.inv(unstable)
    information = F.T @ seen.T @ np.linalg.inv(covariance) @ seen @ F
    Y = solve_discrete_lyapunov(F.T, information)
    if np.linalg.cond(Y) > UNSEEN:
        raise AssumptionError(
            "the outputs do not see an unstable mode of the plant, so nothing can predict it"
        )
    return UnstableModes(unstable, V, np.linalg.inv(Y))
