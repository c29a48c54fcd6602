"""Descriptor systems (1)-(2), their assumptions, and the reduction (8)-(12) to an ordinary system.

Any number of inputs, disturbances and outputs, any square E::

    E x' = A x + Bu u + Bd delta
       y = C x + Du u + Dd delta

In the paper's form E is `diag(I, 0)` (Assumption 1), and so the states are partitioned::

    x_a' = A11 x_a + A12 x_b + B11 u + B12 delta
       0 = A21 x_a + A22 x_b + B21 u + B22 delta
       y = C1  x_a + C2  x_b

Any other E is brought to this form by its singular value decomposition, `U' E V = diag(S, 0)`, in
units in which the system is of size one (:mod:`cosim.theory.plants.scaling`): orthogonal
transformations add no more than rounding. x_a and x_b are then coordinates in which the reduction
is done; the user sees x = V [x_a; x_b]. A regular E needs none: x_a is x.

Data are known up to rounding, of an entry relative to the size of its row and column. What is
smaller than the effect of that is zero: coefficients of the feedthrough, and singular values.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.plants.elimination import DATA, Eliminated, PartitionedMatrices, eliminate
from cosim.theory.plants.geometry import normalized, output_nulling, rank
from cosim.theory.plants.index import (
    GOOD_ACCURACY,
    check_accuracy,
    check_index,
    check_rank,
)
from cosim.theory.plants.pencil import RankDecomposition, decompose, shuffle
from cosim.theory.plants.scaling import Scales, scales_of, state_space_scales, within_range

ComplexVector: TypeAlias = NDArray[np.complex128]  # shape (n,)
ComplexMatrix: TypeAlias = NDArray[np.complex128]  # shape (n, m)
MATRICES = ("E", "A", "Bu", "Bd", "C", "Du", "Dd")


@dataclass(frozen=True, eq=False, kw_only=True)
class DescriptorSystem:
    """The descriptor system (1) with any square E; see :meth:`partitioned` and :meth:`general`.

    Parameters
    ----------
    E, A : Matrix
        Shape ``(n, n)``.
    Bu, Bd : Matrix
        Shapes ``(n, n_u)`` and ``(n, n_d)``; no columns are allowed.
    C : Matrix
        Shape ``(n_y, n)``.
    Du, Dd : Matrix
        Shapes ``(n_y, n_u)`` and ``(n_y, n_d)``.
    n_a : int, optional
        Of the partitioned form: `E = diag(I, 0)`, the first ``n_a`` states are x_a, the others x_b.

    Raises
    ------
    AssumptionError
        If a matrix is not two-dimensional, does not fit the others or is not finite, or if
        ``n_a`` is not in 1..n, or E is another one than it says.
    """

    E: Matrix
    A: Matrix
    Bu: Matrix
    Bd: Matrix
    C: Matrix
    Du: Matrix
    Dd: Matrix
    n_a: int | None = None

    def __post_init__(self) -> None:
        """Freeze and check the matrices."""
        for name in MATRICES:
            matrix = _finite_matrix(name, getattr(self, name))
            object.__setattr__(self, name, matrix)
        rows, n = self.A.shape
        n_y, columns = self.C.shape
        square = rows == n > 0
        _check_shape("A", self.A, square, "(n, n): one row and one column per state")
        _check_shape("E", self.E, self.E.shape == (n, n), f"({n}, {n}), the shape of A")
        per_input = f"({n}, n_u): one row per state, one column per input"
        _check_shape("Bu", self.Bu, len(self.Bu) == n, per_input)
        per_disturbance = f"({n}, n_d): one row per state, one column per disturbance"
        _check_shape("Bd", self.Bd, len(self.Bd) == n, per_disturbance)
        per_output = f"(n_y, {n}): one row per output, one column per state"
        _check_shape("C", self.C, columns == n and n_y > 0, per_output)
        for name, B in (("Du", self.Bu), ("Dd", self.Bd)):
            D = getattr(self, name)
            m = B.shape[1]
            per_pair = f"({n_y}, {m}): one row per row of C, one column per column of B{name[1]}"
            _check_shape(name, D, D.shape == (n_y, m), per_pair)
        if self.n_a is not None and not np.array_equal(self.E, _diagonal_E(self.n_a, n)):
            raise AssumptionError(f"Assumption 1 (1): E is not diag(I, 0) with n_a = {self.n_a}")

    @classmethod
    def partitioned(
        cls, *, A: ArrayLike, Bu: ArrayLike, Bd: ArrayLike, C: ArrayLike, n_a: int
    ) -> Self:
        """Build the paper's form: `E = diag(I, 0)` with ``n_a`` ones, and no feedthrough."""
        n = len(_finite_matrix("A", A))
        if not 1 <= n_a <= n:
            raise AssumptionError(
                f"Assumption 1 (1): n_a = {n_a}; needed 1..{n}, the number of dynamic states "
                f"among the {n} rows of A"
            )
        n_y = len(_finite_matrix("C", C))
        Du = np.zeros((n_y, _finite_matrix("Bu", Bu).shape[1]))
        Dd = np.zeros((n_y, _finite_matrix("Bd", Bd).shape[1]))
        E = _diagonal_E(n_a, n)
        matrices = {"E": E, "A": A, "Bu": Bu, "Bd": Bd, "C": C, "Du": Du, "Dd": Dd}
        return cls(**{name: np.asarray(matrix) for name, matrix in matrices.items()}, n_a=n_a)

    @classmethod
    def general(
        cls,
        *,
        A: ArrayLike,
        C: ArrayLike,
        E: ArrayLike | None = None,
        Bu: ArrayLike | None = None,
        Bd: ArrayLike | None = None,
        Du: ArrayLike | None = None,
        Dd: ArrayLike | None = None,
    ) -> Self:
        """Build any form; without E it is the identity, without a B there are no such inputs."""
        n = len(_finite_matrix("A", A))
        n_y = len(_finite_matrix("C", C))
        of_u = np.zeros((n, 0)) if Bu is None else _finite_matrix("Bu", Bu)
        of_delta = np.zeros((n, 0)) if Bd is None else _finite_matrix("Bd", Bd)
        return cls(
            E=np.eye(n) if E is None else np.asarray(E),
            A=np.asarray(A),
            Bu=of_u,
            Bd=of_delta,
            C=np.asarray(C),
            Du=np.zeros((n_y, of_u.shape[1])) if Du is None else np.asarray(Du),
            Dd=np.zeros((n_y, of_delta.shape[1])) if Dd is None else np.asarray(Dd),
        )

    @cached_property
    def scales(self) -> Scales:
        """The sizes of its equations, states, inputs (u, delta) and outputs."""
        B = np.hstack([self.Bu, self.Bd])
        D = np.hstack([self.Du, self.Dd])
        return scales_of(self.E, self.A, B, self.C, D)


