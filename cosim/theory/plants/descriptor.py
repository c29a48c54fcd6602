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
is done; the user sees x = V [x_a; x_b]. A regular E needs none: x_a is x. Of an index above 1, the
constraints are differentiated first (:func:`~cosim.theory.plants.index.of_index_one`).

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
    of_index_one,
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
        E_rows, E_columns = self.E.shape
        is_square = rows == n > 0
        _check_shape("A", self.A, is_square, "(n, n): one row and one column per state")
        is_as_A = E_rows == E_columns == n
        _check_shape("E", self.E, is_as_A, f"({n}, {n}), the shape of A")
        per_input = f"({n}, n_u): one row per state, one column per input"
        has_inputs = len(self.Bu) == n
        _check_shape("Bu", self.Bu, has_inputs, per_input)
        per_disturbance = f"({n}, n_d): one row per state, one column per disturbance"
        has_disturbances = len(self.Bd) == n
        _check_shape("Bd", self.Bd, has_disturbances, per_disturbance)
        per_output = f"(n_y, {n}): one row per output, one column per state"
        has_outputs = columns == n and n_y > 0
        _check_shape("C", self.C, has_outputs, per_output)
        _check_feedthrough("Du", self.Du, n_y, self.Bu)
        _check_feedthrough("Dd", self.Dd, n_y, self.Bd)
        if self.n_a is None:
            return
        diagonal = _diagonal_E(self.n_a, n)
        if not np.array_equal(self.E, diagonal):
            raise AssumptionError(f"E is not diag(I, 0) with n_a = {self.n_a} (Assumption 1)")

    @classmethod
    def partitioned(
        cls, *, A: ArrayLike, Bu: ArrayLike, Bd: ArrayLike, C: ArrayLike, n_a: int
    ) -> Self:
        """Build the paper's form: `E = diag(I, 0)` with ``n_a`` ones, and no feedthrough."""
        n = len(_finite_matrix("A", A))
        if not 1 <= n_a <= n:
            raise AssumptionError(
                f"n_a: expected 1 to {n}, the number of dynamic states among the {n} rows of A, "
                f"got {n_a} (Assumption 1)"
            )
        of_u = _finite_matrix("Bu", Bu)
        of_delta = _finite_matrix("Bd", Bd)
        of_x = _finite_matrix("C", C)
        Du = _no_feedthrough(of_x, of_u)
        Dd = _no_feedthrough(of_x, of_delta)
        E = _diagonal_E(n_a, n)
        return cls(E=E, A=np.asarray(A), Bu=of_u, Bd=of_delta, C=of_x, Du=Du, Dd=Dd, n_a=n_a)

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
        dynamics = _finite_matrix("A", A)
        of_x = _finite_matrix("C", C)
        n = len(dynamics)
        no_input = np.zeros((n, 0))
        of_u = no_input if Bu is None else _finite_matrix("Bu", Bu)
        of_delta = no_input if Bd is None else _finite_matrix("Bd", Bd)
        identity = np.eye(n)
        left = identity if E is None else np.asarray(E)
        no_Du = _no_feedthrough(of_x, of_u)
        no_Dd = _no_feedthrough(of_x, of_delta)
        u_to_y = no_Du if Du is None else np.asarray(Du)
        delta_to_y = no_Dd if Dd is None else np.asarray(Dd)
        return cls(E=left, A=dynamics, Bu=of_u, Bd=of_delta, C=of_x, Du=u_to_y, Dd=delta_to_y)

    @cached_property
    def scales(self) -> Scales:
        """The sizes of its equations, states, inputs (u, delta) and outputs."""
        B = np.hstack([self.Bu, self.Bd])
        D = np.hstack([self.Du, self.Dd])
        return scales_of(self.E, self.A, B, self.C, D)

    @cached_property
    def _elimination(self) -> ReducedSystem:
        """What :func:`reduce` returns; asked for by several components of one model."""
        return _eliminated(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class UserCoordinates:
    """The user's states ``x = X x_a + Xu u + Xd delta``, and back: ``x_a = R x``.

    Shapes: ``X (n, n_a)``, ``Xu (n, n_u)``, ``Xd (n, n_d)``, ``R (n_a, n)``. Of an index above 1
    x fulfills constraints without inputs, ``H x = 0``, shape ``(k, n)``; else k = 0.
    """

    X: Matrix
    Xu: Matrix
    Xd: Matrix
    R: Matrix
    H: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for name in ("X", "Xu", "Xd", "R", "H"):
            matrix = _finite_matrix(name, getattr(self, name))
            object.__setattr__(self, name, matrix)


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
        x = StateMap("x", coordinates.X, coordinates.Xu, coordinates.Xd)
        return (x,)
    identity = np.eye(len(reduced.A_a))
    of_u = np.zeros_like(reduced.B_1a)
    of_delta = np.zeros_like(reduced.B_2a)
    x_a = StateMap("x_a", identity, of_u, of_delta)
    if not len(reduced.Kx):
        return (x_a,)
    x_b = StateMap("x_b", reduced.Kx, reduced.Ku, reduced.Kd)
    return x_a, x_b


def reduced_scales(reduced: ReducedSystem) -> Scales:
    """Compute coarse sizes of the states x_a, the inputs (u, delta) and the outputs."""
    B = np.hstack([reduced.B_1a, reduced.B_2a])
    D = np.hstack([reduced.C4, reduced.C5])
    scales = state_space_scales(reduced.A_a, B, reduced.C3, D)
    return scales.coarse()


def in_units(reduced: ReducedSystem, scales: Scales) -> ReducedSystem:
    """Return (9)-(10) in other units of x_a, u, delta and y, without the map to the user's."""
    n_u = reduced.B_1a.shape[1]
    n_d = reduced.B_2a.shape[1]
    x = scales.states
    y = scales.outputs
    u = scales.inputs[:n_u]
    delta = scales.inputs[n_u:]
    Kx = np.zeros((0, len(x)))
    Ku = np.zeros((0, n_u))
    Kd = np.zeros((0, n_d))
    A_a = _scaled(reduced.A_a, x, x)
    B_1a = _scaled(reduced.B_1a, x, u)
    B_2a = _scaled(reduced.B_2a, x, delta)
    C3 = _scaled(reduced.C3, y, x)
    C4 = _scaled(reduced.C4, y, u)
    C5 = _scaled(reduced.C5, y, delta)
    return ReducedSystem(
        A_a=A_a,
        B_1a=B_1a,
        B_2a=B_2a,
        C3=C3,
        C4=C4,
        C5=C5,
        Kx=Kx,
        Ku=Ku,
        Kd=Kd,
        accuracy=reduced.accuracy,
    )


def _scaled(matrix: Matrix, rows: Vector, columns: Vector) -> Matrix:
    """Return a matrix in units of what it yields and of what it takes."""
    by_column: Matrix = matrix * columns
    return by_column / rows[:, np.newaxis]


@within_range()
def reduce(system: DescriptorSystem) -> ReducedSystem:
    """Eliminate the algebraic states (8)-(10).

    A feedthrough that is smaller than what rounding of the data may make of zero is zero, so that
    (11) can be decided and feedthrough is structure, not rounding.

    Raises
    ------
    AssumptionError
        If the pencil `s E - A` is singular, or there are no dynamic states, or its index is above 1
        and the form is partitioned or an input acts on a constraint (Assumption 2); or if E or A22
        is so near to a lower rank that rounding decides.
    """
    return system._elimination


def _eliminated(system: DescriptorSystem) -> ReducedSystem:
    scales = system.scales
    E = scales.scaled_E(system.E)
    A = scales.scaled_E(system.A)
    B = scales.scaled_B(np.hstack([system.Bu, system.Bd]))
    n = len(A)
    is_explicit = np.array_equal(system.E, np.eye(n))
    known_rank = n if is_explicit else system.n_a
    decomposition = decompose(E, known_rank)
    if system.n_a is not None:
        check_index(E, A, decomposition)
        reduced = _reduced_partitioned(system, scales, system.n_a)
    elif len(decomposition.values) == n:
        reduced = _reduced_regular(system, scales, decomposition.growth)
    else:
        names = [f"u[{i}]" for i in range(system.Bu.shape[1])]
        names += [f"delta[{i}]" for i in range(system.Bd.shape[1])]
        A, B, decomposition, constraints = of_index_one(E, A, B, decomposition, names)
        reduced = _reduced_singular(system, A, B, scales, decomposition)
        if len(constraints):
            reduced = _constrained(reduced, constraints, scales.states)
    check_accuracy(reduced.accuracy, A, decomposition)
    return reduced


def _constrained(reduced: ReducedSystem, constraints: Matrix, states: Vector) -> ReducedSystem:
    """Return a reduced system with its scaled constraints; what mixing them left of zeros is 0."""
    coordinates = reduced.coordinates
    assert coordinates is not None
    X = np.where(np.abs(coordinates.X) > DATA * states[:, np.newaxis], coordinates.X, 0.0)
    R = np.where(np.abs(coordinates.R) > DATA / states, coordinates.R, 0.0)
    H = np.where(np.abs(constraints) > DATA, constraints, 0.0) / states
    return replace(reduced, coordinates=replace(coordinates, X=X, R=R, H=H))


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
    matrices = PartitionedMatrices(system.A, B, system.C, D, n_a)
    eliminated = eliminate(matrices, scales, 1.0)
    return _reduced(eliminated)


def _reduced_regular(system: DescriptorSystem, scales: Scales, growth: float) -> ReducedSystem:
    """Reduce a system without algebraic states: x_a is x."""
    A = system.A
    Bu = system.Bu
    Bd = system.Bd
    n, n_u = Bu.shape
    identity = np.eye(n)
    if not np.array_equal(system.E, identity):
        E = scales.scaled_E(system.E)
        equations = scales.equations[:, np.newaxis]
        states = scales.states[:, np.newaxis]
        right = np.hstack([A, Bu, Bd])
        solution = np.linalg.solve(E, right / equations)
        rates = solution * states
        A, Bu, Bd = np.split(rates, [n, n + n_u], axis=1)
    D = (system.Du, system.Dd)
    matrices = PartitionedMatrices(A, (Bu, Bd), system.C, D, n)
    eliminated = eliminate(matrices, scales, growth)
    Xu = np.zeros_like(Bu)
    Xd = np.zeros_like(Bd)
    coordinates = UserCoordinates(X=identity, Xu=Xu, Xd=Xd, R=identity, H=np.zeros((0, n)))
    return _reduced(eliminated, coordinates)


def _reduced_singular(
    system: DescriptorSystem,
    scaled_A: Matrix,
    scaled_B: Matrix,
    scales: Scales,
    decomposition: RankDecomposition,
) -> ReducedSystem:
    """Reduce a system with any singular E, in units and coordinates where it is diag(I, 0)."""
    n, n_u = system.Bu.shape
    values = decomposition.values
    n_a = len(values)
    per_value = values[:, np.newaxis]
    dynamic = decomposition.U1.T / per_value
    algebraic = decomposition.U2.T
    left = np.vstack([dynamic, algebraic])
    V = np.hstack([decomposition.V1, decomposition.V2])
    all_D = np.hstack([system.Du, system.Dd])
    scaled_C = scales.scaled_C(system.C)
    A = left @ scaled_A @ V
    B = left @ scaled_B
    C = scaled_C @ V
    D = scales.scaled_D(all_D)
    known = slice(None, n_u)
    unknown = slice(n_u, None)
    of_inputs = (B[:, known], B[:, unknown])
    feedthrough = (D[:, known], D[:, unknown])
    matrices = PartitionedMatrices(A, of_inputs, C, feedthrough, n_a)
    n_y, n_v = D.shape
    of_dynamic = 1.0 / values
    no_unit = np.ones(n - n_a)
    equations = np.concatenate([of_dynamic, no_unit])
    states = np.ones(n)
    inputs = np.ones(n_v)
    outputs = np.ones(n_y)
    units = Scales(equations=equations, states=states, inputs=inputs, outputs=outputs)
    eliminated = eliminate(matrices, units, decomposition.growth)
    return _in_user_units(eliminated, scales, decomposition)


def _in_user_units(
    eliminated: Eliminated, scales: Scales, decomposition: RankDecomposition
) -> ReducedSystem:
    """Return u, delta, y and x to the user's units; x_a stays where the system is of size one."""
    growth = decomposition.growth
    B_1a, B_2a = eliminated.B
    C4, C5 = eliminated.D
    Ku, Kd = eliminated.Kv
    n_u = B_1a.shape[1]
    u = scales.inputs[:n_u]
    delta = scales.inputs[n_u:]
    outputs = scales.outputs[:, np.newaxis]
    B = (B_1a / u, B_2a / delta)
    C = outputs * eliminated.C
    D = (outputs * C4 / u, outputs * C5 / delta)
    Kv = (Ku / u, Kd / delta)
    in_units = replace(eliminated, B=B, C=C, D=D, Kv=Kv)
    coordinates = _user_coordinates(eliminated, scales, decomposition)
    largest = float(decomposition.neglected.max(initial=0.0))
    return _reduced(in_units, coordinates, largest / growth)


def _user_coordinates(
    eliminated: Eliminated, scales: Scales, decomposition: RankDecomposition
) -> UserCoordinates:
    """Return the map to the user's x; what may be rounding of the data is zero."""
    V1 = decomposition.V1
    V2 = decomposition.V2
    of_inputs = []
    for gain, error in zip(eliminated.Kv, eliminated.Kv_error, strict=True):
        sizes = np.abs(gain).sum(axis=0)
        rounding = decomposition.growth * DATA * sizes
        known_up_to = np.abs(V2) @ error + rounding
        of_input = V2 @ gain
        is_known = np.abs(of_input) > known_up_to
        of_inputs.append(np.where(is_known, of_input, 0.0))
    Xu, Xd = of_inputs
    n_u = Xu.shape[1]
    u = scales.inputs[:n_u]
    delta = scales.inputs[n_u:]
    states = scales.states[:, np.newaxis]
    X = V1 + V2 @ eliminated.K
    of_u = states * Xu / u
    of_delta = states * Xd / delta
    R = V1.T / scales.states
    return UserCoordinates(X=states * X, Xu=of_u, Xd=of_delta, R=R, H=np.zeros((0, len(X))))


def _reduced(
    left: Eliminated, coordinates: UserCoordinates | None = None, neglected: float = 0.0
) -> ReducedSystem:
    B_1a, B_2a = left.B
    C4, C5 = left.D
    Ku, Kd = left.Kv
    n_a = len(left.A)
    of_entry = DATA + neglected
    of_sum = n_a * of_entry
    accuracy = of_sum * left.amplification
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
        accuracy=accuracy,
    )


