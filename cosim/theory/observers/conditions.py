"""Conditions under which the observer exists, each refused with a named verdict and its evidence.

FEWER_OUTPUTS_THAN_DISTURBANCES, DEPENDENT_DISTURBANCES, RELATIVE_DEGREE, NO_TRANSFER: (14) fails,
the disturbance is not decoupled; with the last one y has it not at all, not even by more
derivatives. NOT_DETECTABLE: an invariant zero is not stable, and no gain moves it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.observers.placement import modes
from cosim.theory.plants.descriptor import ComplexVector, ReducedSystem
from cosim.theory.plants.geometry import RANK_TOLERANCE, normalized
from cosim.theory.plants.pencil import EPSILON, SINGULAR, rounding_of
from cosim.theory.plants.scaling import rank_between, values_between

_MEASURE: Final = (
    "measure an output that one integrator leads to (a rate, a force), or fit it to y offline"
)
ROUNDING_OF_EIGENVALUES: Final = 100.0 * EPSILON  # relative to the terms of their matrix
TRANSFER_POINTS: Final = (0.9 + 1.3j, -0.6 + 0.7j, 7e-3 + 2e-3j, 1e-5 - 4e-5j)  # s over |A_a|
MOST_SHOWN: Final = 12  # entries of a matrix in a message


@dataclass(frozen=True, eq=False)
class Decoupling:
    """How delta follows from ``w = y - C4 u`` and x_a.

    ::

        delta = direct (w - C3 x_a) + G (w' - C3 A x_a - C3 B_1a u - C3 B_2a direct w)
        A = A_a - B_2a direct C3

    What reaches w directly is solved for without a derivative, by the pseudo-inverse of C5; it is
    then a known signal. The rest follows from the derivative of ``outputs w``, the combinations
    that delta does not reach directly.

    Shapes: ``direct (n_d, n_y)``, ``G (n_d, n_y)``, ``outputs (n_y - r, n_y)`` with `r = rank C5`.
    ``values`` are the singular values of C3 B_2a for the rest of delta, its terms of size one.
    """

    direct: Matrix
    G: Matrix
    outputs: Matrix
    values: Vector


@dataclass(frozen=True, eq=False)
class _Split:
    """C5 by its singular values: what is solved directly, and the other w and delta."""

    direct: Matrix
    outputs: Matrix
    disturbances: Matrix

    @property
    def rank(self) -> int:
        """How many disturbances reach w directly."""
        return int(self.outputs.shape[1] - self.outputs.shape[0])


def decouple(reduced: ReducedSystem, weights: Vector) -> Decoupling:
    """Solve for delta (15), by one derivative of w at most.

    Parameters
    ----------
    reduced : ReducedSystem
        In units in which it is of size one: :func:`.descriptor.in_units`.
    weights : Vector, shape (n_y,)
        Of its outputs, where there are more than needed: what one is in the user's units.

    Raises
    ------
    AssumptionError
        If there are fewer outputs than disturbances, some cannot be distinguished, or one is not
        decoupled by one derivative of w (Assumption 5).
    """
    C3 = reduced.C3
    B_2a = reduced.B_2a
    n_y, n_d = reduced.C5.shape
    check_outputs(n_y, n_d)
    tolerance = max(SINGULAR, reduced.accuracy)
    _check_independent(reduced, tolerance)
    split = _split(reduced, weights, tolerance)
    C = split.outputs @ C3
    B = B_2a @ split.disturbances
    remaining = n_d - split.rank
    values = values_between(C @ B, np.abs(C) @ np.abs(B))
    reached = int((values > tolerance).sum())
    if reached < remaining:
        _check_transfer(reduced, tolerance)
        raise AssumptionError(
            _relative_degree(reduced, split, reached, tolerance), "RELATIVE_DEGREE", _MEASURE
        )
    of_outputs = np.linalg.norm(split.outputs / weights, axis=1)
    inverse = _left_inverse(C @ B, 1.0 / of_outputs)
    G = split.disturbances @ inverse @ split.outputs
    return Decoupling(split.direct, G, split.outputs, values)


def check_outputs(n_y: int, n_d: int) -> None:
    """Check that there are enough outputs for the disturbances.

    Raises
    ------
    AssumptionError
        If there are not.
    """
    if n_d > n_y:
        raise AssumptionError(
            f"the disturbance is not decoupled (Assumption 5): expected at least {n_d} outputs for "
            f"{n_d} disturbances, got {n_y} (FEWER_OUTPUTS_THAN_DISTURBANCES)",
            "FEWER_OUTPUTS_THAN_DISTURBANCES",
            f"measure {n_d - n_y} more output(s), or merge disturbances that act together",
        )


def _check_independent(reduced: ReducedSystem, tolerance: float) -> None:
    """Check that all disturbances act in directions of their own.

    Raises
    ------
    AssumptionError
        If some do not.
    """
    n_d = reduced.B_2a.shape[1]
    columns = np.vstack([reduced.B_2a, reduced.C5])
    directions = rank_between(columns, np.abs(columns), max(RANK_TOLERANCE, tolerance))
    if directions == n_d:
        return
    act = "1 disturbance acts" if n_d == 1 else f"{n_d} disturbances act"
    problem = (
        f"the disturbance is not decoupled (Assumption 5): {act} in {directions} "
        "independent directions: "
    )
    without_effect = np.flatnonzero(~columns.any(axis=0))
    if len(without_effect):
        raise AssumptionError(
            f"{problem}delta[{without_effect[0]}] acts on no state and no output "
            "(DEPENDENT_DISTURBANCES)",
            "DEPENDENT_DISTURBANCES",
            "leave it out",
        )
    raise AssumptionError(
        f"{problem}some of them act in the same direction and cannot be distinguished "
        "(DEPENDENT_DISTURBANCES)",
        "DEPENDENT_DISTURBANCES",
        "merge them into one",
    )


def _check_transfer(reduced: ReducedSystem, tolerance: float) -> None:
    """Check that the transfer from delta to y has full column rank.

    Raises
    ------
    AssumptionError
        If it has not: y does not have all of delta, whatever is done with it.
    """
    n_d = reduced.C5.shape[1]
    rank = _rank_of_transfer(reduced, list(range(n_d)), tolerance)
    if rank == n_d:
        return
    problem = (
        "the disturbance is not decoupled (Assumption 5): expected a transfer from delta to y of "
        f"rank {n_d}, got rank {rank} at every s (NO_TRANSFER): "
    )
    absent = [j for j in range(n_d) if not _rank_of_transfer(reduced, [j], tolerance)]
    if absent:
        names = ", ".join(f"delta[{j}]" for j in absent)
        raise AssumptionError(
            f"{problem}{names} never reaches y, and no derivative of y has it",
            "NO_TRANSFER",
            f"measure an output that {names} acts on, or leave it out",
        )
    raise AssumptionError(
        f"{problem}some disturbances reach y on the same paths, and no derivative of y "
        "distinguishes them",
        "NO_TRANSFER",
        "measure another output, on which they act differently, or merge disturbances that act "
        "together",
    )


def _rank_of_transfer(reduced: ReducedSystem, columns: list[int], tolerance: float) -> int:
    """Return the rank of the transfer from some elements of delta to y at almost every s.

    It is that of ``[s I - A_a, B_2a; -C3, C5]`` less the number of states, the largest one at a few
    points, far from the eigenvalues of A_a and near to them. Singular values of this matrix are
    known up to the rounding of its entries; an inverse of `s I - A_a` may have nothing but rounding
    where its exact entries are zero.
    """
    n = len(reduced.A_a)
    rate = float(np.linalg.norm(reduced.A_a, 2)) or 1.0
    inputs = np.vstack([reduced.B_2a[:, columns] / rate, reduced.C5[:, columns]])
    right = normalized(inputs, axis=0)
    below = normalized(np.hstack([-reduced.C3, right[n:]]), axis=1)
    dynamics = reduced.A_a / rate
    rank = 0
    for point in TRANSFER_POINTS:
        above = np.hstack([point * np.eye(n) - dynamics, right[:n]])
        values = np.linalg.svd(np.vstack([above, below]), compute_uv=False)
        rank = max(rank, int((values > max(tolerance, rounding_of(n))).sum()) - n)
    return rank


def _split(reduced: ReducedSystem, weights: Vector, tolerance: float) -> _Split:
    """Split w and delta by C5; where that is 0 both stay as they are, to the last bit."""
    C5 = reduced.C5
    n_y, n_d = C5.shape
    if not C5.any():
        return _Split(np.zeros((n_d, n_y)), np.eye(n_y), np.eye(n_d))
    left, values, right = np.linalg.svd(C5)
    r = int((values > tolerance).sum())
    right = right.T
    direct = right[:, :r] @ _left_inverse(left[:, :r] * values[:r], weights)
    return _Split(direct, left[:, r:].T, right[:, r:])


def _left_inverse(matrix: Matrix, weights: Vector) -> Matrix:
    """Compute the least-squares inverse of independent columns, with a weight for each row.

    A square matrix has one inverse, whatever the weights.
    """
    rows, columns = matrix.shape
    if rows == columns:
        weights = np.ones(rows)
    inverse: Matrix = np.linalg.pinv(weights[:, np.newaxis] * matrix) * weights
    if (weights == weights[:1]).all():
        return inverse
    # weights far apart cost digits, which one step of Newton's method gives back
    return inverse + (np.eye(columns) - inverse @ matrix) @ inverse


def _relative_degree(reduced: ReducedSystem, split: _Split, reached: int, tolerance: float) -> str:
    """Return the verdict RELATIVE_DEGREE with its evidence."""
    n_d = reduced.B_2a.shape[1]
    if split.rank:
        what = (
            f"{split.rank} of {n_d} disturbances reach y directly, and {reached} of the other "
            f"{n_d - split.rank} through one integrator"
        )
    else:
        what = f"{reached} of {n_d} disturbance(s) reach y through one integrator"
    return (
        f"the disturbance is not decoupled (Assumption 5): {what}; only more integrators lead to "
        f"y for the rest (RELATIVE_DEGREE): {_markov_parameters(reduced, split, tolerance)}"
    )


def check_detectable(fixed_modes: ComplexVector, magnitudes: Matrix) -> None:
    """Check that every fixed mode [1/s] of (M, C3) is stable.

    Parameters
    ----------
    fixed_modes : ComplexVector
    magnitudes : Matrix
        Of every entry of M the sum of the absolute values of its terms.

    Raises
    ------
    AssumptionError
        If one is not.
    """
    unstable = _unstable(fixed_modes, magnitudes)
    if len(unstable):
        eigenvalue = _eigenvalues_text(unstable[:1], magnitudes)
        raise AssumptionError(
            f"M - L C is not Hurwitz: eigenvalue {eigenvalue}; the invariant zero at "
            f"{modes(unstable[:1])} cannot be moved by L (NOT_DETECTABLE)",
            "NOT_DETECTABLE",
            "measure another output",
        )


def check_hurwitz(movable: ComplexVector, magnitudes: Matrix, fixed_modes: ComplexVector) -> None:
    """Check that every movable eigenvalue [1/s] of `M - L C3` is stable.

    Parameters
    ----------
    movable, fixed_modes : ComplexVector
    magnitudes : Matrix
        Of every entry of `M - L C3` the sum of the absolute values of its terms.

    Raises
    ------
    AssumptionError
        If one is not.
    """
    unstable = _unstable(movable, magnitudes)
    if len(unstable):
        eigenvalues = _eigenvalues_text(unstable, magnitudes)
        raise AssumptionError(
            f"M - L C is not Hurwitz: eigenvalue {eigenvalues}",
            cure=f"another L moves it: {len(movable)} eigenvalue(s) can be placed, fixed: "
            f"{modes(fixed_modes)}",
        )


def _markov_parameters(reduced: ReducedSystem, split: _Split, tolerance: float) -> str:
    """List C A^k B up to the first power at which they have full rank together, or n_a - 1."""
    C = split.outputs @ reduced.C3
    A = reduced.A_a - reduced.B_2a @ split.direct @ reduced.C3
    power = reduced.B_2a @ split.disturbances  # A^k B
    magnitudes = np.abs(power)
    listed = []
    stacked = np.zeros((0, power.shape[1]))
    terms = np.zeros(stacked.shape)
    for k in range(len(A)):
        markov = C @ power
        size = np.abs(C) @ magnitudes
        shown = f" = {markov.tolist()}" if markov.size <= MOST_SHOWN else ""
        listed.append(f"C A^{k} B{shown} of rank {rank_between(markov, size, tolerance)}")
        stacked = np.vstack([stacked, markov])
        terms = np.vstack([terms, size])
        if rank_between(stacked, terms, tolerance) == stacked.shape[1]:
            break
        power = A @ power
        magnitudes = np.abs(A) @ magnitudes
    return ", ".join(listed)


def _unstable(eigenvalues: ComplexVector, magnitudes: Matrix) -> ComplexVector:
    """Return the eigenvalues that are not stable, or may only be by rounding."""
    return eigenvalues[eigenvalues.real > -_rounding(magnitudes)]


def _eigenvalues_text(eigenvalues: ComplexVector, magnitudes: Matrix) -> str:
    if (eigenvalues.real >= 0.0).any():
        return modes(eigenvalues)
    return f"{modes(eigenvalues)}, which rounding may move by {_rounding(magnitudes):.1g}"


def _rounding(magnitudes: Matrix) -> float:
    """Return how far rounding may move an eigenvalue at zero.

    It scales with the terms of a matrix, not with their sums, in which they may cancel.
    """
    return ROUNDING_OF_EIGENVALUES * float(np.linalg.norm(magnitudes))