@dataclass(frozen=True, eq=False, kw_only=True)
class UserCoordinates:
    """The user's states ``x = X x_a + Xu u + Xd delta``, and back: ``x_a = R x``.

    Shapes: ``X (n, n_a)``, ``Xu (n, n_u)``, ``Xd (n, n_d)``, ``R (n_a, n)``.
    """

    X: Matrix
    Xu: Matrix
    Xd: Matrix
    R: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for name in ("X", "Xu", "Xd", "R"):
            object.__setattr__(self, name, _finite_matrix(name, getattr(self, name)))


@dataclass(frozen=True, eq=False, kw_only=True)
class ReducedSystem:
    """The reduced system (9)-(10) and the algebraic states (8) as a map.

    ::

        x_a' = A_a x_a + B_1a u + B_2a delta
        y    = C3  x_a + C4   u + C5   delta
        x_b  = Kx  x_a + Ku   u + Kd   delta

    Shapes: ``A_a (n_a, n_a)``, ``B_1a (n_a, n_u)``, ``B_2a (n_a, n_d)``; ``C3 (n_y, n_a)``,
    ``C4 (n_y, n_u)``, ``C5 (n_y, n_d)``; ``Kx (n_b, n_a)``, ``Ku (n_b, n_u)``, ``Kd (n_b, n_d)``.

    ``coordinates`` lead to the user's states; None where these are x_a and x_b themselves.
    ``accuracy`` bounds the error of the entries, where the system is of size one; beyond
    a limit (:func:`~cosim.theory.plants.index.check_accuracy`) there is none.
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
    coordinates: UserCoordinates | None = None
    accuracy: float = 0.0

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for field in fields(self)[:9]:
            matrix = _finite_matrix(field.name, getattr(self, field.name))
            object.__setattr__(self, field.name, matrix)

    @property
    def inaccuracy(self) -> str:
        """What is to be said of the accuracy; empty: nothing."""
        if self.accuracy <= GOOD_ACCURACY:
            return ""
        return (
            f"the reduced system is known only up to {self.accuracy:.1g} of its size, as it rests "
            "on an E, or algebraic equations, that nearly lose rank"
        )


@dataclass(frozen=True, eq=False)
class StateMap:
    """States that the user sees: ``of_x_a x_a + of_u u + of_delta delta``."""

    name: str
    of_x_a: Matrix
    of_u: Matrix
    of_delta: Matrix


def state_maps(reduced: ReducedSystem) -> tuple[StateMap, ...]:
    """Return x_a and, where there is any, x_b of the partitioned form; x of the general one."""
    coordinates = reduced.coordinates
    if coordinates is not None:
        return (StateMap("x", coordinates.X, coordinates.Xu, coordinates.Xd),)
    n_a, n_u = reduced.B_1a.shape
    n_d = reduced.B_2a.shape[1]
    x_a = StateMap("x_a", np.eye(n_a), np.zeros((n_a, n_u)), np.zeros((n_a, n_d)))
    if not len(reduced.Kx):
        return (x_a,)
    return x_a, StateMap("x_b", reduced.Kx, reduced.Ku, reduced.Kd)


def reduced_scales(reduced: ReducedSystem) -> Scales:
    """Compute coarse sizes of the states x_a, the inputs (u, delta) and the outputs."""
    B = np.hstack([reduced.B_1a, reduced.B_2a])
    D = np.hstack([reduced.C4, reduced.C5])
    return state_space_scales(reduced.A_a, B, reduced.C3, D).coarse()


def in_units(reduced: ReducedSystem, scales: Scales) -> ReducedSystem:
    """Return (9)-(10) in other units of x_a, u, delta and y, without the map to the user's."""
    n_u = reduced.B_1a.shape[1]
    n_d = reduced.B_2a.shape[1]
    x = scales.states[:, np.newaxis]
    y = scales.outputs[:, np.newaxis]
    u = scales.inputs[:n_u]
    delta = scales.inputs[n_u:]
    no_states = np.zeros((0, len(x)))
    return ReducedSystem(
        A_a=reduced.A_a * scales.states / x,
        B_1a=reduced.B_1a * u / x,
        B_2a=reduced.B_2a * delta / x,
        C3=reduced.C3 * scales.states / y,
        C4=reduced.C4 * u / y,
        C5=reduced.C5 * delta / y,
        Kx=no_states,
        Ku=np.zeros((0, n_u)),
        Kd=np.zeros((0, n_d)),
        accuracy=reduced.accuracy,
    )


