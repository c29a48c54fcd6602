"""From the regression to the parameters: least squares (33)-(34), and theta from eta (35).

The recovery of theta generalizes (35). Take a group b of components that share one alpha, a set S
of `V_b + 1` rows, and leave the other rows to the other groups, always in the same way. The terms
of (25) with the row j in S for delta and the rest of S for group b then differ only in the minors
of group b, and for a disturbance of only this group (25) is

    sum over j in S of  sign_j chi_j f(t - D_j) = 0

a recurrence for each of its components. With equal spacing of the delays in S its characteristic
roots are `z = exp(lambda spacing)`, `w = 1 / z`.

The paper's choice for S is the rows the group has in the first term and the last row. For `V_b = 1`
this gives exactly (35); for `V_b = 2` another S is taken where the delays of this S are not
equally spaced.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain, combinations, pairwise

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.regression import RecoveryConstants
from cosim.theory.disturbances.families import AlphaGroup, DampedSine, Exponential, Sine
from cosim.theory.disturbances.regression import Parts, RowSet, Term, check_delays

# pivot over the largest pivot, below which R'R, the information, is singular to rounding;
# the same value stands in regression.c
RANK = 2.0**-26
EQUAL_SPACING = 1e-9  # relative difference of two spacings that still counts as none


class RecoveryKind(IntEnum):
    """How theta of a group follows from the coefficients `c = sign chi` of its recurrence.

    The delays are ascending.
    """

    EXPONENTIAL = 1  # c1 w + c0 = 0, theta = -ln(w) / spacing
    EXPONENTIALS = 2  # c2 w^2 + c1 w + c0 = 0, theta = -ln(w) / spacing, the larger theta first
    SINE = 3  # 2 cos(theta spacing) = -c1 / c0
    DAMPED_SINE = 4  # w1 w2 = exp(2 decay spacing) = c0 / c2, and w1 + w2 = -c1 / c2
    T_EXPONENTIAL = 5  # the double root w = -c1 / (2 c2), theta = -ln(w) / spacing


@dataclass(frozen=True)
class GroupRecovery:
    """How theta of one group follows from chi; integers and floats only.

    Attributes
    ----------
    kind : RecoveryKind
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


def plan(terms: Sequence[Term], groups: Sequence[AlphaGroup], delays: Sequence[float]) -> Recovery:
    """Plan the recovery (35) of theta from eta.

    Parameters
    ----------
    terms : sequence of Term
        `expand` of the sizes of the groups.
    groups : sequence of AlphaGroup
        The groups; theta is ordered by component, whatever the groups.
    delays : sequence of float
        `D_j` [s], ``l + 1`` of them.

    Raises
    ------
    AssumptionError
        If the delays do not fit, there is no formula for a group, or there are no equally spaced
        delays for a group with `V_b = 2`.
    """
    last_row = terms[0].row
    check_delays(delays, needed=last_row + 1)
    places = _places_of_theta(groups)
    recoveries = []
    for b, group in enumerate(groups):
        theta = tuple(chain.from_iterable(places[i] for i in group.components))
        if theta:
            recoveries.append(_plan_group(b, group, terms, delays, theta))
    n_eta = len(terms) - 1
    n_theta = sum(map(len, places.values()))
    if not n_theta:
        raise AssumptionError(
            "the terms have no parameter, so there is no theta to recover; "
            'method = "output-error" estimates their amplitudes'
        )
    return Recovery(tuple(recoveries), n_eta, n_theta)


def _places_of_theta(groups: Sequence[AlphaGroup]) -> dict[int, range]:
    """Return where the parameters of each component stand in theta, by component."""
    counts = {}
    for group in groups:
        for component, family in zip(group.components, group.families, strict=True):
            counts[component] = len(family.parameters)
    places = {}
    first = 0
    for component in sorted(counts):
        places[component] = range(first, first + counts[component])
        first += counts[component]
    return places


def recovery_constants(plan: Recovery) -> list[RecoveryConstants]:
    """Return the formulas of theta as numbers of the kernels."""
    formulas = []
    for group in plan.groups:
        kind = int(group.kind)
        formula = RecoveryConstants(kind, group.terms, group.theta, group.signs, group.spacing)
        formulas.append(formula)
    return formulas


