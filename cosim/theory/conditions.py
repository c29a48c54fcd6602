"""Conditions under which the observer exists, each refused with a named verdict and its evidence.

FEWER_OUTPUTS_THAN_DISTURBANCES, DEPENDENT_DISTURBANCES, RELATIVE_DEGREE: (14) fails, the
disturbance is not decoupled. NOT_DETECTABLE: an invariant zero is not stable, and no gain moves it.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.theory.descriptor import ComplexVector, ReducedSystem
from cosim.theory.geometry import rank
from cosim.theory.placement import modes


def decoupling_matrix(reduced: ReducedSystem) -> Matrix:
    """Compute `G = (C3 B_2a)^+`, the factor of (15), after checking (11) and (14).

    Its shape is ``(n_d, n_y)``.

    Raises
    ------
    AssumptionError
        If the disturbance reaches y directly (Assumption 4), or is not decoupled by one derivative
        of y (Assumption 5).
    """
    C3 = reduced.C3
    C5 = reduced.C5
    B_2a = reduced.B_2a
    n_y, n_d = C5.shape
    if C5.any():
        raise AssumptionError(
            f"Assumption 4 (11): C5 = {C5.tolist()}, needed 0: the disturbance reaches y directly, "
            "so it follows from y without a derivative; this observer cannot be used"
        )
    if n_d > n_y:
        raise AssumptionError(
            f"Assumption 5 (14): {n_y} output(s) for {n_d} disturbances, needed at least {n_d} "
            "outputs: the disturbance is not decoupled (FEWER_OUTPUTS_THAN_DISTURBANCES)"
        )
    directions = rank(B_2a)
    if directions < n_d:
        raise AssumptionError(
            f"Assumption 5 (14): rank B_2a = {directions} for {n_d} disturbances: some of them act "
            "in the same direction and cannot be distinguished; merge them into one "
            "(DEPENDENT_DISTURBANCES)"
        )
    reached = _rank_of_product(C3, B_2a)
    if reached < n_d:
        raise AssumptionError(
            f"Assumption 5 (14): rank C3 B_2a = {reached}, needed rank B_2a = {n_d}: the "
            "disturbance is not decoupled; it reaches y only through more integrators "
            f"(RELATIVE_DEGREE): {_markov_parameters(reduced)}"
        )
    G = np.linalg.pinv(C3 @ B_2a)
    return np.asarray(G, dtype=np.float64)


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
            f"{modes(unstable[:1])} cannot be moved by L (NOT_DETECTABLE); another output is needed"
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
            f"M - L C is not Hurwitz: eigenvalue {eigenvalues}; another L moves it: "
            f"{len(movable)} eigenvalue(s) can be placed, fixed: {modes(fixed_modes)}"
        )


def _rank_of_product(C: Matrix, B: Matrix) -> int:
    """Compute the rank of C B relative to the sizes of C and B.

    Relative to C B itself, which may be all rounding, the rank would be meaningless.
    """
    values = np.linalg.svd(C @ B, compute_uv=False)
    size_of_C = float(np.linalg.norm(C))
    size_of_B = float(np.linalg.norm(B))
    significant = values > 1e-12 * size_of_C * size_of_B
    return int(significant.sum())


def _markov_parameters(reduced: ReducedSystem) -> str:
    """List C A^k B up to the first power at which they have full rank together, or n_a - 1."""
    listed = []
    power = reduced.B_2a  # A^k B
    stacked = np.zeros((0, power.shape[1]))
    for k in range(len(reduced.A_a)):
        markov = reduced.C3 @ power
        listed.append(f"C A^{k} B = {markov.tolist()}")
        stacked = np.vstack([stacked, markov])
        if rank(stacked) == stacked.shape[1]:
            break
        power = reduced.A_a @ power
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
    epsilon = float(np.finfo(np.float64).eps)
    return 100.0 * epsilon * float(np.linalg.norm(magnitudes))
