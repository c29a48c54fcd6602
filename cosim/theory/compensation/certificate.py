"""A proof that a loop is stable for every theta of a box.

One communication step takes the state xi of the sampled loop to ``Phi(theta) xi``. The internal
model depends on theta, and its gains, which are interpolated between nodes (:mod:`.schedule`). It
is discretized exactly: with M = h S(theta) and g = h G

    Phi = Phi_0 + U K_w (X V - W) + J (exp(M) W + phi(M) g e),    phi(M) = sum of M^k / (k + 1)!

U is what the next u does, V takes the deviation of x_hat, W the state of the internal model, e is
what drives it by G, and J puts its new state in its place. With u at a limit there is only the last
term, with G = -B_w and e = K_w W.

K_w, X, B_w and S are multi-affine in theta between nodes. Take the center of a cell there and a T
with ``||T Phi T^-1|| < 1`` at it, from a Lyapunov equation. For every theta of the cell, where M
differs by m from that of the center, the series of both functions say that

    exp(M + m) = exp(M) + L m + R,      ||R|| <= ||m||^2/2 exp(||M|| + ||m||)
    phi(M + m) = phi(M) + l m + r,      ||r|| <= ||m||^2/6 exp(||M|| + ||m||)
                                        ||l m|| <= ||m||/2 exp(||M||)

with the derivatives L and l, which are linear. w is in units in which the internal model with its
gain is balanced, and what drives it in units in which g is of size one, so that the bounds depend
neither on the units of signals nor on that of time. What of ``T Phi T^-1`` is of first order in the
changes of K_w, X, M, g and e is multi-affine in theta, and its norm is largest at a corner of the
cell; the products of two changes, R and r are bounded by norms, also largest at a corner. If all
that and an allowance for rounding are less than 1 together, then ``||T xi||`` falls at every step,
for every theta of the cell, also for one that varies from step to step. Cells where they are not
are halved. With one cell the proof is of a theta that varies in the whole box, with several of a
constant one in it, and of one that varies slowly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.filters import ignored_warnings
from cosim.native.numerics.linear import matrix_exponential
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox
from cosim.theory.compensation.schedule import Schedule, Stabilization
from cosim.theory.compensation.state_feedback import balancing, rescaled
from cosim.theory.plants.descriptor import ComplexMatrix

MOST_CORNERS = 1000  # of cells beyond those between the nodes, where nothing else is said
MOST_CELLS = 250
GRID = 9  # most points on a side of the box where instability is looked for first
GRID_POINTS = 300  # and in the box
ROUNDING = 1e3  # of the products with T, in units of the float spacing
EPSILON = float(np.finfo(np.float64).eps)
LARGEST_EXPONENT = 700.0  # of the bound of R, beyond which it proves nothing


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledLoop:
    """The loop over one step, as the module says.

    Parameters
    ----------
    fixed : Matrix
        Phi_0, shape ``(n, n)``.
    of_u : Matrix
        U, shape ``(n, n_u)``.
    deviation : Matrix
        V, shape ``(n_x, n)``.
    w : Matrix
        W, shape ``(n_w, n)``: the last rows of the identity.
    error : Matrix
        What drives the internal model, shape ``(p, n)``, but at a limit of u.
    model : InternalModel
    schedule : Schedule
    h : float
        Communication step [s].
    at_limit : bool
        u is at a limit.
    """

    fixed: Matrix
    of_u: Matrix
    deviation: Matrix
    w: Matrix
    error: Matrix
    model: InternalModel
    schedule: Schedule
    h: float
    at_limit: bool

    @property
    def rows(self) -> slice:
        """The rows of the internal model."""
        n = len(self.fixed)
        return slice(n - len(self.w), n)

    @cached_property
    def units(self) -> Vector:
        """Units of what drives the internal model in which it is at most one, shape ``(m,)``."""
        nodes = self.schedule.B_w if self.at_limit else self.model.b[np.newaxis]
        lengths = np.linalg.norm(nodes, axis=1)
        sizes = self.h * lengths.max(axis=0)
        is_driven = sizes > 0.0
        return np.where(is_driven, sizes, 1.0)

    def at(self, theta: Vector) -> _ModelAt:
        """Return what depends on theta."""
        gains = self.schedule.at(theta)
        S = self.model.S(theta)
        G = self.model.b
        driving = self.error
        if self.at_limit:
            G = -gains.B_w
            driving = gains.K_w @ self.w
        units = self.units
        M = self.h * S
        g = self.h * G / units
        e = units[:, np.newaxis] * driving
        return _ModelAt(gains, M, g, e)

    def Phi(self, theta: Vector) -> Matrix:
        """Return what a step does to xi, shape ``(n, n)``."""
        model = self.at(theta)
        seen = self.gains_input(model)
        correction = model.gains.K_w @ seen
        step = _Exponential.of(model)
        from_w = step.E @ self.w
        driven = step.F @ model.e
        new_w = self.placed(from_w + driven)
        return self.fixed + self.of_u @ correction + new_w

    def gains_input(self, model: _ModelAt) -> Matrix:
        """Return `X V - W`, which K_w multiplies."""
        return model.gains.X @ self.deviation - self.w

    def placed(self, of_w: Matrix) -> Matrix:
        """Return what a step does to w in its place, shape ``(n, n)``."""
        total = np.zeros_like(self.fixed)
        total[self.rows] = of_w
        return total

    def balanced(self) -> SampledLoop:
        """Return the loop with w in units in which the internal model with its gain is balanced."""
        center = self.schedule.box.center
        gains = self.schedule.at(center)
        S = self.model.S(center)
        closed = S - gains.B_w @ gains.K_w
        units = balancing(closed)
        model = self.model.in_units(units)
        schedule = self.schedule.in_units(units)
        return replace(self, model=model, schedule=schedule)

    def radius(self, theta: Vector) -> float:
        """Return the largest modulus of an eigenvalue of Phi."""
        Phi = self.Phi(theta)
        return spectral_radius(Phi)


class _ModelAt(NamedTuple):
    """The gains of a loop at one theta, M, g, and e, which drives w in units."""

    gains: Stabilization
    M: Matrix
    g: Matrix
    e: Matrix

    def less(self, other: _ModelAt) -> _ModelAt:
        """Return the differences from those at another theta."""
        gains = self.gains.less(other.gains)
        M = self.M - other.M
        g = self.g - other.g
        e = self.e - other.e
        return _ModelAt(gains, M, g, e)


class _Exponential(NamedTuple):
    """`exp(M)` and `phi(M) g`."""

    E: Matrix
    F: Matrix

    @classmethod
    def of(cls, model: _ModelAt) -> _Exponential:
        """Compute both, the upper rows of the exponential of ``[M, g; 0, 0]``."""
        Z = _above_zeros(model.M, model.g)
        exponential = matrix_exponential(Z)
        return cls._of_rows(exponential, len(model.M))

    @classmethod
    def derivative(cls, center: _ModelAt, change: _ModelAt) -> _Exponential:
        """Compute their derivative in the direction of a change.

        It is the upper right block of the exponential of ``[Z, change; 0, Z]``.
        """
        Z = _above_zeros(center.M, center.g)
        direction = _above_zeros(change.M, change.g)
        zeros = np.zeros_like(Z)
        upper = np.hstack([Z, direction])
        lower = np.hstack([zeros, Z])
        both = np.vstack([upper, lower])
        exponential = matrix_exponential(both)
        n = len(Z)
        derivative = exponential[:n, n:]
        return cls._of_rows(derivative, len(center.M))

    @classmethod
    def _of_rows(cls, exponential: Matrix, n_w: int) -> _Exponential:
        rows = exponential[:n_w]
        E = rows[:, :n_w]
        F = rows[:, n_w:]
        return cls(E, F)


def _above_zeros(M: Matrix, g: Matrix) -> Matrix:
    """Return `[M, g; 0, 0]`, which is square."""
    rows = np.hstack([M, g])
    n_w, n = rows.shape
    zeros = np.zeros((n - n_w, n))
    return np.vstack([rows, zeros])


@dataclass(frozen=True, slots=True)
class Certificate:
    """What is proven of a loop in a box.

    Parameters
    ----------
    proven : bool
        It is stable for every theta of the box.
    cells : int
        In how many cells; 1: also for every theta that varies in the box.
    rate : float
        The least rate at which the loop decays, of those computed [1/s]; negative: it grows.
    theta : tuple of float
        Where that is.
    """

    proven: bool
    cells: int
    rate: float
    theta: tuple[float, ...]


def certify(loop: SampledLoop, most_corners: int = MOST_CORNERS) -> Certificate:
    """Prove that a loop is stable in the box of its schedule, or find where it is not."""
    loop = loop.balanced()
    slowest, theta = _on_grid(loop)
    where = tuple(theta.tolist())
    if slowest >= 1.0:
        return Certificate(False, 0, _rate(slowest, loop), where)
    waiting = loop.schedule.cells()
    corners = 2 ** len(loop.schedule.box.lower)
    most = len(waiting) + min(most_corners // corners, MOST_CELLS)
    cells = 0
    while waiting:
        cell = waiting.pop()
        bound, radius = _contraction(loop, cell)
        if radius > slowest:
            slowest = radius
            where = tuple(cell.center.tolist())
        if bound < 1.0:
            cells += 1
            continue
        if radius >= 1.0 or cells + len(waiting) > most or not _is_divisible(cell):
            center = tuple(cell.center.tolist())
            return Certificate(False, cells, _rate(radius, loop), center)
        waiting.extend(cell.halves(_steepest(loop, cell)))
    return Certificate(True, cells, _rate(slowest, loop), where)


def spectral_radius(matrix: Matrix) -> float:
    """Return the largest modulus of an eigenvalue."""
    eigenvalues = np.linalg.eigvals(matrix)
    moduli = np.abs(eigenvalues)
    return float(moduli.max())


def rate_of_decay(radius: float, h: float) -> float:
    """Return the rate of what becomes ``radius`` times as large over a step h [1/s]."""
    at_least = max(radius, 1e-300)
    return -math.log(at_least) / h


def is_stable_on_grid(loop: SampledLoop) -> bool:
    """Return whether a loop is stable at the points of a grid."""
    slowest, _ = _on_grid(loop)
    return slowest < 1.0


def _on_grid(loop: SampledLoop) -> tuple[float, Vector]:
    """Return the largest spectral radius on a grid, and the theta where it is."""
    box = loop.schedule.box
    sides = max(len(box.lower), 1)
    points = int(GRID_POINTS ** (1.0 / sides))
    slowest = 0.0
    theta = box.center
    for point in box.grid(max(min(points, GRID), 2)):
        radius = loop.radius(point)
        if radius > slowest:
            slowest = radius
            theta = point
    return slowest, theta


def _rate(radius: float, loop: SampledLoop) -> float:
    return rate_of_decay(radius, loop.h)


def _steepest(loop: SampledLoop, cell: ParameterBox) -> int:
    """Return the parameter whose interval changes the internal model most."""
    widths = cell.upper - cell.lower
    changes = []
    for width, slope in zip(widths, loop.model.S1, strict=True):
        changes.append(width * _norm(slope))
    return int(np.argmax(changes))


def _is_divisible(cell: ParameterBox) -> bool:
    width = cell.upper - cell.lower
    lower = np.abs(cell.lower)
    upper = np.abs(cell.upper)
    least = 1e-9 * np.maximum(lower, upper)
    is_wide = width > least
    return bool(is_wide.any())


def _contraction(loop: SampledLoop, cell: ParameterBox) -> tuple[float, float]:
    """Return a bound of `||T Phi T^-1||` in a cell, and the spectral radius at its center."""
    Phi = loop.Phi(cell.center)
    radius = spectral_radius(Phi)
    bound = math.inf
    if radius >= 1.0:
        return bound, radius
    for T in _contracting(loop, cell, Phi, radius):
        bound = min(bound, _bound(loop, cell, Phi, T))
        if bound < 1.0:
            break
    return bound, radius


def _contracting(
    loop: SampledLoop, cell: ParameterBox, Phi: Matrix, radius: float
) -> Iterator[Matrix]:
    """Yield matrices T in whose norm Phi contracts, where they can be computed.

    P of ``Phi' P Phi - r^2 P = -Q`` is T'T; r is halfway from the spectral radius to 1. In units
    that balance Phi over its slowest time, Q weighs all states alike, or the modes as they are
    long, or such that what changes in the cell is small between them.
    """
    units = _slow_units(Phi, radius)
    balanced = rescaled(Phi, units)
    r = 0.5 * (1.0 + radius)
    contracting = balanced / r
    identity = np.eye(len(Phi))
    with suppress(np.linalg.LinAlgError):  # P is not positive, or modes are alike
        factor = _factor(contracting, identity)
        yield factor / units
    with suppress(np.linalg.LinAlgError):
        modal = _modal(balanced)
        factor = _factor(contracting, modal)
        yield factor / units
    with suppress(np.linalg.LinAlgError):
        modal = _modal(balanced)
        weights = _weights_of_modes(loop, cell, Phi, modal, units)
        weighted = modal / weights[:, np.newaxis]
        factor = _factor(contracting, weighted)
        yield factor / units


def _slow_units(Phi: Matrix, radius: float) -> Vector:
    """Return units that balance what as many steps do as the slowest mode takes to decay.

    Within one step u follows x with a large gain and x follows u hardly: units that balance these
    are too large for what x and the internal model do to each other in the end.
    """
    units = balancing(Phi)
    balanced = rescaled(Phi, units)
    steps = int(1.0 / (1.0 - radius))
    after = np.linalg.matrix_power(balanced, max(steps, 1))
    effects = np.abs(after)
    rounding = EPSILON * effects.max()
    of_effects = balancing(effects + rounding)
    return units * of_effects


def _modal(matrix: Matrix) -> ComplexMatrix:
    """Return the rows that take a state to its modes."""
    _, vectors = np.linalg.eig(matrix)
    rows: ComplexMatrix = np.linalg.inv(vectors)
    return rows


def _weights_of_modes(
    loop: SampledLoop, cell: ParameterBox, Phi: Matrix, modal: ComplexMatrix, units: Vector
) -> Vector:
    """Return units of the modes that balance what changes between them in a cell."""
    vectors = np.linalg.inv(modal)
    between_modes = np.zeros_like(Phi)
    for theta in _corners(cell):
        change = loop.Phi(theta) - Phi
        balanced = rescaled(change, units)
        of_modes = modal @ balanced @ vectors
        between_modes += np.abs(of_modes)
    return balancing(between_modes)


def _factor(contracting: Matrix, modal: Matrix | ComplexMatrix) -> Matrix:
    """Return the Cholesky factor of P for the weight ``modal' modal``."""
    from scipy.linalg import solve_discrete_lyapunov  # takes long to import

    product = modal.conj().T @ modal
    weight: Matrix = product.real
    with ignored_warnings():  # whatever T is, the bound is of it
        P = solve_discrete_lyapunov(contracting.T, weight)
    symmetric = 0.5 * (P + P.T)
    factor = np.linalg.cholesky(symmetric)
    return np.asarray(factor.T, np.float64)


