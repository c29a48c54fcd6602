"""The pencil `s E - A`: whether it is regular, and its index, by the shuffle algorithm.

It is singular where `s E - A` is at every s; at a few points that shows reliably. One shuffle: by
an orthogonal transformation of the equations E becomes `[E1; 0]` with independent rows E1, and A
becomes `[A1; A2]`. The equations `0 = A2 x` are differentiated::

    [E1]        [A1]
    [A2] x'  =  [0 ] x

The index is the number of shuffles until E is regular. Each multiplies `det(s E - A)` by s to the
number of differentiated equations, so its degree, the number of finite eigenvalues, follows from
the ranks.

D. Luenberger, Time-invariant descriptor systems, Automatica 14 (1978) 473-480.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError

EPSILON: Final = float(np.finfo(np.float64).eps)
ROUNDINGS: Final = 64.0  # roundings of an entry that its data may have seen
SINGULAR: Final = 1e-12  # relative size below which a singular value counts as zero at least
SHUFFLED: Final = 1e-10  # the same after a shuffle: ranks rest on the ranks before
POINTS: Final = (0.37, 0.83, -1.71, 2.93, -0.61)  # s, where E is as large as A


@dataclass(frozen=True, eq=False)
class RankDecomposition:
    """The singular value decomposition `E = U1 diag(values) V1'`, rounding left out.

    Shapes: ``U1 (n, r)``, ``U2 (n, n - r)``, ``V1 (n, r)``, ``V2 (n, n - r)``, ``values (r,)``,
    ``neglected (n - r,)``: the values that are left out.
    ``growth`` is how many times rounding of the data grows in these coordinates.
    """

    U1: Matrix
    U2: Matrix
    V1: Matrix
    V2: Matrix
    values: Vector
    neglected: Vector
    growth: float


@dataclass(frozen=True)
class PencilStructure:
    """What the shuffles of a regular pencil show.

    Parameters
    ----------
    ranks : tuple of int
        Of E, then of E after each shuffle; the last is n.
    finite : int
        Number of finite eigenvalues.
    """

    ranks: tuple[int, ...]
    finite: int

    @property
    def index(self) -> int:
        """The index of the pencil."""
        return len(self.ranks) - 1


def rounding_of(n: int) -> float:
    """Return what rounding may leave in data of n rows whose entries are of size one."""
    return ROUNDINGS * n * EPSILON


def decompose(E: Matrix, rank: int | None = None) -> RankDecomposition:
    """Decompose E.

    Parameters
    ----------
    E : Matrix, shape (n, n)
        Scaled: :mod:`cosim.theory.plants.scaling`.
    rank : int, optional
        Where it is known, because E is written as what it is. It is found else: values beyond
        rounding of the largest, and so are the coordinates.
    """
    left, values, right = np.linalg.svd(E)
    growth = 1.0
    if rank is None:
        largest = values.max(initial=0.0)
        significant = values > rounding_of(len(E)) * largest
        rank = int(significant.sum())
        growth += 2.0 * float(largest / values[rank - 1]) if rank else 0.0
    V = right.T
    return RankDecomposition(
        U1=left[:, :rank],
        U2=left[:, rank:],
        V1=V[:, :rank],
        V2=V[:, rank:],
        values=values[:rank],
        neglected=values[rank:],
        growth=growth,
    )


def determined_rank(
    decomposition: RankDecomposition, A: Matrix, tolerance: float = SINGULAR
) -> int:
    """Compute the rank of A22: how many algebraic states the algebraic equations determine.

    Relative to these equations as orthonormal rows, beyond rounding.
    """
    zero = max(tolerance, rounding_of(len(A)) * decomposition.growth)
    rows = _algebraic_rows(decomposition, A, zero)
    values = np.linalg.svd(rows @ decomposition.V2, compute_uv=False)
    return int((values > zero).sum())


def shuffle(E: Matrix, A: Matrix, decomposition: RankDecomposition) -> PencilStructure:
    """Shuffle a pencil until E is regular.

    Parameters
    ----------
    E, A : Matrix, shape (n, n)
        Scaled: :mod:`cosim.theory.plants.scaling`.
    decomposition : RankDecomposition
        Of E.

    Raises
    ------
    AssumptionError
        If the pencil is singular.
    """
    _check_regular(E, A)
    n = len(A)
    size = float(np.linalg.norm(E, 2)) or 1.0
    ranks = [len(decomposition.values)]
    finite = n
    tolerance = SINGULAR
    while ranks[-1] < n and len(ranks) <= n:
        finite -= n - ranks[-1]
        determined = determined_rank(decomposition, A, tolerance)
        ranks.append(ranks[-1] + determined)
        rows = _algebraic_rows(decomposition, A, 0.0)
        E1 = decomposition.U1.T @ E / size
        A1 = decomposition.U1.T @ A / size
        E = np.vstack([E1, rows])
        A = np.vstack([A1, np.zeros(rows.shape)])
        size = 1.0
        tolerance = SHUFFLED
        decomposition = decompose(E, ranks[-1])
    return PencilStructure(tuple(ranks), finite)


def _algebraic_rows(decomposition: RankDecomposition, A: Matrix, tolerance: float) -> Matrix:
    """Return the algebraic equations `0 = A2 x` as orthonormal rows, dependent ones left out."""
    A2 = decomposition.U2.T @ A
    _, values, rows = np.linalg.svd(A2, full_matrices=False)
    independent = values > tolerance * np.linalg.norm(A, 2)
    return np.asarray(rows[independent], np.float64)


def regularity(E: Matrix, A: Matrix) -> float:
    """Return the largest reciprocal condition of `s E - A` at a few points s."""
    size_of_E = float(np.linalg.norm(E, 2)) or 1.0
    unit = float(np.linalg.norm(A, 2)) / size_of_E or 1.0
    best = 0.0
    for point in POINTS:
        values = np.linalg.svd(point * unit * E - A, compute_uv=False)
        if values[0] > 0.0:
            best = max(best, float(values[-1] / values[0]))
    return best


def _check_regular(E: Matrix, A: Matrix) -> None:
    """Check that `s E - A` is regular at one point at least.

    Raises
    ------
    AssumptionError
        If it is not.
    """
    best = regularity(E, A)
    if best <= rounding_of(len(A)):
        raise AssumptionError(
            "PENCIL_SINGULAR: det(s E - A) = 0 at every s (reciprocal condition at "
            f"{len(POINTS)} points: at most {best:.1g}); the equations do not determine the "
            "states: one follows from the others or contradicts them, and one is missing",
            "PENCIL_SINGULAR",
            "take out the dependent equation and add the one that is missing",
        )