def invariant_zeros(reduced: ReducedSystem) -> ComplexVector:
    """Compute the invariant zeros of (A_a, B_2a, C3, C5), from delta to y, shape ``(k,)`` [1/s].

    They are sorted by their real parts.

    Raises
    ------
    AssumptionError
        If the transfer from delta to y does not have full rank, so that every s is a zero.
    """
    scales = reduced_scales(reduced)
    reduced = in_units(reduced, scales)
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
    of_outputs = np.hstack([C, D])
    outputs = normalized(of_outputs, axis=1)
    no_output = np.zeros((len(C), k))
    states = np.vstack([V, no_output])
    of_inputs = np.vstack([B / rate, outputs[:, n:]])
    inputs = normalized(of_inputs, axis=0)
    basis = np.hstack([states, inputs])
    if rank(basis) < basis.shape[1]:
        raise AssumptionError(
            "the transfer from delta to y does not have full rank, so every s is an invariant zero"
        )
    of_states = np.vstack([A / rate, outputs[:, :n]])
    rates = of_states @ V
    coordinates, *_ = np.linalg.lstsq(basis, rates, rcond=None)
    X = rate * coordinates[:k]
    eigenvalues = np.linalg.eigvals(X)
    zeros = eigenvalues.astype(np.complex128)
    return np.sort_complex(zeros)