def recover(plan: Recovery, eta: Vector) -> Vector:
    """Recover theta from eta (35), shape ``(n_theta,)``; NaN where eta belongs to no theta."""
    theta = np.full(plan.n_theta, NAN)
    for group in plan.groups:
        c = []
        for term, sign in zip(group.terms, group.signs, strict=True):
            ratio = float(eta[term - 1]) if term else 1.0
            c.append(sign * ratio)
        if all(map(math.isfinite, c)):
            formula = _FORMULAS[group.kind]
            positions = list(group.theta)
            theta[positions] = formula(c, group.spacing)
    return theta


def trapezoid_weights(t: Vector) -> Vector:
    """Compute the weights [s] of the trapezoid rule over the times ``t`` [s], shape ``(N,)``."""
    half_steps = np.diff(t) / 2.0
    after = np.append(half_steps, 0.0)
    before = np.append(0.0, half_steps)
    weights: Vector = after + before
    return weights


def least_squares(mu: Matrix, weights: Vector, prior: float | None = None) -> Vector:
    """Solve (33)-(34) at the end of the data, in information form with `eta_hat(0) = 0`.

    `(prior I + int m m' dt) eta = int m p dt`, solved by QR of the rows `sqrt(weight) [m', p]`, so
    that the condition of the data is not squared.

    Parameters
    ----------
    mu : Matrix
        Rows of (25), shape ``(N, q + 1)``: `p = -mu[:, 0]`, `m = mu[:, 1:]`.
    weights : Vector
        Weights of the time integral [s], shape ``(N,)``.
    prior : float, optional
        `1/P0` of `P(0) = P0 I`; by default none.

    Returns
    -------
    Vector
        eta, shape ``(q,)``; NaN where the data do not determine it.
    """
    q = mu.shape[1] - 1
    m = mu[:, 1:]
    p = -mu[:, :1]
    scale = np.sqrt(weights)[:, None]
    rows = scale * np.hstack([m, p])
    if prior:
        no_data = np.eye(q, q + 1)
        prior_rows = math.sqrt(prior) * no_data
        rows = np.vstack([prior_rows, rows])
    R: Matrix = np.linalg.qr(rows)[1]
    undetermined = np.full(q, NAN)
    if len(R) < q:
        return undetermined
    R_m = R[:q, :q]
    R_p = R[:q, q]
    pivots = np.abs(np.diag(R_m))
    largest = pivots.max()
    if not pivots.min() > RANK * largest:
        return undetermined
    from scipy.linalg import solve_triangular  # takes long to import, and is rarely needed

    eta: Vector = solve_triangular(R_m, R_p)
    return eta


def _plan_group(
    b: int,
    group: AlphaGroup,
    terms: Sequence[Term],
    delays: Sequence[float],
    theta: tuple[int, ...],
) -> GroupRecovery:
    kind = _recovery_kind(group)
    rows, others = _equally_spaced_rows(b, terms, group, delays)
    groups_before = others[:b]
    groups_after = others[b:]
    index_of = {(term.row, term.parts): c for c, term in enumerate(terms)}
    indices = []
    for j in rows:
        rest = set(rows) - {j}
        part = tuple(sorted(rest))
        parts = (*groups_before, part, *groups_after)
        c = index_of[j, parts]
        indices.append(c)
    signs = tuple(terms[c].sign for c in indices)
    first = delays[rows[0]]
    second = delays[rows[1]]
    spacing = float(second - first)
    has_rate = kind in (RecoveryKind.SINE, RecoveryKind.DAMPED_SINE)
    limit = math.pi / spacing if has_rate else math.inf
    return GroupRecovery(kind, tuple(indices), signs, spacing, theta, limit)


def _recovery_kind(group: AlphaGroup) -> RecoveryKind:
    names = tuple(family.name for family in group.families)
    if names not in _KINDS:
        components = list(group.components)
        listed = ", ".join(names)
        raise AssumptionError(
            f"no formula for theta of the components {components} that share "
            f"alpha {group.alpha!r} ({listed}); possible for one alpha: one exponential, two "
            "exponentials, one sine, one damped-sine, or one t-exponential; for others "
            'method = "output-error"'
        )
    return _KINDS[names]