def _corners(cell: ParameterBox) -> Iterator[Vector]:
    for corner in product(*zip(cell.lower, cell.upper, strict=True)):
        yield np.array(corner)


def _bound(loop: SampledLoop, cell: ParameterBox, Phi: Matrix, T: Matrix) -> float:
    """Return a bound of `||T Phi(theta) T^-1||` for every theta of a cell."""
    inverse = np.linalg.inv(T)
    center = loop.at(cell.center)
    changes = [loop.at(theta).less(center) for theta in _corners(cell)]
    step = _Exponential.of(center)
    first_order = 0.0
    for change in changes:
        linear = Phi + _first_order(loop, center, step, change)
        at_corner = _norm(T @ linear @ inverse)
        first_order = max(first_order, at_corner)
    of_next_u = T @ loop.of_u
    of_x = loop.deviation @ inverse
    of_gains = _product_of_gains(center, changes, of_next_u, of_x)
    of_new_w = _norm(T[:, loop.rows])
    of_model = of_new_w * _second_order_of_model(center, changes, loop.w, inverse)
    magnitudes = np.abs(T) @ np.abs(Phi) @ np.abs(inverse)
    size = _norm(magnitudes)
    rounding = ROUNDING * EPSILON * size
    return first_order + of_gains + of_model + rounding


