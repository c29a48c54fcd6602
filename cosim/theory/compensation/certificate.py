"""A proof that a loop is stable for every theta of a box.

One communication step takes the state xi of the sampled loop to ``Phi(theta) xi``. Only the
internal model depends on theta, and it is discretized exactly: with ``Z = [S(theta), G; 0, 0]``

    Phi(theta) = Phi_0 + J [I 0] exp(h Z(theta)) N

where N picks what drives the internal model and J puts its new state in its place.

Take the center theta_c of a cell and a T with ``||T Phi(theta_c) T^-1|| < 1``, from a Lyapunov
equation. For every theta of the cell, with Delta = h Z(theta) - h Z(theta_c), affine in theta,

    exp(h Z) = exp(h Z_c) + L Delta + R,    ||R|| <= ||Delta||^2 / 2 exp(||h Z_c|| + ||Delta||)

L is the derivative of the exponential at h Z_c, which is linear. What drives the internal model is
in units in which ``h G`` is of size one, so that the bound of R does not depend on those of the
user. So the norm of
``T (Phi_c + J [I 0] (L Delta) N) T^-1`` is convex in theta: it is largest at a corner of the cell.
If that, and ``||T J|| ||R|| ||N T^-1||``, and an allowance for rounding, are less than 1 together,
then ``||T xi||`` falls at every step, for every theta of the cell, also for one that varies from
step to step. Cells where they are not are halved. With one cell the proof is of a theta that varies
in the whole box, with several of a constant one in it, and of one that varies slowly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.step import matrix_exponential
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox
from cosim.theory.compensation.state_feedback import balancing

MOST_CELLS = 300
GRID = 9  # most points on a side of the box where instability is looked for first
GRID_POINTS = 800  # and in the box
BISECTIONS = 10  # of an interval that would do
MARGINS = (0.0, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9, 1.0)  # by which it shrinks until it is proven
ROUNDING = 1e3  # of the products with T, in units of the float spacing
LARGEST_EXPONENT = 700.0  # of the bound of R, beyond which it proves nothing


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledLoop:
    """The loop over one step, as the module says.

    Parameters
    ----------
    fixed : Matrix
        Phi_0, shape ``(n, n)``.
    first : int
        Where the state of the internal model begins in xi.
    taken : Matrix
        N, shape ``(n_w + m, n)``: the state of the internal model, and what drives it.
    model : InternalModel
    G : Matrix
        How it drives it [1/s], shape ``(n_w, m)``.
    h : float
        Communication step [s].
    """

    fixed: Matrix
    first: int
    taken: Matrix
    model: InternalModel
    G: Matrix
    h: float

    @property
    def rows(self) -> slice:
        """The rows of the internal model."""
        return slice(self.first, self.first + len(self.G))

    def normalized(self) -> SampledLoop:
        """Return the same loop with what drives the internal model in units of size one."""
        sizes = self.h * np.linalg.norm(self.G, axis=0)
        units = np.where(sizes > 0.0, sizes, 1.0)
        n_w = len(self.G)
        driving = self.taken[n_w:] * units[:, np.newaxis]
        return replace(self, taken=np.vstack([self.taken[:n_w], driving]), G=self.G / units)

    def generator(self, theta: Vector) -> Matrix:
        """Return `h Z`, shape ``(n_w + m, n_w + m)``."""
        dynamics = np.hstack([self.model.S(theta), self.G])
        n_w, n = dynamics.shape
        driving = np.zeros((n - n_w, n))
        scaled: Matrix = self.h * np.vstack([dynamics, driving])
        return scaled

    def Phi(self, theta: Vector) -> Matrix:
        """Return what a step does to xi, shape ``(n, n)``."""
        step = matrix_exponential(self.generator(theta))
        return self.fixed + self.placed(step)

    def placed(self, step: Matrix) -> Matrix:
        """Return `J [I 0] step N`."""
        total = np.zeros_like(self.fixed)
        n_w = len(self.G)
        total[self.rows] = step[:n_w] @ self.taken
        return total

    def radius(self, theta: Vector) -> float:
        """Return the largest modulus of an eigenvalue of Phi."""
        eigenvalues = np.linalg.eigvals(self.Phi(theta))
        return float(np.abs(eigenvalues).max())


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


def certify(loop: SampledLoop, box: ParameterBox) -> Certificate:
    """Prove that a loop is stable in a box, or find where it is not."""
    loop = loop.normalized()
    slowest, theta = _on_grid(loop, box)
    where = tuple(theta.tolist())
    if slowest >= 1.0:
        return Certificate(False, 0, _rate(slowest, loop), where)
    waiting = [box]
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
        if radius >= 1.0 or cells + len(waiting) > MOST_CELLS or not _is_divisible(cell):
            center = tuple(cell.center.tolist())
            return Certificate(False, cells, _rate(radius, loop), center)
        waiting.extend(cell.halves(_steepest(loop, cell)))
    return Certificate(True, cells, _rate(slowest, loop), where)


def largest_factor(loop: SampledLoop, box: ParameterBox) -> float:
    """Return by how much a box has to shrink about its center for a proof; 0: to nothing.

    That is where the loop becomes unstable, less what the proof needs as a margin.
    """
    low = 0.0
    high = 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        slowest, _ = _on_grid(loop, box.scaled(middle))
        if slowest < 1.0:
            low = middle
        else:
            high = middle
    for margin in MARGINS:
        factor = low * (1.0 - margin)
        if certify(loop, box.scaled(factor)).proven:
            return factor
    return 0.0


def _on_grid(loop: SampledLoop, box: ParameterBox) -> tuple[float, Vector]:
    """Return the largest spectral radius on a grid, and the theta where it is."""
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
    center = cell.center
    Phi = loop.Phi(center)
    radius = float(np.abs(np.linalg.eigvals(Phi)).max())
    if radius >= 1.0:
        return math.inf, radius
    bound = math.inf
    for T in _norms(Phi, radius):
        bound = min(bound, _bound(loop, cell, Phi, T))
        if bound < 1.0:
            break
    return bound, radius


def _norms(Phi: Matrix, radius: float) -> Iterator[Matrix]:
    """Yield matrices T in whose norm Phi contracts, where they can be computed.

    P of ``Phi' P Phi - r^2 P = -Q`` is T'T; r is halfway from the spectral radius to 1. Q that
    weighs the modes alike does not depend on the units of the states; its solution does by
    rounding, so it is computed in units that balance Phi.
    """
    from scipy.linalg import solve_discrete_lyapunov  # takes long to import

    units = balancing(Phi)
    balanced = Phi * units / units[:, np.newaxis]
    _, vectors = np.linalg.eig(balanced)
    r = 0.5 * (1.0 + radius)
    weights = []
    with suppress(np.linalg.LinAlgError):  # without as many eigenvectors as states
        modal = np.linalg.inv(vectors)
        of_modes: Matrix = (modal.conj().T @ modal).real
        weights.append(of_modes)
    weights.append(np.eye(len(Phi)))
    for weight in weights:
        P = solve_discrete_lyapunov((balanced / r).T, weight)
        symmetric = 0.5 * (P + P.T)
        with suppress(np.linalg.LinAlgError):  # not positive by rounding
            factor = np.linalg.cholesky(symmetric)
            yield factor.T / units


def _bound(loop: SampledLoop, cell: ParameterBox, Phi: Matrix, T: Matrix) -> float:
    """Return a bound of `||T Phi(theta) T^-1||` for every theta of a cell."""
    inverse = np.linalg.inv(T)
    Z = loop.generator(cell.center)
    largest = 0.0
    farthest = 0.0
    ends = zip(cell.lower, cell.upper, strict=True)
    for corner in product(*ends):
        change = loop.generator(np.array(corner)) - Z
        linear = Phi + loop.placed(_derivative(Z, change))
        largest = max(largest, _norm(T @ linear @ inverse))
        farthest = max(farthest, _norm(change))
    remainder = _remainder(_norm(Z), farthest)
    into = _norm(T[:, loop.rows])
    out_of = _norm(loop.taken @ inverse)
    magnitudes = np.abs(T) @ np.abs(Phi) @ np.abs(inverse)
    rounding = ROUNDING * float(np.finfo(np.float64).eps) * _norm(magnitudes)
    return largest + into * remainder * out_of + rounding


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
