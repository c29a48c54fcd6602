"""Descriptor systems (1)-(2), their assumptions, and the reduction (8)-(12) to an ordinary system.

Any number of inputs, disturbances and outputs::

    x_a' = A11 x_a + A12 x_b + B11 u + B12 delta
       0 = A21 x_a + A22 x_b + B21 u + B22 delta
       y = C1  x_a + C2  x_b

E is `diag(I, 0)` (Assumption 1); a general E would be brought to this form by a function of its
own, before `reduce`.
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
        If a matrix is not two-dimensional, does not fit the others or is not finite, or if
        ``n_a`` is not in 1..n.
    """

    A: Matrix
    Bu: Matrix
    Bd: Matrix
    C: Matrix
    n_a: int

    def __post_init__(self) -> None:
        """Freeze and check the matrices."""
        for name in ("A", "Bu", "Bd", "C"):
            matrix = _finite_matrix(name, getattr(self, name))
            object.__setattr__(self, name, matrix)
        rows, n = self.A.shape
        n_y, columns = self.C.shape
        square = rows == n > 0
        _check_shape("A", self.A, square, "(n, n): one row and one column per state")
        per_input = f"({n}, n_u): one row per state, one column per input"
        _check_shape("Bu", self.Bu, len(self.Bu) == n, per_input)
        per_disturbance = f"({n}, n_d): one row per state, one column per disturbance"
        _check_shape("Bd", self.Bd, len(self.Bd) == n, per_disturbance)
        per_output = f"(n_y, {n}): one row per output, one column per state"
        _check_shape("C", self.C, columns == n and n_y > 0, per_output)
        if not 1 <= self.n_a <= n:
            raise AssumptionError(
                f"Assumption 1 (1): n_a = {self.n_a}; needed 1..{n}, the number of dynamic states "
                f"among the {n} rows of A"
            )

    @property
    def E(self) -> Matrix:
        """The matrix of Assumption 1, shape ``(n, n)``."""
        diagonal = np.zeros(len(self.A))
        diagonal[: self.n_a] = 1.0
        return np.diag(diagonal)