def _equally_spaced_rows(
    b: int, terms: Sequence[Term], group: AlphaGroup, delays: Sequence[float]
) -> tuple[RowSet, Parts]:
    """Find S, by ascending delay, and the rows of the other groups; the paper's choice first."""
    for rows, others in _row_sets(b, terms[0]):
        ascending = sorted(rows, key=lambda j: delays[j])
        gaps = np.diff([delays[j] for j in ascending])
        largest = gaps.max()
        difference = largest - gaps.min()
        if difference <= EQUAL_SPACING * largest:
            return tuple(ascending), others
    components = list(group.components)
    needed = group.size + 1
    listed = ", ".join(f"{D:g}" for D in delays)
    raise AssumptionError(
        f"the components {components} that share alpha {group.alpha!r}: expected {needed} equally "
        f"spaced delays, got {listed} s"
    )


def _row_sets(b: int, first: Term) -> Iterator[tuple[RowSet, Parts]]:
    """Yield candidates for S, each with the rows of the other groups; the paper's choice first."""
    last = first.row
    own_part = first.parts[b]
    groups_before = first.parts[:b]
    groups_after = first.parts[b + 1 :]
    other_parts = (*groups_before, *groups_after)
    yield (*own_part, last), other_parts
    other_sizes = map(len, other_parts)
    bounds = np.cumsum([0, *other_sizes])
    all_rows = range(last + 1)
    size = len(own_part) + 1
    for rows in combinations(all_rows, size):
        rest = [row for row in all_rows if row not in rows]
        others = []
        for begin, end in pairwise(bounds):
            part = tuple(rest[begin:end])
            others.append(part)
        yield rows, tuple(others)


def _exponential(c: Sequence[float], spacing: float) -> list[float]:
    c0, c1 = c
    if not c1:
        return [NAN]
    # -ln(-c0 / c1), not ln(-c1 / c0): with c1 = 1 this is the paper's ln(eta) / (D_j - D_last) to
    # the last bit
    w = -c0 / c1
    return [_exponent(w, spacing)]


def _exponentials(c: Sequence[float], spacing: float) -> list[float]:
    c0, c1, c2 = c
    if c0 == 0.0 or c2 == 0.0:
        return [NAN, NAN]
    theta = [_exponent(w, spacing) for w in _roots(c2, c1, c0)]
    if any(map(math.isnan, theta)):
        return [NAN, NAN]
    return sorted(theta, reverse=True)


def _exponent(w: complex, spacing: float) -> float:
    """Compute theta from `w = exp(-theta spacing)`; NaN where w is not real and positive."""
    minus_theta = Exponential().theta_from_roots([w], spacing)
    return -float(minus_theta[0])


def _sine(c: Sequence[float], spacing: float) -> list[float]:
    c0, c1, c2 = c
    if not c0:
        return [NAN]
    roots = _roots(c0, c1, c2)
    theta = Sine().theta_from_roots(roots, spacing)
    return [float(theta[0])]


def _damped_sine(c: Sequence[float], spacing: float) -> list[float]:
    c0, c1, c2 = c
    if c0 == 0.0 or c2 == 0.0:
        return [NAN, NAN]
    roots = _roots(c0, c1, c2)
    theta = DampedSine().theta_from_roots(roots, spacing)
    return [float(value) for value in theta]


def _t_exponential(c: Sequence[float], spacing: float) -> list[float]:
    _, c1, c2 = c
    return [_exponent(-0.5 * c1 / c2, spacing)] if c2 else [NAN]


_KINDS = {
    ("exponential",): RecoveryKind.EXPONENTIAL,
    ("exponential", "exponential"): RecoveryKind.EXPONENTIALS,
    ("sine",): RecoveryKind.SINE,
    ("damped-sine",): RecoveryKind.DAMPED_SINE,
    ("t-exponential",): RecoveryKind.T_EXPONENTIAL,
}
_FORMULAS = {
    RecoveryKind.EXPONENTIAL: _exponential,
    RecoveryKind.EXPONENTIALS: _exponentials,
    RecoveryKind.SINE: _sine,
    RecoveryKind.DAMPED_SINE: _damped_sine,
    RecoveryKind.T_EXPONENTIAL: _t_exponential,
}


def _roots(a: float, b: float, c: float) -> tuple[complex, complex]:
    """Solve `a z^2 + b z + c = 0`, a not 0.

    Of real roots the one of larger magnitude comes first, the other follows from their product, so
    that nothing cancels.
    """
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        root = cmath.sqrt(discriminant)
        denominator = 2.0 * a
        first = (-b + root) / denominator
        second = (-b - root) / denominator
        return first, second
    real_root = math.sqrt(discriminant)
    numerator = -0.5 * (b + math.copysign(real_root, b))
    if numerator == 0.0:
        return 0.0, 0.0
    return numerator / a, c / numerator