def _first_order(
    loop: SampledLoop, center: _ModelAt, step: _Exponential, change: _ModelAt
) -> Matrix:
    """Return what Phi changes by, but for products of changes."""
    derivative = _Exponential.derivative(center, change)
    seen = loop.gains_input(center)
    change_of_seen = change.gains.X @ loop.deviation
    of_K_w = change.gains.K_w @ seen
    of_X = center.gains.K_w @ change_of_seen
    of_u = loop.of_u @ (of_K_w + of_X)
    of_state = derivative.E @ loop.w
    of_effect = derivative.F @ center.e
    of_driving = step.F @ change.e
    of_w = loop.placed(of_state + of_effect + of_driving)
    return of_u + of_w


def _product_of_gains(
    center: _ModelAt, changes: Sequence[_ModelAt], of_next_u: Matrix, of_x: Matrix
) -> float:
    """Bound what the product of the changes of K_w and X does, in units of u and w of its own."""
    X = center.gains.X
    seen = [(X + change.gains.X) @ of_x for change in changes]
    all_seen = np.hstack(seen)
    u = _sizes(of_next_u, axis=0)
    w = _sizes(all_seen, axis=1)
    per_u = u[:, np.newaxis]
    per_w = w[:, np.newaxis]
    of_K_w = 0.0
    of_X = 0.0
    for change in changes:
        K_w = per_u * change.gains.K_w * w
        of_K_w = max(of_K_w, _norm(K_w))
        of_seen = change.gains.X @ of_x / per_w
        of_X = max(of_X, _norm(of_seen))
    size = _norm(of_next_u / u)
    return size * of_K_w * of_X


