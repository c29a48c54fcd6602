"""Conditions under which the observer exists, each refused with a named verdict and its evidence.

FEWER_OUTPUTS_THAN_DISTURBANCES, DEPENDENT_DISTURBANCES, RELATIVE_DEGREE: (14) fails, the disturbance is not decoupled.
NOT_DETECTABLE: an invariant zero is not stable, and no gain moves it.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.theory.descriptor import ComplexVector, ReducedSystem
from cosim.theory.geometry import rank
from cosim.theory.placement import modes


def decoupling_matrix(reduced: ReducedSystem) -> Matrix:
    """Give `G = (C3 B_2a)^+`, the factor of (15), after checking (11) and (14).

    Raises
    ------
    AssumptionError
        If the disturbance reaches y directly (Assumption 4), or is not decoupled by one derivative of y (Assumption 5).
    """
    C3, B_2a = reduced.C3, reduced.B_2a
    n_y, n_d = reduced.C5.shape
    if reduced.C5.any():
        raise AssumptionError(
            f"Assumption 4 (11): C5 = {reduced.C5.tolist()}, needed 0: the disturbance reaches y directly, so it follows from y "
            "without a derivative; this observer cannot be used"
        )
    if n_d > n_y:
        raise AssumptionError(
            f"Assumption 5 (14): {n_y} output(s) for {n_d} disturbances, needed at least {n_d} outputs: the disturbance is "
            "not decoupled (FEWER_OUTPUTS_THAN_DISTURBANCES)"
        )
    if rank(B_2a) < n_d:
        raise AssumptionError(
            f"Assumption 5 (14): rank B_2a = {rank(B_2a)} for {n_d} disturbances: some of them act in the same direction and "
            "cannot be told apart; merge them into one (DEPENDENT_DISTURBANCES)"
        )
    reached = _rank_of_product(C3, B_2a)
    if reached < n_d:
        raise AssumptionError(
            f"Assumption 5 (14): rank C3 B_2a = {reached}, needed rank B_2a = {n_d}: the disturbance is not decoupled; it "
            f"reaches y only through more integrators (RELATIVE_DEGREE): {_markov_parameters(reduced)}"
        )
    return np.asarray(np.linalg.pinv(C3 @ B_2a), dtype=np.float64)


def check_detectable(fixed_modes: ComplexVector, M: Matrix) -> None:
    """Refuse a fixed mode [1/s] of (M, C3) that is not stable.

    Raises
    ------
    AssumptionError
        If there is one.
    """
    for mode in fixed_modes:
        if mode.real > -_rounding(M):
            raise AssumptionError(
                f"M - L C is not Hurwitz: eigenvalue {modes([mode])}; the invariant zero at {modes([mode])} cannot be moved by L "
                "(NOT_DETECTABLE); another output is needed"
            )


def check_hurwitz(movable: ComplexVector, closed: Matrix, fixed_modes: ComplexVector) -> None:
    """Refuse a gain that leaves a movable eigenvalue [1/s] of ``closed = M - L C3`` not stable.

    Raises
    ------
    AssumptionError
        If it does.
    """
    unstable = [mode for mode in movable if mode.real > -_rounding(closed)]
    if unstable:
        raise AssumptionError(
            f"M - L C is not Hurwitz: eigenvalue {modes(unstable)}; another L moves it: {len(movable)} eigenvalue(s) can be "
            f"placed, fixed: {modes(fixed_modes)}"
        )


def _rank_of_product(C: Matrix, B: Matrix) -> int:
    """Count the independent columns of C B, seen against the sizes of C and B, not against C B, which may be all rounding."""
    values = np.linalg.svd(C @ B, compute_uv=False)
    return int((values > 1e-12 * float(np.linalg.norm(C)) * float(np.linalg.norm(B))).sum())


def _markov_parameters(reduced: ReducedSystem) -> str:
    """List C A^k B up to the first power at which they have full rank together, or n_a - 1."""
    seen, text, power = np.zeros((0, reduced.B_2a.shape[1])), [], reduced.B_2a
    for k in range(len(reduced.A_a)):
        markov = reduced.C3 @ power
        text.append(f"C A^{k} B = {markov.tolist()}")
        seen, power = np.vstack([seen, markov]), reduced.A_a @ power
        if rank(seen) == seen.shape[1]:
            break
    return ", ".join(text)


def _rounding(matrix: Matrix) -> float:
    """Give what rounding may add to an eigenvalue at zero."""
    return 100.0 * float(np.finfo(np.float64).eps) * float(np.linalg.norm(matrix))
