"""A proof that a loop is stable for every theta of a box.

One communication step takes the state xi of the sampled loop to ``Phi(theta) xi``. The internal
model depends on theta, and its gains, which are interpolated between nodes (:mod:`.schedule`). It
is discretized exactly: with ``Z = [S(theta), G(theta); 0, 0]``

    Phi = Phi_0 + U K_w (X V - W) + J [I 0] exp(h Z) N

U is what the next u does, V takes the deviation of x_hat, W the state of the internal model, N what
drives it, and J puts its new state in its place. With u at a limit there is only the last term,
with G = -B_w and N = [I; K_w].

K_w, X, B_w and S are multi-affine in theta between nodes. Take the center theta_c of a cell there
and a T with ``||T Phi(theta_c) T^-1|| < 1``, from a Lyapunov equation. For every theta of the cell,
with Delta = h Z - h Z_c,

    exp(h Z) = exp(h Z_c) + L Delta + R,    ||R|| <= ||Delta||^2 / 2 exp(||h Z_c|| + ||Delta||)

where L is the derivative of the exponential at h Z_c, which is linear. What drives the internal
model is in units in which ``h G`` is of size one, so that the bound of R does not depend on those
of the user. What of ``T Phi T^-1`` is of first order in the changes of K_w, X, Delta and N is
multi-affine in theta, and its norm is largest at a corner of the cell; the products of two changes
and R are bounded by norms, also largest at a corner. If all that and an allowance for rounding are
less than 1 together, then ``||T xi||`` falls at every step, for every theta of the cell, also for
one that varies from step to step. Cells where they are not are halved. With one cell the proof is
of a theta that varies in the whole box, with several of a constant one in it, and of one that
varies slowly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.filters import ignored_warnings
from cosim.native.step import matrix_exponential
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox
from cosim.theory.compensation.schedule import Schedule, Stabilization
from cosim.theory.compensation.state_feedback import balancing
from cosim.theory.plants.descriptor import ComplexMatrix

MOST_CELLS = 250  # beyond those between the nodes, where nothing else is said
GRID = 9  # most points on a side of the box where instability is looked for first
GRID_POINTS = 800  # and in the box
ROUNDING = 1e3  # of the products with T, in units of the float spacing
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
        sizes = self.h * np.linalg.norm(nodes, axis=1).max(axis=0)
        return np.where(sizes > 0.0, sizes, 1.0)

    def at(self, theta: Vector) -> _ModelAt:
        """Return what depends on theta."""
        gains = self.schedule.at(theta)
        G = -gains.B_w if self.at_limit else self.model.b
        dynamics = np.hstack([self.model.S(theta), G / self.units])
        n_w, n = dynamics.shape
        no_dynamics = np.zeros((n - n_w, n))
        Z = self.h * np.vstack([dynamics, no_dynamics])
        driving = gains.K_w @ self.w if self.at_limit else self.error
        N = np.vstack([self.w, self.units[:, np.newaxis] * driving])
        return _ModelAt(gains, Z, N)

    def Phi(self, theta: Vector) -> Matrix:
        """Return what a step does to xi, shape ``(n, n)``."""
        model = self.at(theta)
        gains = model.gains
        correction = gains.K_w @ self.gains_input(model)
        step = matrix_exponential(model.Z)
        return self.fixed + self.of_u @ correction + self.placed(step @ model.N)

    def gains_input(self, model: _ModelAt) -> Matrix:
        """Return `X V - W`, which K_w multiplies."""
        return model.gains.X @ self.deviation - self.w

    def placed(self, rows: Matrix) -> Matrix:
        """Return `J [I 0] rows`."""
        total = np.zeros_like(self.fixed)
        total[self.rows] = rows[: len(self.w)]
        return total

    def radius(self, theta: Vector) -> float:
        """Return the largest modulus of an eigenvalue of Phi."""
        eigenvalues = np.linalg.eigvals(self.Phi(theta))
        return float(np.abs(eigenvalues).max())


class _ModelAt(NamedTuple):
    """The gains, h Z and N of a loop at one theta."""

    gains: Stabilization
    Z: Matrix
    N: Matrix


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


def certify(loop: SampledLoop, most_cells: int = MOST_CELLS) -> Certificate:
    """Prove that a loop is stable in the box of its schedule, or find where it is not."""
    slowest, theta = _on_grid(loop)
    where = tuple(theta.tolist())
    if slowest >= 1.0:
        return Certificate(False, 0, _rate(slowest, loop), where)
    waiting = loop.schedule.cells()
    most = len(waiting) + most_cells
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
    return -math.log(max(radius, 1e-300)) / loop.h


def _steepest(loop: SampledLoop, cell: ParameterBox) -> int:
    """Return the parameter whose interval changes the internal model most."""
    widths = cell.upper - cell.lower
    changes = []
    for width, slope in zip(widths, loop.model.S1, strict=True):
        changes.append(width * _norm(slope))
    return int(np.argmax(changes))


def _is_divisible(cell: ParameterBox) -> bool:
    width = cell.upper - cell.lower
    size = np.maximum(np.abs(cell.lower), np.abs(cell.upper))
    return bool((width > 1e-9 * size).any())


def _contraction(loop: SampledLoop, cell: ParameterBox) -> tuple[float, float]:
    """Return a bound of `||T Phi T^-1||` in a cell, and the spectral radius at its center."""
    Phi = loop.Phi(cell.center)
    radius = float(np.abs(np.linalg.eigvals(Phi)).max())
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

    P of ``Phi' P Phi - r^2 P = -Q`` is T'T; r is halfway from the spectral radius to 1. Q weighs
    the modes as they are long in units that balance Phi, or such that what changes in the cell is
    small between them, whatever the units are.
    """
    units = balancing(Phi)
    rows = units[:, np.newaxis]
    balanced = Phi * units / rows
    _, vectors = np.linalg.eig(balanced)
    contracting = balanced / (0.5 * (1.0 + radius))
    with suppress(np.linalg.LinAlgError):  # fewer eigenvectors than states, or P is not positive
        modal = np.linalg.inv(vectors)
        yield _factor(contracting, modal) / units
    with suppress(np.linalg.LinAlgError):
        modal = np.linalg.inv(vectors)
        between_modes = np.zeros_like(Phi)
        for theta in _corners(cell):
            change = (loop.Phi(theta) - Phi) * units / rows
            between_modes += np.abs(modal @ change @ vectors)
        weights = balancing(between_modes)
        yield _factor(contracting, modal / weights[:, np.newaxis]) / units


