"""From the regression to the parameters: least squares (33)-(34) and the recovery of theta from eta (35).

The recovery generalizes (35). Take a block b, a set S of `V_b + 1` rows, and leave the other rows to the other blocks, always in
the same way. The terms of (25) with the row j in S for delta and the rest of S for block b then differ only in the minors of
block b, and for a disturbance of this block alone (25) says

    sum over j in S of  sign_j chi_j f(t - D_j) = 0

a recurrence for each of its components. With equal spacing of the delays in S its characteristic roots are
`z = exp(lambda spacing)`, `w = 1 / z`.
The paper's choice for S is the rows the block has in the first term and the last row. For `V_b = 1` this gives exactly (35); for
`V_b = 2` another S is taken where the delays of this one are not equally spaced.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, pairwise

import numpy as np
from scipy.linalg import solve_triangular

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.disturbance import AlphaGroup, Exponential, Sine
from cosim.theory.regression import Term, check_delays

RANK = (
    2.0**-26
)  # pivot over the largest one: below it R'R, the information, is singular to rounding (estimate.c too)
EQUAL_SPACING = 1e-9  # relative difference of two spacings that still counts as none


class RecoveryKind(IntEnum):
    """How theta of a block follows from the coefficients `c = sign chi` of its recurrence, delays ascending."""

    EXPONENTIAL = 1  # c1 w + c0 = 0, theta = -ln(w) / spacing
    EXPONENTIALS = 2  # c2 w^2 + c1 w + c0 = 0, theta = -ln(w) / spacing, the larger theta first
    SINE = 3  # 2 cos(theta spacing) = -c1 / c0


@dataclass(frozen=True)
class GroupRecovery:
    """How theta of one block follows from chi; integers and floats only.

    Attributes
    ----------
    kind : Kind
        The formula.
    terms : tuple of int
        Indices c into chi_0..chi_q, by ascending delay; chi_c / chi_0 is eta_c, and 1 for c = 0.
    signs : tuple of int
        Sign of each of these terms.
    spacing : float
        Distance of neighboring delays [s].
    theta : tuple of int
        Where the results belong in theta.
    limit : float
        Rate [rad/s] above which theta is taken for a slower one; infinite for exponentials.
    """

    kind: RecoveryKind
    terms: tuple[int, ...]
    signs: tuple[int, ...]
    spacing: float
    theta: tuple[int, ...]
    limit: float


@dataclass(frozen=True)
class Recovery:
    """The recovery of theta, shape ``(n_theta,)``, from eta, shape ``(n_eta,)``."""

    groups: tuple[GroupRecovery, ...]
    n_eta: int
    n_theta: int


def plan(terms: Sequence[Term], blocks: Sequence[AlphaGroup], delays: Sequence[float]) -> Recovery:
    """Plan the recovery (35) of theta from eta.

    Parameters
    ----------
    terms : sequence of Term
        `expand` of the sizes of the blocks.
    blocks : sequence of Block
        The blocks; theta is ordered by component, whatever the blocks.
    delays : sequence of float
        `D_j` [s], ``l + 1`` of them.

    Raises
    ------
    AssumptionError
        If the delays do not fit, if there is no formula for a block, or if a block of two finds no equally spaced delays.
    """
    check_delays(delays, terms[0].row + 1)
    position = {(term.row, term.parts): c for c, term in enumerate(terms)}
    recoveries = []
    for b, block in enumerate(blocks):
        kind = _kind(block)
        rows, others = _equally_spaced_rows(b, terms, block, delays)
        chosen = [
            position[j, (*others[:b], tuple(sorted(set(rows) - {j})), *others[b:])] for j in rows
        ]
        spacing = float(delays[rows[1]] - delays[rows[0]])
        recoveries.append(
            GroupRecovery(
                kind=kind,
                terms=tuple(chosen),
                signs=tuple(terms[c].sign for c in chosen),
                spacing=spacing,
                theta=block.components,
                limit=math.pi / spacing if kind is RecoveryKind.SINE else math.inf,
            )
        )
    return Recovery(
        tuple(recoveries),
        n_eta=len(terms) - 1,
        n_theta=sum(len(block.components) for block in blocks),
    )


def recover(plan: Recovery, eta: Vector) -> Vector:
    """Recover theta from eta (35), shape ``(n_theta,)``; NaN for a block where eta belongs to no theta."""
    theta = np.full(plan.n_theta, NAN)
    for block in plan.groups:
        c = [
            sign * (float(eta[term - 1]) if term else 1.0)
            for term, sign in zip(block.terms, block.signs, strict=True)
        ]
        if all(map(math.isfinite, c)):
            theta[list(block.theta)] = _FORMULAS[block.kind](c, block.spacing)
    return theta


def trapezoid_weights(t: Vector) -> Vector:
    """Give the weights [s] of the trapezoid rule over the times ``t`` [s], shape ``(N,)``."""
    halves = np.diff(t) / 2.0
    weights: Vector = np.append(halves, 0.0) + np.append(0.0, halves)
    return weights


def least_squares(mu: Matrix, weights: Vector, prior: float | None = None) -> Vector:
    """Solve (33)-(34) at the end of the data, in information form with `eta_hat(0) = 0`.

    `(prior I + int m m' dt) eta = int m p dt`, solved by QR of the rows `sqrt(weight) [m', p]`, so that the condition of the data
    is not squared.

    Parameters
    ----------
    mu : Matrix
        Rows of (25), shape ``(N, q + 1)``: `p = -mu[:, 0]`, `m = mu[:, 1:]`.
    weights : Vector
        Weights of the time integral [s], shape ``(N,)``.
    prior : float, optional
        `1/P0` of `P(0) = P0 I`; left out: none.

    Returns
    -------
    Vector
        eta, shape ``(q,)``; NaN where the data do not determine it.
    """
    q = mu.shape[1] - 1
    rows = np.sqrt(weights)[:, None] * np.hstack([mu[:, 1:], -mu[:, :1]])
    if prior:
        rows = np.vstack([math.sqrt(prior) * np.eye(q, q + 1), rows])
    R: Matrix = np.linalg.qr(rows)[1]
    diagonal = np.abs(np.diag(R)[:q])
    if len(R) < q or not diagonal.min() > RANK * diagonal.max():
        return np.full(q, NAN)
    eta: Vector = solve_triangular(R[:q, :q], R[:q, q])
    return eta


def _kind(block: AlphaGroup) -> RecoveryKind:
    names = tuple(family.name for family in block.families)
    known = {
        ("exponential",): RecoveryKind.EXPONENTIAL,
        ("exponential",) * 2: RecoveryKind.EXPONENTIALS,
        ("sine",): RecoveryKind.SINE,
    }
    if names not in known:
        raise AssumptionError(
            f"(35): no formula for theta of the components {list(block.components)} that share alpha {block.alpha!r} "
            f"({', '.join(names)}); possible for one alpha: one exponential, two exponentials, or one sine; give the others "
            "another alpha"
        )
    return known[names]


def _equally_spaced_rows(
    b: int, terms: Sequence[Term], block: AlphaGroup, delays: Sequence[float]
) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Find S, by ascending delay, and the rows of the other blocks; the paper's choice first."""
    for rows, others in _row_sets(b, terms[0]):
        ascending = tuple(sorted(rows, key=lambda j: delays[j]))
        gaps = np.diff([delays[j] for j in ascending])
        if gaps.max() - gaps.min() <= EQUAL_SPACING * gaps.max():
            return ascending, others
    raise AssumptionError(
        f"(35): the components {list(block.components)} that share alpha {block.alpha!r} need {block.size + 1} equally spaced "
        f"delays; found {', '.join(f'{D:g}' for D in delays)} s"
    )