@within_range()
def reduce(system: DescriptorSystem) -> ReducedSystem:
    """Eliminate the algebraic states (8)-(10).

    A feedthrough that is smaller than what rounding of the data may make of zero is zero, so that
    (11) can be decided and feedthrough is structure, not rounding.

    Raises
    ------
    AssumptionError
        If the pencil `s E - A` is singular, or has an index above 1 (Assumption 2), or there are
        no dynamic states; or if E or A22 is so near to a lower rank that rounding decides.
    """
    scales = system.scales
    E = scales.scaled_E(system.E)
    A = scales.scaled_E(system.A)
    n = len(A)
    known_rank = n if np.array_equal(system.E, np.eye(n)) else system.n_a
    decomposition = decompose(E, known_rank)
    check_index(E, A, decomposition)
    if system.n_a is not None:
        reduced = _reduced_partitioned(system, scales, system.n_a)
    elif len(decomposition.values) == n:
        reduced = _reduced_regular(system, scales, decomposition.growth)
    else:
        reduced = _reduced_singular(system, scales, decomposition)
    check_accuracy(reduced.accuracy, A, decomposition)
    return reduced


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
    """Compute the index of the pencil `s E - A`: 0 with a regular E, 1 where A22 is regular.

    Raises
    ------
    AssumptionError
        If the pencil is singular: `det(s E - A) = 0` at every s; or the rank of E is not clear.
    """
    scales = system.scales
    E = scales.scaled_E(system.E)
    A = scales.scaled_E(system.A)
    decomposition = decompose(E, system.n_a)
    index = shuffle(E, A, decomposition).index
    if index > 1:
        check_rank(A, decomposition)
    return index


