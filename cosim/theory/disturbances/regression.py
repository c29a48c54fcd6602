"""The regression (21)-(26) as one determinant.

Components that share one alpha form a **group** b with `V_b` basis functions, the sum of those of
its components; `l = sum V_b`. With `l + 1` delays the matrix with the rows

    [delta(t - D_j), alpha_1(t - D_j) K_1(D_j)', ..., alpha_B(t - D_j) K_B(D_j)'],    j = 1..l+1

has more columns than basis functions, so its determinant vanishes: that is (24). Laplace's
expansion along the delta column and then group by group gives one term for each choice of a row j
for delta and of a set `R_b` of `V_b` rows for every group::

    sum over terms of  mu chi = 0                                                              (25)
    mu  = sign delta(t - D_j) prod_b prod_{i in R_b} alpha_b(t - D_i)     known signals
    chi = prod_b det K_b[R_b]                                             unknown constants

`(l + 1)! / prod V_b!` terms. The sign is that of the permutation (j, R_1, R_2, ...). Terms are
ordered by the column that holds the last row (delta, then the groups), then by the rows: for two
exponentials exactly the paper's mu_1..mu_6 (32). In the code rows count from 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError

RowSet: TypeAlias = tuple[int, ...]  # rows of the matrix
Parts: TypeAlias = tuple[RowSet, ...]  # the rows of each group

# singular value of the alpha products, columns of length one, below which they count as dependent
COLLINEAR = 1e-9
MARGINAL = 3  # basis functions with different alphas up to which eta can be estimated


@dataclass(frozen=True)
class Term:
    """One term of (25).

    ``row`` is the row of delta, ``parts`` are the rows `R_b` of each group, ``sign`` belongs to mu.
    """

    row: int
    parts: Parts
    sign: int


def count_terms(sizes: Sequence[int]) -> int:
    """Compute the number of terms of (25), `(l + 1)! / prod V_b!`, for groups of these sizes."""
    permutations = math.factorial(sum(sizes) + 1)
    inside_groups = math.prod(math.factorial(size) for size in sizes)
    return permutations // inside_groups


def expand(sizes: tuple[int, ...]) -> tuple[Term, ...]:
    """Expand the determinant for groups of these sizes into the terms of (25), as ordered in (32).

    Raises
    ------
    AssumptionError
        If there is no group or a group is empty.
    """
    if not sizes or min(sizes) < 1:
        raise AssumptionError(
            "group sizes: expected at least one group, each with at least one basis function, got "
            f"{list(sizes)}"
        )
    last_row = sum(sizes)
    rows = range(last_row + 1)
    terms = []
    for row in rows:
        others = tuple(other for other in rows if other != row)
        for parts in _partitions(others, sizes):
            sign = _sign(row, parts)
            terms.append(Term(row, parts, sign))

    def order(term: Term) -> tuple[int, int, Parts]:
        column = _column_of(last_row, term)
        return column, term.row, term.parts

    return tuple(sorted(terms, key=order))


def mu(terms: Sequence[Term], delta: Matrix, alpha: Matrix) -> Matrix:
    """Compute the known signals of (25), signs included.

    Parameters
    ----------
    terms : sequence of Term
        The ``q + 1`` terms.
    delta : Matrix
        `delta(t - D_j)`, shape ``(N, l + 1)``.
    alpha : Matrix
        `alpha_b(t - D_j)`, shape ``(N, l + 1, n_groups)``.

    Returns
    -------
    Matrix
        Shape ``(N, q + 1)``; `p = -mu[:, 0]` and `m = mu[:, 1:]` (26).
    """
    columns = [term.sign * delta[:, term.row] for term in terms]
    signed_delta = np.stack(columns, axis=1)
    return signed_delta * alpha_products(terms, alpha)


def alpha_products(terms: Sequence[Term], alpha: Matrix) -> Matrix:
    """Compute `prod_b prod_{i in R_b} alpha_b(t - D_i)` (25) for every term.

    Parameters
    ----------
    terms : sequence of Term
        The ``q + 1`` terms.
    alpha : Matrix
        `alpha_b(t - D_j)`, shape ``(N, l + 1, n_groups)``.

    Returns
    -------
    Matrix
        Shape ``(N, q + 1)``.
    """
    products = np.ones((len(alpha), len(terms)))
    for column, term in enumerate(terms):
        for b, part in enumerate(term.parts):
            factors = alpha[:, list(part), b]
            products[:, column] *= factors.prod(axis=1)
    return products


def chi(terms: Sequence[Term], K: Sequence[Matrix]) -> Vector:
    """Compute the constants of (25), the products of minors `det K_b[R_b]`, without the signs.

    Parameters
    ----------
    terms : sequence of Term
        The ``q + 1`` terms.
    K : sequence of Matrix
        For each group the rows `K_b(D_j)'`, shape ``(l + 1, V_b)``.

    Returns
    -------
    Vector
        Shape ``(q + 1,)``.
    """
    minors = []
    for b, rows in enumerate(K):
        parts = {term.parts[b] for term in terms}
        minors.append(_minors(rows, parts))
    constants = []
    for term in terms:
        factors = [minors[b][part] for b, part in enumerate(term.parts)]
        constants.append(math.prod(factors))
    return np.array(constants)


def delayed(count: int) -> tuple[Term, ...]:
    """Return terms whose signals are delta at so many delays, where (25) is not expanded."""
    return tuple(Term(row, (), 1) for row in range(count))


def eta(terms: Sequence[Term], K: Sequence[Matrix]) -> Vector:
    """Compute the regression coefficients `eta_c = chi_c / chi_0` (26), shape ``(q,)``.

    Raises
    ------
    AssumptionError
        If chi_0 vanishes.
    """
    constants = chi(terms, K)
    normalizer = constants[0]
    if normalizer == 0.0:
        raise AssumptionError(
            "the coefficient that normalizes the regression, chi_0, is zero; choose other delays"
        )
    ratios: Vector = constants[1:] / normalizer
    return ratios


def check_delays(delays: Sequence[float], needed: int) -> None:
    """Check the delays `D_j` [s] of (5); ``needed`` is `l + 1`.

    Raises
    ------
    AssumptionError
        If their number is not ``needed``, one is negative or not finite, or two are equal.
    """
    if len(delays) != needed:
        raise AssumptionError(
            f"delays: expected {needed}, one more than the {needed - 1} basis functions, got "
            f"{len(delays)} (Assumption 3)"
        )
    numbered = list(enumerate(delays, start=1))
    for j, D in numbered:
        if not 0.0 <= D < math.inf:
            raise AssumptionError(
                f"delay {j}: expected a finite time of 0 or more, got {D:g} s (Assumption 3)"
            )
    for (i, first), (j, second) in combinations(numbered, 2):
        if first == second:
            raise AssumptionError(
                f"delays {i} and {j}: expected distinct delays, got {first:g} s twice "
                "(Assumption 3)"
            )


def check_alpha_products(terms: Sequence[Term], alpha: Matrix, names: Sequence[str]) -> None:
    """Check that the alpha products are independent; else (26) has many solutions for any data.

    Terms with the same row of delta multiply the same `delta(t - D_j)`, so their alpha products
    must be independent in time.

    Parameters
    ----------
    terms : sequence of Term
        The terms.
    alpha : Matrix
        `alpha_b(t - D_j)` over a time grid, shape ``(N, l + 1, n_groups)``, N at least the number
        of terms per row of delta.
    names : sequence of str
        A name for each group, for the message.

    Raises
    ------
    AssumptionError
        If two alphas are proportional (their groups must be merged), if products are dependent for
        another reason, or if the grid is too short to decide.
    """
    check_proportional(alpha, names)
    products = alpha_products(terms, alpha)
    for row in sorted({term.row for term in terms}):
        columns = [c for c, term in enumerate(terms) if term.row == row]
        _check_independent(products[:, columns], row, names)


def check_proportional(alpha: Matrix, names: Sequence[str]) -> None:
    """Check that no alpha is a multiple of another one; parameters as above.

    Raises
    ------
    AssumptionError
        If one is.
    """
    for a, b in combinations(range(len(names)), 2):
        pair = alpha[:, :, [a, b]].reshape(-1, 2)
        if _rank(pair) < 2:
            raise AssumptionError(
                f"alpha {names[a]!r} and alpha {names[b]!r} are proportional; merge their "
                "components into one group (give them the same alpha)"
            )


def linear_route_warning(sizes: Sequence[int]) -> str:
    """Return why estimating eta linearly (26) is poor for groups of these sizes, or ``""``."""
    if len(sizes) == 1 or sum(sizes) != MARGINAL:
        return ""
    return (
        f"the linear route is marginal: {_unknowns(sizes)}; expect a poor condition, or merge "
        "alphas, or estimate theta directly"
    )


def linear_route_problem(sizes: Sequence[int]) -> str:
    """Return why eta cannot be estimated linearly (26) for groups of these sizes, or ``""``.

    With exact data the condition of the information matrix is 3e4 for the paper's l = 2, and 4e12
    or worse for l = 4.
    """
    if len(sizes) == 1 or sum(sizes) <= MARGINAL:
        return ""
    return (
        f"the linear route is unusable: {_unknowns(sizes)}, with a condition of 4e12 or worse even "
        "from exact data"
    )


def _unknowns(sizes: Sequence[int]) -> str:
    return f"l = {sum(sizes)} with different alphas makes {count_terms(sizes) - 1} unknowns"


def _partitions(rows: RowSet, sizes: tuple[int, ...]) -> Iterator[Parts]:
    """Yield each way to share the rows among groups of these sizes, once."""
    if not sizes:
        yield ()
        return
    for part in combinations(rows, sizes[0]):
        rest = tuple(row for row in rows if row not in part)
        for others in _partitions(rest, sizes[1:]):
            yield (part, *others)


def _column_of(row: int, term: Term) -> int:
    """Return the column that holds a row: 0 for delta, 1.. for the groups."""
    if row == term.row:
        return 0
    holds_row = [row in part for part in term.parts]
    return 1 + holds_row.index(True)


def _sign(row: int, parts: Parts) -> int:
    """Return the sign of the permutation (row, parts[0], parts[1], ...)."""
    permutation = [row]
    for part in parts:
        permutation.extend(part)
    inversions = sum(first > second for first, second in combinations(permutation, 2))
    return -1 if inversions % 2 else 1


def _minors(rows: Matrix, parts: set[RowSet]) -> dict[RowSet, float]:
    """Compute the minors `det K_b[R_b]` of one group."""
    minors = {}
    with np.errstate(divide="ignore"):  # det takes the logarithm of a minor that underflows to 0
        for part in parts:
            determinant = np.linalg.det(rows[list(part)])
            minors[part] = float(determinant)
    return minors


def _check_independent(columns: Matrix, row: int, names: Sequence[str]) -> None:
    times, needed = columns.shape
    if times < needed:
        raise AssumptionError(
            f"expected at least {needed} instants to distinguish the alpha products, got {times}"
        )
    independent = _rank(columns)
    if independent < needed:
        listed = ", ".join(map(repr, names))
        raise AssumptionError(
            f"the {needed} alpha products of {listed} at delay {row + 1} have rank "
            f"{independent}; choose delays that are no multiples of a period of alpha, and alphas "
            'that a delay does not merely scale, or method = "output-error", which needs neither'
        )


def independence(terms: Sequence[Term], alpha: Matrix) -> float:
    """Return how independent the alpha products are: 1 if orthogonal, 0 if dependent.

    The smallest singular value of those with one row of delta, columns of length one; they count
    as dependent below ``COLLINEAR``. ``alpha`` is as in :func:`check_alpha_products`.
    """
    products = alpha_products(terms, alpha)
    smallest = []
    for row in sorted({term.row for term in terms}):
        columns = [c for c, term in enumerate(terms) if term.row == row]
        smallest.append(float(_singular_values(products[:, columns]).min()))
    return min(smallest)


def _rank(columns: Matrix) -> int:
    """Compute the rank of columns that are first scaled to length one."""
    independent = _singular_values(columns) > COLLINEAR
    return int(independent.sum())


def _singular_values(columns: Matrix) -> Vector:
    """Compute the singular values of columns that are first scaled to length one."""
    lengths = np.linalg.norm(columns, axis=0)
    divisors = np.where(lengths > 0.0, lengths, 1.0)
    values = np.linalg.svd(columns / divisors, compute_uv=False)
    return np.asarray(values, np.float64)