def disturbance_transfer(reduced: ReducedSystem, s: complex) -> ComplexMatrix:
    """Compute the transfer matrix from delta to y at ``s`` [1/s].

    It is `C3 (s I - A_a)^-1 B_2a + C5`, shape ``(n_y, n_d)``.
    """
    identity = np.eye(len(reduced.A_a))
    shifted = s * identity - reduced.A_a
    states = np.linalg.solve(shifted, reduced.B_2a)
    transfer = reduced.C3 @ states + reduced.C5
    return np.asarray(transfer, dtype=np.complex128)


def _no_feedthrough(C: Matrix, B: Matrix) -> Matrix:
    """Return a D of zeros, with a row for each row of C and a column for each column of B."""
    return np.zeros((len(C), B.shape[1]))


def _check_feedthrough(name: str, D: Matrix, n_y: int, B: Matrix) -> None:
    m = B.shape[1]
    fits = D.shape == (n_y, m)
    expected = f"({n_y}, {m}): one row per row of C, one column per column of B{name[1]}"
    _check_shape(name, D, fits, expected)


def _finite_matrix(name: str, values: ArrayLike) -> Matrix:
    try:
        matrix = frozen(values, 2)
    except ValueError as error:
        raise AssumptionError(f"{name}: expected a matrix: {error}") from error
    finite = np.isfinite(matrix)
    not_finite = np.argwhere(~finite)
    if len(not_finite):
        row, column = not_finite[0]
        value = matrix[row, column]
        raise AssumptionError(f"{name}[{row}, {column}]: expected a finite number, got {value}")
    return matrix


def _check_shape(name: str, matrix: Matrix, fits: bool, expected: str) -> None:
    if not fits:
        raise AssumptionError(f"{name}: expected shape {expected}; got {matrix.shape}")


def _diagonal_E(n_a: int, n: int) -> Matrix:
    """Return the E of Assumption 1."""
    diagonal = np.zeros(n)
    diagonal[:n_a] = 1.0
    return np.diag(diagonal)