def _reduced_partitioned(system: DescriptorSystem, scales: Scales, n_a: int) -> ReducedSystem:
    """Reduce the paper's form, in its own coordinates."""
    B = (system.Bu, system.Bd)
    D = (system.Du, system.Dd)
    return _reduced(eliminate(PartitionedMatrices(system.A, B, system.C, D, n_a), scales, 1.0))


def _reduced_regular(system: DescriptorSystem, scales: Scales, growth: float) -> ReducedSystem:
    """Reduce a system without algebraic states: x_a is x."""
    A = system.A
    Bu = system.Bu
    Bd = system.Bd
    n, n_u = Bu.shape
    if not np.array_equal(system.E, np.eye(n)):
        E = scales.scaled_E(system.E)
        right = np.hstack([A, Bu, Bd]) / scales.equations[:, np.newaxis]
        rates = np.linalg.solve(E, right) * scales.states[:, np.newaxis]
        A, Bu, Bd = np.split(rates, [n, n + n_u], axis=1)
    D = (system.Du, system.Dd)
    left = eliminate(PartitionedMatrices(A, (Bu, Bd), system.C, D, n), scales, growth)
    identity = np.eye(n)
    coordinates = UserCoordinates(
        X=identity, Xu=np.zeros(Bu.shape), Xd=np.zeros(Bd.shape), R=identity
    )
    return _reduced(left, coordinates)


def _reduced_singular(
    system: DescriptorSystem, scales: Scales, decomposition: RankDecomposition
) -> ReducedSystem:
    """Reduce a system with any singular E, in units and coordinates where it is diag(I, 0)."""
    n, n_u = system.Bu.shape
    n_a = len(decomposition.values)
    left = np.vstack([decomposition.U1.T / decomposition.values[:, np.newaxis], decomposition.U2.T])
    V = np.hstack([decomposition.V1, decomposition.V2])
    B = left @ scales.scaled_B(np.hstack([system.Bu, system.Bd]))
    D = scales.scaled_D(np.hstack([system.Du, system.Dd]))
    matrices = PartitionedMatrices(
        A=left @ scales.scaled_E(system.A) @ V,
        B=(B[:, :n_u], B[:, n_u:]),
        C=scales.scaled_C(system.C) @ V,
        D=(D[:, :n_u], D[:, n_u:]),
        n_a=n_a,
    )
    units = Scales(
        equations=np.concatenate([1.0 / decomposition.values, np.ones(n - n_a)]),
        states=np.ones(n),
        inputs=np.ones(B.shape[1]),
        outputs=np.ones(len(D)),
    )
    eliminated = eliminate(matrices, units, decomposition.growth)
    return _in_user_units(eliminated, scales, decomposition)


