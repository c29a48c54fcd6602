"""The regression (21)-(26) as one determinant.

Components that share one alpha form a **block** b of size `V_b`, the sum of their basis sizes; `l = sum V_b`. With `l + 1` delays
the matrix with the rows

    [delta(t - D_j), alpha_1(t - D_j) K_1(D_j)', ..., alpha_B(t - D_j) K_B(D_j)'],    j = 1..l+1

has more columns than basis functions, so its determinant vanishes: that is (24). Laplace's expansion along the delta column and
then block by block gives one term for each choice of a row j for delta and of a set `R_b` of `V_b` rows for every block::

    sum over terms of  mu chi = 0                                                              (25)
    mu  = sign delta(t - D_j) prod_b prod_{i in R_b} alpha_b(t - D_i)     known signals
    chi = prod_b det K_b[R_b]                                             unknown constants

`(l + 1)! / prod V_b!` terms. The sign is that of the permutation (j, R_1, R_2, ...). Terms are ordered by the column that holds
the last row (delta, then the blocks), then by the rows: for two exponentials exactly the paper's mu_1..mu_6 (32). In the code
rows count from 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError

COLLINEAR = 1e-9  # singular value of the alpha products, columns of length one, below which they count as dependent


@dataclass(frozen=True)
class Term:
    """One term of (25): the row of delta, the rows of each block, and the sign that belongs to mu."""

    row: int
    parts: tuple[tuple[int, ...], ...]
    sign: int


def count_terms(sizes: Sequence[int]) -> int:
    """Count the terms of (25), `(l + 1)! / prod V_b!`, without making them."""
    return math.factorial(sum(sizes) + 1) // math.prod(math.factorial(size) for size in sizes)


def expand(sizes: tuple[int, ...]) -> tuple[Term, ...]:
    """Expand the determinant for blocks of these sizes into the terms of (25), in the order of (32).

    Raises
    ------
    AssumptionError
        If there is no block or a block is empty.
    """
    if not sizes or min(sizes) < 1:
        raise AssumptionError(
            f"(21): block sizes {list(sizes)}; needed at least one block, each with at least one basis function"
        )
    rows = tuple(range(sum(sizes) + 1))
    choices = [
        (row, parts) for row in rows for parts in _partitions(rows[:row] + rows[row + 1 :], sizes)
    ]
    choices.sort(key=lambda choice: (_holder(rows[-1], *choice), choice))
    return tuple(
        Term(row, parts, _parity((row, *(i for part in parts for i in part))))
        for row, parts in choices
    )


def mu(terms: Sequence[Term], delta: Matrix, alpha: Matrix) -> Matrix:
    """Give the known signals of (25), signs included.

    Parameters
    ----------
    terms : sequence of Term
        The ``q + 1`` terms.
    delta : Matrix
        `delta(t - D_j)`, shape ``(N, l + 1)``.
    alpha : Matrix
        `alpha_b(t - D_j)`, shape ``(N, l + 1, blocks)``.

    Returns
    -------
    Matrix
        Shape ``(N, q + 1)``; `p = -mu[:, 0]` and `m = mu[:, 1:]` (26).
    """
    return np.stack([term.sign * delta[:, term.row] for term in terms], axis=1) * alpha_products(
        terms, alpha
    )


def alpha_products(terms: Sequence[Term], alpha: Matrix) -> Matrix:
    """Give `prod_b prod_{i in R_b} alpha_b(t - D_i)` for every term, shape ``(N, q + 1)``, from alpha ``(N, l + 1, blocks)``."""
    products = np.ones((len(alpha), len(terms)))
    for column, term in enumerate(terms):
        for block, part in enumerate(term.parts):
            products[:, column] *= alpha[:, list(part), block].prod(axis=1)
    return products


def chi(terms: Sequence[Term], K: Sequence[Matrix]) -> Vector:
    """Give the constants of (25), the products of minors `det K_b[R_b]`, without the signs.

    Parameters
    ----------
    terms : sequence of Term
        The ``q + 1`` terms.
    K : sequence of Matrix
        For each block the rows `K_b(D_j)'`, shape ``(l + 1, V_b)``.

    Returns
    -------
    Vector
        Shape ``(q + 1,)``.
    """
    with np.errstate(
        divide="ignore"
    ):  # the logarithm inside det of a minor that underflows to zero
        minors = [
            {
                part: float(np.linalg.det(rows[list(part)]))
                for part in {term.parts[block] for term in terms}
            }
            for block, rows in enumerate(K)
        ]
    return np.array(
        [math.prod(minors[block][part] for block, part in enumerate(term.parts)) for term in terms]
    )


def eta(terms: Sequence[Term], K: Sequence[Matrix]) -> Vector:
    """Give `eta_c = chi_c / chi_0` (26), shape ``(q,)``.

    Raises
    ------
    AssumptionError
        If chi_0 vanishes.
    """
    constants = chi(terms, K)
    if constants[0] == 0.0:
        raise AssumptionError("(26): chi_0 = 0, so eta is not defined; choose other delays")
    ratios: Vector = constants[1:] / constants[0]
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
            f"Assumption 3 (5): {len(delays)} delays; needed l + 1 = {needed} for l = {needed - 1} basis functions"
        )
    for j, D in enumerate(delays, start=1):
        if not 0.0 <= D < math.inf:
            raise AssumptionError(
                f"Assumption 3 (5): D_{j} = {D:g} s; needed a finite delay, not negative"
            )
    for (i, first), (j, second) in combinations(enumerate(delays, start=1), 2):
        if first == second:
            raise AssumptionError(
                f"Assumption 3 (5): D_{i} = D_{j} = {first:g} s; needed pairwise distinct delays"
            )


def check_alpha_products(terms: Sequence[Term], alpha: Matrix, names: Sequence[str]) -> None:
    """Refuse alphas whose products are dependent, so that (26) has many solutions whatever the data.

    Terms with the same row of delta multiply the same `delta(t - D_j)`; their alpha products alone must be independent in time.

    Parameters
    ----------
    terms : sequence of Term
        The terms.
    alpha : Matrix
        `alpha_b(t - D_j)` over a time grid, shape ``(N, l + 1, blocks)``, N at least the terms per row of delta.
    names : sequence of str
        A name for each block, for the message.

    Raises
    ------
    AssumptionError
        If two alphas are proportional (their blocks must be merged), or if products are dependent for another reason, or if the
        grid is too short to tell.
    """
    for a, b in combinations(range(len(names)), 2):
        if _rank(alpha[:, :, [a, b]].reshape(-1, 2)) < 2:
            raise AssumptionError(
                f"(21): alpha {names[a]!r} and alpha {names[b]!r} are proportional; merge their components into one block "
                "(give them the same alpha)"
            )
    products = alpha_products(terms, alpha)
    for row in sorted({term.row for term in terms}):
        columns = products[:, [c for c, term in enumerate(terms) if term.row == row]]
        if len(columns) < columns.shape[1]:
            raise AssumptionError(
                f"(26): {len(columns)} times; needed at least {columns.shape[1]} to tell the alpha products apart"
            )
        found = _rank(columns)
        if found < columns.shape[1]:
            raise AssumptionError(
                f"(26): the {columns.shape[1]} alpha products with delta(t - D_{row + 1}) of {', '.join(map(repr, names))} have "
                f"rank {found}; choose delays that are no multiples of a period of alpha, and alphas that a delay does not "
                "merely scale"
            )


def linear_route_warning(sizes: Sequence[int]) -> str:
    """Say whether estimating eta linearly (26) can work for blocks of these sizes; empty where there is nothing to say.

    With exact data the condition of the information matrix is 3e4 for the paper's l = 2, and 4e12 or worse for l = 4.
    """
    length = sum(sizes)
    unknowns = f"l = {length} with different alphas makes {count_terms(sizes) - 1} unknowns"
    if len(sizes) == 1 or length < 3:
        return ""
    if length == 3:
        return f"the linear route is marginal: {unknowns}; expect a poor condition, or merge alphas, or estimate theta directly"
    return (
        f"the linear route is unusable: {unknowns}, with a condition of 4e12 or worse even from exact data; merge alphas or "
        "estimate theta directly"
    )


def _partitions(
    rows: tuple[int, ...], sizes: tuple[int, ...]
) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Give each way to share the rows among the blocks, once."""
    if not sizes:
        yield ()
        return
    for part in combinations(rows, sizes[0]):
        rest = tuple(row for row in rows if row not in part)
        for others in _partitions(rest, sizes[1:]):
            yield (part, *others)


def _holder(last: int, row: int, parts: tuple[tuple[int, ...], ...]) -> int:
    """Give the column group that holds the last row: 0 for delta, 1.. for the blocks."""
    return 0 if row == last else 1 + next(block for block, part in enumerate(parts) if last in part)


def _parity(permutation: tuple[int, ...]) -> int:
    return -1 if sum(a > b for a, b in combinations(permutation, 2)) % 2 else 1


def _rank(columns: Matrix) -> int:
    lengths = np.linalg.norm(columns, axis=0)
    values = np.linalg.svd(columns / np.where(lengths > 0.0, lengths, 1.0), compute_uv=False)
    return int((values > COLLINEAR).sum())