def _second_order_of_model(
    center: _ModelAt, changes: Sequence[_ModelAt], W: Matrix, inverse: NDArray[np.floating[Any]]
) -> float:
    """Bound R, r and the products of the changes of phi(M), g and e."""
    M = _norm(center.M)
    m = max(_norm(change.M) for change in changes)
    if M + m > LARGEST_EXPONENT:
        return math.inf
    g = _norm(center.g)
    of_g = max(_norm(change.g) for change in changes)
    e = _norm(center.e @ inverse)
    of_e = max(_norm(change.e @ inverse) for change in changes)
    w = _norm(W @ inverse)
    driven = (g + of_g) * (e + of_e)
    powers = m**2 * math.exp(M + m)
    of_remainders = powers * (w / 2.0 + driven / 6.0)
    of_exponential = math.exp(M)
    of_phi = 0.5 * m * of_exponential
    of_both = of_g * of_e
    of_products = of_phi * (g * of_e + of_g * e + of_both)
    return of_remainders + of_products + of_exponential * of_both


def _sizes(matrix: Matrix, axis: int) -> Vector:
    """Return the lengths of columns (axis 0) or rows (axis 1); 1 where they are zero."""
    sizes = np.linalg.norm(matrix, axis=axis)
    is_there = sizes > 0.0
    return np.where(is_there, sizes, 1.0)


def _norm(matrix: NDArray[np.floating[Any]]) -> float:
    """Return the largest singular value."""
    return float(np.linalg.norm(matrix, 2))
