"""Descriptor systems (1)-(2), their assumptions, and the reduction to an ordinary differential equation (8)-(12).

Any number of inputs, disturbances and outputs::

    x_a' = A11 x_a + A12 x_b + B11 u + B12 delta
       0 = A21 x_a + A22 x_b + B21 u + B22 delta
       y = C1  x_a + C2  x_b

E is `diag(I, 0)` (Assumption 1); a general E would be brought to this form by a function of its own, before `reduce`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.geometry import output_nulling, rank, without_rounding

ComplexVector: TypeAlias = NDArray[np.complex128]  # shape (n,)
ComplexMatrix: TypeAlias = NDArray[np.complex128]  # shape (n, m)

SINGULAR = 1e-12  # reciprocal condition below which a matrix counts as singular


@dataclass(frozen=True, eq=False, kw_only=True)
class DescriptorSystem:
    """The descriptor system (1) with `E = diag(I, 0)`, partitioned as (2).

    Parameters
    ----------
    A : Matrix
        Shape ``(n, n)``.
    Bu, Bd : Matrix
        Shapes ``(n, n_u)`` and ``(n, n_d)``; no columns are allowed.
    C : Matrix
        Shape ``(n_y, n)``.
    n_a : int
        Number of dynamic states; the last ``n - n_a`` states are algebraic.

    Raises
    ------
    AssumptionError
        If a matrix is not two-dimensional, does not fit the others or is not finite, or if ``n_a`` is not in 1..n.
    """

    A: Matrix
    Bu: Matrix
    Bd: Matrix
    C: Matrix
    n_a: int

    def __post_init__(self) -> None:
        """Freeze and check the matrices."""
        for name in ("A", "Bu", "Bd", "C"):
            object.__setattr__(self, name, _matrix(name, getattr(self, name)))
        n = self.A.shape[1]
        _need(
            self.A.shape == (n, n) and n > 0,
            "A",
            self.A,
            "(n, n): one row and one column per state",
        )
        _need(
            self.Bu.shape[0] == n,
            "Bu",
            self.Bu,
            f"({n}, n_u): one row per state, one column per input",
        )
        _need(
            self.Bd.shape[0] == n,
            "Bd",
            self.Bd,
            f"({n}, n_d): one row per state, one column per disturbance",
        )
        _need(
            self.C.shape[1] == n and self.C.shape[0] > 0,
            "C",
            self.C,
            f"(n_y, {n}): one row per output, one column per state",
        )
        if not 1 <= self.n_a <= n:
            raise AssumptionError(
                f"Assumption 1 (1): n_a = {self.n_a}; needed 1..{n}, the number of dynamic states among the {n} rows of A"
            )

    @property
    def E(self) -> Matrix:
        """The matrix of Assumption 1, shape ``(n, n)``."""
        return np.diag([1.0] * self.n_a + [0.0] * (self.A.shape[0] - self.n_a))


@dataclass(frozen=True, eq=False, kw_only=True)
class ReducedSystem:
    """The reduced system (9)-(10) and the algebraic states (8) as a map.

    ::

        x_a' = A_a x_a + B_1a u + B_2a delta
        y    = C3  x_a + C4   u + C5   delta
        x_b  = Kx  x_a + Ku   u + Kd   delta

    Shapes: ``A_a (n_a, n_a)``, ``B_1a (n_a, n_u)``, ``B_2a (n_a, n_d)``; ``n_y`` rows in C3, C4, C5, ``n_b`` rows in Kx, Ku, Kd.
    """

    A_a: Matrix
    B_1a: Matrix
    B_2a: Matrix
    C3: Matrix
    C4: Matrix
    C5: Matrix
    Kx: Matrix
    Ku: Matrix
    Kd: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for field in fields(self):
            object.__setattr__(self, field.name, _matrix(field.name, getattr(self, field.name)))


def reduce(system: DescriptorSystem) -> ReducedSystem:
    """Eliminate the algebraic states (8)-(10).

    An entry that is smaller than the rounding error of computing it is stored as zero, so that (11) can be decided exactly and
    feedthrough is structure, not rounding.

    Raises
    ------
    AssumptionError
        If ``A22`` is singular (Assumption 2).
    """
    a, b = slice(None, system.n_a), slice(system.n_a, None)
    A, Bu, Bd, C = system.A, system.Bu, system.Bd, system.C
    condition = _condition(A[b, b])
    if not condition < 1.0 / SINGULAR:
        raise AssumptionError(
            f"Assumption 2 (3): A22 is singular (rank {rank(A[b, b])} of {len(A[b, b])}, condition {condition:.3g}), so x_b is "
            f"not determined by the algebraic equation; {_pencil_verdict(system)}"
        )
    K: Matrix = (0.0 - np.linalg.solve(A[b, b], np.hstack([A[b, a], Bu[b], Bd[b]]))).astype(
        np.float64
    )
    inverse: Matrix = np.abs(np.linalg.inv(A[b, b])).astype(np.float64)
    sums = inverse @ np.abs(np.hstack([A[b, a], Bu[b], Bd[b]]))
    K = without_rounding(K, sums, condition)
    Kx, Ku, Kd = np.split(K, [system.n_a, system.n_a + Bu.shape[1]], axis=1)

    def through(direct: Matrix, left: Matrix, right: Matrix) -> Matrix:
        return without_rounding(
            direct + left @ right, np.abs(direct) + np.abs(left) @ np.abs(right), condition
        )

    no_u, no_d = np.zeros((len(C), Bu.shape[1])), np.zeros((len(C), Bd.shape[1]))
    return ReducedSystem(
        A_a=through(A[a, a], A[a, b], Kx),
        B_1a=through(Bu[a], A[a, b], Ku),
        B_2a=through(Bd[a], A[a, b], Kd),
        C3=through(C[:, a], C[:, b], Kx),
        C4=through(no_u, C[:, b], Ku),
        C5=through(no_d, C[:, b], Kd),
        Kx=Kx,
        Ku=Ku,
        Kd=Kd,
    )


def algebraic_state(reduced: ReducedSystem, x_a: Vector, *, u: Vector, delta: Vector) -> Vector:
    """Give `x_b` (8), shape ``(n_b,)``; with the values at the start it is the consistent start."""
    x_b: Vector = reduced.Kx @ x_a + reduced.Ku @ u + reduced.Kd @ delta
    return x_b


def pencil_index(system: DescriptorSystem) -> int:
    """Give the index of the pencil `s E - A`: 0 without algebraic states, 1 where ``A22`` is regular.

    With `H = (s E - A)^-1 E` at a point s that is no eigenvalue, the index is how often the range of H, H^2, ... shrinks.

    Raises
    ------
    AssumptionError
        If the pencil is singular: `det(s E - A) = 0` at every s.
    """
    E, A = system.E, system.A
    size = np.linalg.norm(A) or 1.0
    s = min(size * np.array([0.37, 0.83, 1.71, 2.93]), key=lambda point: _condition(point * E - A))
    if not _condition(s * E - A) < 1.0 / SINGULAR:
        raise AssumptionError(
            "PENCIL_SINGULAR: det(s E - A) = 0 at every s; the equations do not determine the states"
        )
    H = np.linalg.solve(s * E - A, E * s)
    index = 0
    while H.size:
        basis, values = np.linalg.svd(H)[:2]
        kept = basis[:, : int((values > 1e-10).sum())]
        if kept.shape[1] == len(H):
            break
        H = kept.T @ H @ kept
        index += 1
    return index


def invariant_zeros(reduced: ReducedSystem) -> ComplexVector:
    """Give the invariant zeros of (A_a, B_2a, C3, C5), from the disturbance to the output, sorted by real part.

    Raises
    ------
    AssumptionError
        If there are more disturbances (outputs) than the outputs (disturbances) tell apart, so that every s is a zero.
    """
    A, B, C, D = reduced.A_a, reduced.B_2a, reduced.C3, reduced.C5
    if B.shape[1] > C.shape[0]:
        A, B, C, D = A.T, C.T, B.T, D.T  # the transposed system has the same zeros
    V = output_nulling(A, B, C, D)
    k = V.shape[1]
    basis = np.hstack([np.vstack([V, np.zeros((len(C), k))]), np.vstack([B, D])])
    if rank(basis) < basis.shape[1]:
        raise AssumptionError(
            "the transfer from delta to y does not have full rank, so every s is an invariant zero"
        )
    X = np.linalg.lstsq(basis, np.vstack([A, C]) @ V, rcond=None)[0][:k]
    return np.sort_complex(np.linalg.eigvals(X).astype(np.complex128))


def disturbance_transfer(reduced: ReducedSystem, s: complex) -> ComplexMatrix:
    """Give the transfer matrix from delta to y at ``s`` [1/s], `C3 (s I - A_a)^-1 B_2a + C5`, shape ``(n_y, n_d)``."""
    resolvent = s * np.eye(len(reduced.A_a)) - reduced.A_a
    return np.asarray(
        reduced.C3 @ np.linalg.solve(resolvent, reduced.B_2a) + reduced.C5, dtype=np.complex128
    )


def _matrix(name: str, values: Matrix) -> Matrix:
    try:
        matrix = frozen(values, 2)
    except ValueError as error:
        raise AssumptionError(f"{name} is not a matrix: {error}") from error
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise AssumptionError(
            f"{name}[{row}, {column}] is {matrix[row, column]}; needed a finite number"
        )
    return matrix


def _need(fits: bool, name: str, matrix: Matrix, needed: str) -> None:
    if not fits:
        raise AssumptionError(f"{name} has shape {matrix.shape}; needed {needed}")


def _condition(matrix: Matrix) -> float:
    return float(np.linalg.cond(matrix)) if matrix.size else 1.0


def _pencil_verdict(system: DescriptorSystem) -> str:
    try:
        index = pencil_index(system)
    except AssumptionError as error:
        return str(error)
    return f"INDEX_{index}: the pencil s E - A has index {index}, needed 1; differentiate the algebraic equation first"