@dataclass(frozen=True, eq=False, kw_only=True)
class ReducedSystem:
    """The reduced system (9)-(10) and the algebraic states (8) as a map.

    ::

        x_a' = A_a x_a + B_1a u + B_2a delta
        y    = C3  x_a + C4   u + C5   delta
        x_b  = Kx  x_a + Ku   u + Kd   delta

    Shapes: ``A_a (n_a, n_a)``, ``B_1a (n_a, n_u)``, ``B_2a (n_a, n_d)``; ``C3 (n_y, n_a)``,
    ``C4 (n_y, n_u)``, ``C5 (n_y, n_d)``; ``Kx (n_b, n_a)``, ``Ku (n_b, n_u)``, ``Kd (n_b, n_d)``.
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
            matrix = _finite_matrix(field.name, getattr(self, field.name))
            object.__setattr__(self, field.name, matrix)


def reduce(system: DescriptorSystem) -> ReducedSystem:
    """Eliminate the algebraic states (8)-(10).

    An entry that is smaller than the rounding error of computing it is stored as zero, so that (11)
    can be decided exactly and feedthrough is structure, not rounding.

    Raises
    ------
    AssumptionError
        If ``A22`` is singular (Assumption 2).
    """
    dynamic = slice(None, system.n_a)
    algebraic = slice(system.n_a, None)
    A = system.A
    Bu = system.Bu
    Bd = system.Bd
    C = system.C
    A11 = A[dynamic, dynamic]
    A12 = A[dynamic, algebraic]
    A21 = A[algebraic, dynamic]
    A22 = A[algebraic, algebraic]
    B11 = Bu[dynamic]
    B12 = Bd[dynamic]
    B21 = Bu[algebraic]
    B22 = Bd[algebraic]
    C1 = C[:, dynamic]
    C2 = C[:, algebraic]
    n_y = len(C)
    n_u = Bu.shape[1]
    n_d = Bd.shape[1]
    condition = _condition(A22)
    if not condition < 1.0 / SINGULAR:
        evidence = f"rank {rank(A22)} of {len(A22)}, condition {condition:.3g}"
        verdict = _pencil_verdict(system)
        raise AssumptionError(
            f"Assumption 2 (3): A22 is singular ({evidence}), so x_b is not determined by the "
            f"algebraic equation; {verdict}"
        )
    right = np.hstack([A21, B21, B22])
    K = _algebraic_gain(A22, right, condition)
    begin_u = system.n_a
    begin_d = begin_u + n_u
    Kx, Ku, Kd = np.split(K, [begin_u, begin_d], axis=1)

    def substituted(direct: Matrix, left: Matrix, right: Matrix) -> Matrix:
        """Return ``direct + left right``, a coefficient after x_b was replaced by (8)."""
        total = direct + left @ right
        magnitudes = np.abs(direct) + np.abs(left) @ np.abs(right)
        return without_rounding(total, magnitudes, condition)

    A_a = substituted(A11, A12, Kx)
    B_1a = substituted(B11, A12, Ku)
    B_2a = substituted(B12, A12, Kd)
    C3 = substituted(C1, C2, Kx)
    C4 = substituted(np.zeros((n_y, n_u)), C2, Ku)
    C5 = substituted(np.zeros((n_y, n_d)), C2, Kd)
    return ReducedSystem(A_a=A_a, B_1a=B_1a, B_2a=B_2a, C3=C3, C4=C4, C5=C5, Kx=Kx, Ku=Ku, Kd=Kd)


def algebraic_state(reduced: ReducedSystem, x_a: Vector, *, u: Vector, delta: Vector) -> Vector:
    """Compute the algebraic states `x_b` (8), shape ``(n_b,)``.

    With the initial values of x_a, u and delta this is the consistent initial value of x_b.
    """
    from_x_a = reduced.Kx @ x_a
    from_u = reduced.Ku @ u
    from_delta = reduced.Kd @ delta
    x_b: Vector = from_x_a + from_u + from_delta
    return x_b


def pencil_index(system: DescriptorSystem) -> int:
    """Compute the index of the pencil `s E - A`.

    It is 0 without algebraic states and 1 where ``A22`` is regular. With `H = (s E - A)^-1 E` at a
    point s that is no eigenvalue, the index is how often the range of H, H^2, ... shrinks.

    Raises
    ------
    AssumptionError
        If the pencil is singular: `det(s E - A) = 0` at every s.
    """
    E = system.E
    A = system.A
    size = np.linalg.norm(A) or 1.0
    points = size * np.array([0.37, 0.83, 1.71, 2.93])
    pencils = [point * E - A for point in points]
    conditions = [_condition(pencil) for pencil in pencils]
    best = int(np.argmin(conditions))
    if not conditions[best] < 1.0 / SINGULAR:
        raise AssumptionError(
            "PENCIL_SINGULAR: det(s E - A) = 0 at every s; the equations do not determine the "
            "states"
        )
    H = np.linalg.solve(pencils[best], E * points[best])
    index = 0
    while H.size:
        basis, values = np.linalg.svd(H)[:2]
        range_size = int((values > 1e-10).sum())
        if range_size == len(H):
            break
        range_basis = basis[:, :range_size]
        H = range_basis.T @ H @ range_basis
        index += 1
    return index


def invariant_zeros(reduced: ReducedSystem) -> ComplexVector:
    """Compute the invariant zeros of (A_a, B_2a, C3, C5), from delta to y, shape ``(k,)`` [1/s].

    They are sorted by their real parts.

    Raises
    ------
    AssumptionError
        If the transfer from delta to y does not have full rank, so that every s is a zero.
    """
    A = reduced.A_a
    B = reduced.B_2a
    C = reduced.C3
    D = reduced.C5
    n_y, n_d = D.shape
    if n_d > n_y:  # the transposed system has the same zeros
        A = reduced.A_a.T
        B = reduced.C3.T
        C = reduced.B_2a.T
        D = reduced.C5.T
    V = output_nulling(A, B, C, D)
    k = V.shape[1]
    no_output = np.zeros((len(C), k))
    states = np.vstack([V, no_output])
    inputs = np.vstack([B, D])
    basis = np.hstack([states, inputs])
    if rank(basis) < basis.shape[1]:
        raise AssumptionError(
            "the transfer from delta to y does not have full rank, so every s is an invariant zero"
        )
    rates = np.vstack([A, C]) @ V
    coordinates = np.linalg.lstsq(basis, rates, rcond=None)[0]
    X = coordinates[:k]
    zeros = np.linalg.eigvals(X).astype(np.complex128)
    return np.sort_complex(zeros)


def disturbance_transfer(reduced: ReducedSystem, s: complex) -> ComplexMatrix:
    """Compute the transfer matrix from delta to y at ``s`` [1/s].

    It is `C3 (s I - A_a)^-1 B_2a + C5`, shape ``(n_y, n_d)``.
    """
    A_a = reduced.A_a
    identity = np.eye(len(A_a))
    states = np.linalg.solve(s * identity - A_a, reduced.B_2a)
    transfer = reduced.C3 @ states + reduced.C5
    return np.asarray(transfer, dtype=np.complex128)


def _finite_matrix(name: str, values: Matrix) -> Matrix:
    try:
        matrix = frozen(values, 2)
    except ValueError as error:
        raise AssumptionError(f"{name} is not a matrix: {error}") from error
    finite = np.isfinite(matrix)
    not_finite = np.argwhere(~finite)
    if len(not_finite):
        row, column = not_finite[0]
        value = matrix[row, column]
        raise AssumptionError(f"{name}[{row}, {column}] is {value}; needed a finite number")
    return matrix


def _check_shape(name: str, matrix: Matrix, fits: bool, needed: str) -> None:
    if not fits:
        raise AssumptionError(f"{name} has shape {matrix.shape}; needed {needed}")


def _condition(matrix: Matrix) -> float:
    return float(np.linalg.cond(matrix)) if matrix.size else 1.0


def _algebraic_gain(A22: Matrix, right: Matrix, condition: float) -> Matrix:
    """Solve `A22 K = -right` (8), with zeros where there is nothing but rounding error."""
    solution = np.linalg.solve(A22, right)
    K: Matrix = (0.0 - solution).astype(np.float64)  # not -solution: no negative zeros
    inverse: Matrix = np.linalg.inv(A22).astype(np.float64)
    magnitudes = np.abs(inverse) @ np.abs(right)
    return without_rounding(K, magnitudes, condition)


def _pencil_verdict(system: DescriptorSystem) -> str:
    try:
        index = pencil_index(system)
    except AssumptionError as error:
        return str(error)
    return (
        f"INDEX_{index}: the pencil s E - A has index {index}, needed 1; differentiate the "
        "algebraic equation first"
    )