def _in_user_units(
    eliminated: Eliminated, scales: Scales, decomposition: RankDecomposition
) -> ReducedSystem:
    """Return u, delta, y and x to the user's units; x_a stays where the system is of size one."""
    V1 = decomposition.V1
    V2 = decomposition.V2
    n_u = eliminated.B[0].shape[1]
    units = (scales.inputs[:n_u], scales.inputs[n_u:])
    states = scales.states[:, np.newaxis]
    outputs = scales.outputs[:, np.newaxis]
    X_v = []
    for gain, error in zip(eliminated.Kv, eliminated.Kv_error, strict=True):
        rounding = decomposition.growth * DATA * np.abs(gain).sum(axis=0)
        known_up_to = np.abs(V2) @ error + rounding
        of_input = V2 @ gain
        X_v.append(np.where(np.abs(of_input) > known_up_to, of_input, 0.0))
    coordinates = UserCoordinates(
        X=states * (V1 + V2 @ eliminated.K),
        Xu=states * X_v[0] / units[0],
        Xd=states * X_v[1] / units[1],
        R=V1.T / scales.states,
    )
    in_units = replace(
        eliminated,
        B=(eliminated.B[0] / units[0], eliminated.B[1] / units[1]),
        C=outputs * eliminated.C,
        D=(outputs * eliminated.D[0] / units[0], outputs * eliminated.D[1] / units[1]),
        Kv=(eliminated.Kv[0] / units[0], eliminated.Kv[1] / units[1]),
    )
    neglected = float(decomposition.neglected.max(initial=0.0)) / decomposition.growth
    return _reduced(in_units, coordinates, neglected)


def _reduced(
    left: Eliminated, coordinates: UserCoordinates | None = None, neglected: float = 0.0
) -> ReducedSystem:
    B_1a, B_2a = left.B
    C4, C5 = left.D
    Ku, Kd = left.Kv
    return ReducedSystem(
        A_a=left.A,
        B_1a=B_1a,
        B_2a=B_2a,
        C3=left.C,
        C4=C4,
        C5=C5,
        Kx=left.K,
        Ku=Ku,
        Kd=Kd,
        coordinates=coordinates,
        accuracy=(DATA + neglected) * len(left.A) * left.amplification,
    )


def invariant_zeros(reduced: ReducedSystem) -> ComplexVector:
    """Compute the invariant zeros of (A_a, B_2a, C3, C5), from delta to y, shape ``(k,)`` [1/s].

    They are sorted by their real parts.

    Raises
    ------
    AssumptionError
        If the transfer from delta to y does not have full rank, so that every s is a zero.
    """
    reduced = in_units(reduced, reduced_scales(reduced))
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
    n, k = V.shape
    rate = np.linalg.norm(A) or 1.0
    outputs = normalized(np.hstack([C, D]), axis=1)
    no_output = np.zeros((len(C), k))
    states = np.vstack([V, no_output])
    inputs = normalized(np.vstack([B / rate, outputs[:, n:]]), axis=0)
    basis = np.hstack([states, inputs])
    if rank(basis) < basis.shape[1]:
        raise AssumptionError(
            "the transfer from delta to y does not have full rank, so every s is an invariant zero"
        )
    rates = np.vstack([A / rate, outputs[:, :n]]) @ V
    coordinates = np.linalg.lstsq(basis, rates, rcond=None)[0]
    X = rate * coordinates[:k]
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


def _finite_matrix(name: str, values: ArrayLike) -> Matrix:
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


def _diagonal_E(n_a: int, n: int) -> Matrix:
    """Return the E of Assumption 1."""
    diagonal = np.zeros(n)
    diagonal[:n_a] = 1.0
    return np.diag(diagonal)