def _row_sets(b: int, first: Term) -> Iterator[tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]]:
    last, others = first.row, (*first.parts[:b], *first.parts[b + 1 :])
    yield (*first.parts[b], last), others
    for rows in combinations(range(last + 1), len(first.parts[b]) + 1):
        rest = [row for row in range(last + 1) if row not in rows]
        ends = np.cumsum([0, *map(len, others)])
        yield rows, tuple(tuple(rest[i:j]) for i, j in pairwise(ends))


def _exponential(c: Sequence[float], spacing: float) -> list[float]:
    # -ln(-c0 / c1), not ln(-c1 / c0): with c1 = 1 this is the paper's ln(eta) / (D_j - D_last) to the last bit
    return [-Exponential().theta_from_roots([-c[0] / c[1]], spacing)[0]] if c[1] else [NAN]


def _exponentials(c: Sequence[float], spacing: float) -> list[float]:
    if c[0] == 0.0 or c[2] == 0.0:
        return [NAN, NAN]
    theta = [-Exponential().theta_from_roots([w], spacing)[0] for w in _roots(c[2], c[1], c[0])]
    return [NAN, NAN] if any(map(math.isnan, theta)) else sorted(theta, reverse=True)


def _sine(c: Sequence[float], spacing: float) -> list[float]:
    return [Sine().theta_from_roots(_roots(*c), spacing)[0]] if c[0] else [NAN]


_FORMULAS = {
    RecoveryKind.EXPONENTIAL: _exponential,
    RecoveryKind.EXPONENTIALS: _exponentials,
    RecoveryKind.SINE: _sine,
}


def _roots(a: float, b: float, c: float) -> tuple[complex, complex]:
    """Solve `a z^2 + b z + c = 0`, a not 0: the root of larger magnitude first, the other from their product: no cancellation."""
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        root = cmath.sqrt(discriminant)
        return (-b + root) / (2.0 * a), (-b - root) / (2.0 * a)
    far = -0.5 * (b + math.copysign(math.sqrt(discriminant), b))
    return (far / a, c / far) if far else (0.0, 0.0)