def _factor(contracting: Matrix, modal: Matrix | ComplexMatrix) -> Matrix:
    """Return the Cholesky factor of P for the weight ``modal' modal``."""
    from scipy.linalg import solve_discrete_lyapunov  # takes long to import

    weight: Matrix = (modal.conj().T @ modal).real
    with ignored_warnings():  # whatever T is, the bound is of it
        P = solve_discrete_lyapunov(contracting.T, weight)
    factor = np.linalg.cholesky(0.5 * (P + P.T))
    return np.asarray(factor.T, np.float64)


def _corners(cell: ParameterBox) -> Iterator[Vector]:
    for corner in product(*zip(cell.lower, cell.upper, strict=True)):
        yield np.array(corner)


def _bound(loop: SampledLoop, cell: ParameterBox, Phi: Matrix, T: Matrix) -> float:
    """Return a bound of `||T Phi(theta) T^-1||` for every theta of a cell."""
    inverse = np.linalg.inv(T)
    center = loop.at(cell.center)
    step = matrix_exponential(center.Z)
    seen = loop.gains_input(center)
    of_next_u = T @ loop.of_u
    of_x = loop.deviation @ inverse
    corners = [loop.at(theta) for theta in _corners(cell)]
    # units of u and w in which the changes of K_w and X are multiplied
    u = _sizes(of_next_u, axis=0)
    w = _sizes(np.hstack([there.gains.X @ of_x for there in corners]), axis=1)
    first_order = 0.0
    changes = np.zeros(5)
    for there in corners:
        K_w = there.gains.K_w - center.gains.K_w
        X = there.gains.X - center.gains.X
        Z = there.Z - center.Z
        N = there.N - center.N
        derivative = _derivative(center.Z, Z)
        change_of_u = K_w @ seen + center.gains.K_w @ X @ loop.deviation
        change_of_w = derivative @ center.N + step @ N
        linear = Phi + loop.of_u @ change_of_u + loop.placed(change_of_w)
        first_order = max(first_order, _norm(T @ linear @ inverse))
        scaled_K_w = u[:, np.newaxis] * K_w * w
        scaled_X = X @ of_x / w[:, np.newaxis]
        sizes = [scaled_K_w, scaled_X, Z, N @ inverse, derivative]
        changes = np.maximum(changes, [_norm(size) for size in sizes])
    of_K, of_X, of_Z, of_N, of_exponential = changes.tolist()
    of_products = _norm(of_next_u / u) * of_K * of_X
    of_remainder = _remainder(_norm(center.Z), of_Z) * (_norm(center.N @ inverse) + of_N)
    of_model = of_remainder + of_exponential * of_N
    magnitudes = np.abs(T) @ np.abs(Phi) @ np.abs(inverse)
    rounding = ROUNDING * float(np.finfo(np.float64).eps) * _norm(magnitudes)
    return first_order + of_products + _norm(T[:, loop.rows]) * of_model + rounding


def _sizes(matrix: Matrix, axis: int) -> Vector:
    """Return the lengths of columns (axis 0) or rows (axis 1); 1 where they are zero."""
    sizes = np.linalg.norm(matrix, axis=axis)
    return np.where(sizes > 0.0, sizes, 1.0)


def _remainder(size: float, change: float) -> float:
    """Return the bound of R by the norms of h Z_c and Delta."""
    if change == 0.0:
        return 0.0
    if size + change > LARGEST_EXPONENT:
        return math.inf
    return 0.5 * change**2 * math.exp(size + change)


def _derivative(Z: Matrix, change: Matrix) -> Matrix:
    """Return the derivative of the exponential at Z in the direction of a change.

    It is the upper right block of the exponential of ``[Z, change; 0, Z]``.
    """
    n = len(Z)
    upper = np.hstack([Z, change])
    lower = np.hstack([np.zeros((n, n)), Z])
    both = matrix_exponential(np.vstack([upper, lower]))
    return both[:n, n:]


def _norm(matrix: Matrix) -> float:
    """Return the largest singular value."""
    return float(np.linalg.norm(matrix, 2))
