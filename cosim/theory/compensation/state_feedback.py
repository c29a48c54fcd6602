"""State feedback and static feedforward: ``u = -K x + F delta + N r``.

Regulated is ``e = C x + D u + Dd delta - r``, with the plant ``x' = A x + B u + Bd delta``. A
constant delta leaves e = 0 where the equations

    [A  B]  [X]       [Bd]
    [C  D]  [U]   = - [Dd]

have a solution; then F = U + K X, and in the same manner N. Where the disturbance is matched, that
is Bd = B M, and neither D nor Dd is there, the solution is X = 0 and U = -M: delta is cancelled
exactly, whatever its course.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.observers.placement import STATE_FEEDBACK, modes, place
from cosim.theory.plants.descriptor import ComplexVector, ReducedSystem, invariant_zeros
from cosim.theory.plants.geometry import RANK_TOLERANCE, orthogonal_complement, output_nulling
from cosim.theory.plants.scaling import rank_between


@dataclass(frozen=True, eq=False, kw_only=True)
class RegulatedPlant:
    """The plant, and of its outputs those that are regulated.

    Shapes: ``A (n, n)``, ``B (n, n_u)``, ``Bd (n, n_d)``, ``C (p, n)``, ``D (p, n_u)``,
    ``Dd (p, n_d)``; ``zeros`` are the transmission zeros from u to the regulated outputs [1/s].
    """

    A: Matrix
    B: Matrix
    Bd: Matrix
    C: Matrix
    D: Matrix
    Dd: Matrix
    zeros: ComplexVector

    @property
    def static_equations(self) -> Matrix:
        """The matrix `[A, B; C, D]`, shape ``(n + p, n + n_u)``."""
        of_x = np.hstack([self.A, self.B])
        of_e = np.hstack([self.C, self.D])
        return np.vstack([of_x, of_e])

    def has_zero_at(self, s: complex) -> bool:
        """Return whether a transmission zero is at s [1/s], up to rounding."""
        n = len(self.A)
        equations = self.static_equations.astype(np.complex128)
        identity = np.eye(n)
        equations[:n, :n] -= s * identity
        sizes = np.abs(equations)
        rank = rank_between(equations, sizes, RANK_TOLERANCE)
        return rank < len(equations)


@dataclass(frozen=True, eq=False)
class SteadyGain:
    """``u = -K x + gain v``: where v is constant, x goes to ``states v`` and the error to 0.

    Shapes: ``gain (n_u, m)``, ``states (n, m)``.
    """

    gain: Matrix
    states: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        gain = frozen(self.gain, 2)
        states = frozen(self.states, 2)
        object.__setattr__(self, "gain", gain)
        object.__setattr__(self, "states", states)


def no_gain(plant: RegulatedPlant, m: int) -> SteadyGain:
    """Return the gain of m signals that are not used."""
    n, n_u = plant.B.shape
    gain = np.zeros((n_u, m))
    states = np.zeros((n, m))
    return SteadyGain(gain, states)


def regulated_plant(reduced: ReducedSystem, outputs: Sequence[int]) -> RegulatedPlant:
    """Choose the regulated outputs of a plant, by their positions in y.

    Raises
    ------
    AssumptionError
        If there is none, an output is not there or named twice, there are more than inputs, or u
        reaches them by a transfer without full rank.
    """
    n_y = len(reduced.C3)
    n_u = reduced.B_1a.shape[1]
    chosen = list(outputs)
    in_range = all(0 <= output < n_y for output in chosen)
    if not chosen or not in_range or len(set(chosen)) < len(chosen):
        raise AssumptionError(
            f"regulated: expected different elements of y, from 0 to {n_y - 1}, got {chosen}"
        )
    if n_u < len(chosen):
        raise AssumptionError(
            f"expected at least {len(chosen)} inputs for {len(chosen)} regulated outputs, got "
            f"{n_u} (FEWER_INPUTS_THAN_REGULATED_OUTPUTS)",
            "FEWER_INPUTS_THAN_REGULATED_OUTPUTS",
            "regulate fewer elements of y, or add an input",
        )
    C = reduced.C3[chosen]
    D = reduced.C4[chosen]
    Dd = reduced.C5[chosen]
    units = balancing(reduced.A_a)
    A_a = rescaled(reduced.A_a, units)
    B_1a = reduced.B_1a / units[:, np.newaxis]
    from_u = replace(reduced, A_a=A_a, B_2a=B_1a, C3=C * units, C4=D, C5=D, Kd=reduced.Ku)
    try:
        zeros = invariant_zeros(from_u)
    except AssumptionError as error:
        raise AssumptionError(
            "the transfer from u to the regulated outputs does not have full rank, so that no "
            "controller moves them independently; regulate others"
        ) from error
    return RegulatedPlant(
        A=reduced.A_a, B=reduced.B_1a, Bd=reduced.B_2a, C=C, D=D, Dd=Dd, zeros=zeros
    )


def state_feedback(
    A: Matrix,
    B: Matrix,
    *,
    K: ArrayLike | None = None,
    poles: Sequence[complex] | None = None,
    Q: ArrayLike | None = None,
    R: ArrayLike | None = None,
) -> Matrix:
    """Design the gain K of ``u = -K x``, shape ``(n_u, n)``.

    Parameters
    ----------
    A, B : Matrix
        Shapes ``(n, n)`` and ``(n, n_u)``.
    K : ArrayLike, optional
        The gain itself, shape ``(n_u, n)``.
    poles : sequence of complex, optional
        Eigenvalues of `A - B K` [1/s], as many as u can move.
    Q, R : ArrayLike, optional
        Weights of x and u of the linear-quadratic regulator: matrices, or their diagonals. R: 1 by
        default. Exactly one of K, poles and Q.

    Raises
    ------
    AssumptionError
        If not exactly one is given or it does not fit, (A, B) is not stabilizable, or the loop is
        not stable.
    """
    given = [name for name, value in (("K", K), ("poles", poles), ("Q", Q)) if value is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none"
        raise AssumptionError(f"state feedback: expected one of K, poles and Q, got {found}")
    if R is not None and Q is None:
        raise AssumptionError("state feedback: R, the weight of u, needs Q, the weight of x")
    reachable = _stabilizable_part(A, B)
    if poles is not None:
        gain = _placed(A, B, poles, reachable)
    elif Q is not None:
        gain = _regulator(A, B, Q, R)
    else:
        gain = _given_gain(K, B.T.shape)
    closed = np.linalg.eigvals(A - B @ gain)
    unstable = closed[closed.real >= 0.0].astype(np.complex128)
    if len(unstable):
        raise AssumptionError(
            f"state feedback: A - B K is not Hurwitz: eigenvalue {modes(unstable)}; choose another "
            "K, other poles, or another Q"
        )
    return frozen(gain, 2)


def feedforward(plant: RegulatedPlant, K: Matrix) -> SteadyGain:
    """Compute F of ``u = -K x + F delta``, shape ``(n_u, n_d)``: no error under a constant delta.

    Raises
    ------
    AssumptionError
        If the regulated outputs have a transmission zero at 0.
    """
    of_delta = np.vstack([plant.Bd, plant.Dd])
    right = -of_delta
    return _static_gain(plant, K, right, "feedforward of delta")


def reference_gain(plant: RegulatedPlant, K: Matrix) -> SteadyGain:
    """Compute N of ``u = -K x + N r``, shape ``(n_u, p)``: no error under a constant r.

    Raises
    ------
    AssumptionError
        If the regulated outputs have a transmission zero at 0.
    """
    n = len(plant.A)
    p = len(plant.C)
    no_motion = np.zeros((n, p))
    identity = np.eye(p)
    of_r = np.vstack([no_motion, identity])
    return _static_gain(plant, K, of_r, "reference r")


def _static_gain(plant: RegulatedPlant, K: Matrix, right: Matrix, what: str) -> SteadyGain:
    n, n_u = plant.B.shape
    states = balancing(plant.A)
    inputs = np.ones(n_u)
    outputs = np.ones(len(plant.C))
    units = np.concatenate([states, inputs])
    per_row = np.concatenate([1.0 / states, outputs])
    rows = per_row[:, np.newaxis]
    balanced = rows * plant.static_equations * units
    if plant.has_zero_at(0.0):
        raise AssumptionError(
            f"{what}: u has no constant effect on the regulated outputs, which have a transmission "
            "zero at 0; leave it out, or regulate others"
        )
    solution, *_ = np.linalg.lstsq(balanced, rows * right, rcond=None)
    X = states[:, np.newaxis] * solution[:n]
    U = solution[n:]
    return SteadyGain(U + K @ X, X)


def _stabilizable_part(A: Matrix, B: Matrix) -> Matrix:
    """Return an orthonormal basis of what u does not reach; refuse it where it is not stable."""
    unreached = _unreached(A, B)
    left = _modes_of(unreached, A)
    unstable = left[left.real >= 0.0]
    if len(unstable):
        raise AssumptionError(
            f"state feedback: u does not reach the mode {modes(unstable)}, which is not stable "
            "(NOT_STABILIZABLE)",
            "NOT_STABILIZABLE",
            "add an input",
        )
    return unreached


def unreached_modes(plant: RegulatedPlant) -> ComplexVector:
    """Return the modes of the plant that u does not reach, shape ``(k,)`` [1/s]."""
    return _modes_of(_unreached(plant.A, plant.B), plant.A)


def _modes_of(unreached: Matrix, A: Matrix) -> ComplexVector:
    """Return the modes in a left invariant subspace of A, given by an orthonormal basis."""
    return np.linalg.eigvals(unreached.T @ A.T @ unreached).astype(np.complex128)


def _unreached(A: Matrix, B: Matrix) -> Matrix:
    """Return an orthonormal basis of the left subspace that u does not reach, shape ``(n, k)``."""
    units = balancing(A)
    columns = units[:, np.newaxis]
    n, n_u = B.shape
    no_input = np.zeros((n, 0))
    no_feedthrough = np.zeros((n_u, 0))
    dual_A = rescaled(A, units).T
    dual_B = (B / columns).T
    unreached = output_nulling(dual_A, no_input, dual_B, no_feedthrough)
    basis, _ = np.linalg.qr(unreached / columns)
    return np.asarray(basis, np.float64)


def balancing(A: Matrix) -> Vector:
    """Return units of the states in which the rows and columns of A are of one size, shape (n,)."""
    from scipy.linalg import matrix_balance  # takes long to import, and is rarely needed

    between_states = A - np.diag(
        np.diag(A)
    )  # LAPACK counts the diagonal, which units do not change
    _, (scales, _) = matrix_balance(between_states, permute=False, separate=True)
    return np.asarray(scales, np.float64)


def rescaled(matrix: Matrix, units: Vector) -> Matrix:
    """Return a matrix from states to their rates, or to the next ones, with them in units."""
    rows = units[:, np.newaxis]
    return matrix * units / rows


def _placed(A: Matrix, B: Matrix, poles: Sequence[complex], unreached: Matrix) -> Matrix:
    """Place the poles on the part that u reaches, by duality with the observer."""
    W = orthogonal_complement(unreached)
    fixed = _modes_of(unreached, A)
    reached = W.T @ A.T @ W
    inputs = B.T @ W
    dual = place(reached, inputs, poles, fixed, STATE_FEEDBACK)
    gain: Matrix = dual.T @ W.T
    return gain


def _regulator(A: Matrix, B: Matrix, Q: ArrayLike, R: ArrayLike | None) -> Matrix:
    """Design the linear-quadratic regulator."""
    n, n_u = B.shape
    state_weight = weight_matrix("Q", Q, n)
    input_weight = np.eye(n_u) if R is None else weight_matrix("R", R, n_u)
    if np.linalg.eigvalsh(input_weight).min() <= 0.0:
        raise AssumptionError("state feedback: R: expected a positive definite matrix")
    from scipy.linalg import solve_continuous_are  # takes long to import, and is rarely needed

    try:
        P = solve_continuous_are(A, B, state_weight, input_weight)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise AssumptionError(
            f"state feedback: no regulator for these weights ({error}); choose a Q that weighs "
            "every mode that is not stable"
        ) from error
    gain = np.linalg.solve(input_weight, B.T @ P)
    return np.asarray(gain, np.float64)


def weight_matrix(name: str, values: ArrayLike, size: int) -> Matrix:
    """Return a weight as a symmetric matrix; a row is its diagonal.

    Raises
    ------
    AssumptionError
        If it has another size, or is not symmetric and positive semidefinite.
    """
    weight: Matrix = np.asarray(values, np.float64)
    if weight.ndim == 1:
        weight = weight * np.eye(len(weight))
    is_finite = bool(np.isfinite(weight).all())
    fits = is_finite and weight.shape == (size, size)
    least = 1e-14 * _size(weight)
    if not fits or not np.allclose(weight, weight.T, rtol=1e-12, atol=least):
        raise AssumptionError(
            f"state feedback: {name}: expected {size} numbers, its diagonal, or a symmetric matrix "
            f"of {size} rows, got {np.asarray(values).tolist()}"
        )
    eigenvalues = np.linalg.eigvalsh(weight)
    if eigenvalues.min() < -1e-12 * _size(weight):
        raise AssumptionError(f"state feedback: {name} is not positive semidefinite")
    symmetric: Matrix = 0.5 * (weight + weight.T)
    return symmetric


def _size(weight: Matrix) -> float:
    return float(np.abs(weight).max(initial=0.0))


def _given_gain(K: ArrayLike | None, shape: tuple[int, ...]) -> Matrix:
    gain = np.atleast_2d(np.asarray(K, np.float64))
    if gain.shape != shape or not np.isfinite(gain).all():
        raise AssumptionError(
            f"state feedback: K: expected finite numbers of shape {shape}, a row for each input, "
            f"a column for each state, got shape {gain.shape}"
        )
    return gain


def slowest_rate(K: Matrix, plant: RegulatedPlant) -> float:
    """Return the rate of the slowest mode of `A - B K` [1/s]."""
    eigenvalues = cast(Vector, np.linalg.eigvals(plant.A - plant.B @ K).real)
    return float(-eigenvalues.max())
