import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cosim.errors import AssumptionError
from cosim.theory.plants.descriptor import (
    DescriptorSystem,
    ReducedSystem,
    disturbance_transfer,
    invariant_zeros,
    pencil_index,
    reduce,
)
from tests.theory.academic import academic, algebraic_state, ordinary

# Small integers (and halves) are exact in float64 and their solves have condition below 1e4 here,
# so 1e-12 is 1e4 roundings.
TOLERANCE = 1e-12


def test_the_reduction_is_the_papers(case):
    """(8)-(12) give the matrices of (28)."""
    expected = case("C01")["expected"]
    reduced = reduce(academic())
    for name in ("A_a", "B_1a", "B_2a", "C3", "C4", "C5"):
        computed = getattr(reduced, name)
        np.testing.assert_allclose(
            computed, np.reshape(expected[name], computed.shape), rtol=0, atol=case("C01")["tol"]
        )


def test_the_structure_is_the_papers(case):
    """Eigenvalues, invariant zero, index and transfer of the example."""
    expected = case("C01")["expected"]
    reduced = reduce(academic())
    tol = case("C01")["tol"]
    eigenvalues = np.sort_complex(np.array([complex(*pair) for pair in expected["eig_A_a"]]))
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(reduced.A_a)), eigenvalues, rtol=0, atol=tol
    )
    np.testing.assert_allclose(
        invariant_zeros(reduced), expected["invariant_zeros"], rtol=0, atol=tol
    )
    assert pencil_index(academic()) == expected["pencil_index"]
    assert abs(disturbance_transfer(reduced, 1j)[0, 0] - complex(*expected["G_d_at_1j"])) <= tol


def test_the_initial_state_is_consistent(case):
    """x_b(0) of (27) follows from x_a(0) and u(0) by (8)."""
    system = case("C01")["system"]
    x_b = algebraic_state(
        reduce(academic()),
        np.array(system["x_a0"], dtype=float),
        u=np.zeros(1),
        delta=np.array([2.65]),
    )
    np.testing.assert_allclose(x_b, [system["x_b0"]], rtol=0, atol=TOLERANCE)


halves = st.integers(-8, 8).map(lambda k: k / 2)


@given(
    arrays(np.float64, (5, 5), elements=halves),
    arrays(np.float64, (5, 3), elements=halves),
    arrays(np.float64, (2, 5), elements=halves),
)
def test_the_reduced_system_satisfies_the_descriptor_equations(A, B, C):
    """With x_b from (8) the algebraic rows vanish, and (9), (10) are the other rows."""
    A[3:, 3:] = np.eye(2) * 20.0 + A[3:, 3:]  # diagonally dominant: regular
    system = DescriptorSystem.partitioned(A=A, Bu=B[:, :2], Bd=B[:, 2:], C=C, n_a=3)
    reduced = reduce(system)
    x_a = np.array([1.0, -2.0, 0.5])
    u = np.array([0.25, 3.0])
    delta = np.array([-1.5])
    x = np.concatenate([x_a, algebraic_state(reduced, x_a, u=u, delta=delta)])
    full = system.A @ x + system.Bu @ u + system.Bd @ delta
    # sums of 8 products of at most 24 * 10
    np.testing.assert_allclose(full[3:], 0.0, atol=1e-11)
    np.testing.assert_allclose(
        reduced.A_a @ x_a + reduced.B_1a @ u + reduced.B_2a @ delta, full[:3], rtol=0, atol=1e-11
    )
    np.testing.assert_allclose(
        reduced.C3 @ x_a + reduced.C4 @ u + reduced.C5 @ delta, C @ x, rtol=0, atol=1e-11
    )


def test_rounding_in_C5_is_zero_and_a_real_C5_is_kept():
    """C2 A22^-1 B22 = 0 in exact arithmetic gives C5 = 0; a small value beyond rounding stays."""

    def C5(b):
        A = np.block(
            [[-np.eye(1), np.zeros((1, 2))], [np.zeros((2, 1)), np.array([[0.3, 0.1], [0.7, 0.9]])]]
        )
        x_b = np.array([0.1, 0.3])  # C2 x_b = 0.3 * 0.1 - 0.1 * 0.3, not exactly 0 after a solve
        Bd = np.concatenate([[1.0], A[1:, 1:] @ x_b])[:, None]
        return reduce(
            DescriptorSystem.partitioned(
                A=A, Bu=np.zeros((3, 0)), Bd=Bd, C=np.array([[1.0, 0.3 + b, -0.1]]), n_a=1
            )
        ).C5

    assert C5(0.0) == 0.0
    assert C5(1e-9) == pytest.approx(-1e-10, rel=1e-5)


def test_zeros_of_tall_and_wide_systems():
    """A zero stays one with a proportional second output; the transposed system has the same."""
    A = np.array([[0.0, 1, 0], [0, 0, 1], [-6, -11, -6]])
    B = np.array([[0.0], [0], [1]])
    C = np.array([[3.0, 1, 0]])
    tall = reduce(ordinary(A, B, np.vstack([C, 2 * C])))
    wide = reduce(ordinary(A.T, np.vstack([C, 2 * C]).T, B.T))
    # (s + 3) / ((s + 1)(s + 2)(s + 3)); simple zero, condition of the basis below 1e2
    np.testing.assert_allclose(invariant_zeros(tall), [-3.0], rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(invariant_zeros(wide), [-3.0], rtol=0, atol=TOLERANCE)


def test_zeros_do_not_exist_without_full_rank():
    """Two disturbances through one column: every s is a zero."""
    reduced = reduce(ordinary([[-1.0, 0], [0, -2]], [[1, 2], [0, 0]], [[1, 0], [0, 1]]))
    with pytest.raises(
        AssumptionError, match=r"does not have full rank, so every s is an invariant zero"
    ):
        invariant_zeros(reduced)


def test_the_index_is_counted():
    """0 without algebraic states, 1 with regular A22, 2 and 3 for inverted integrator chains."""
    assert pencil_index(ordinary([[-1.0]], [[1]], [[1]])) == 0
    assert pencil_index(academic()) == 1
    for index, A in ((2, [[0.0, 1], [1, 0]]), (3, [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])):
        n = len(A)
        system = DescriptorSystem.partitioned(
            A=np.array(A), Bu=np.ones((n, 1)), Bd=np.ones((n, 1)), C=np.ones((1, n)), n_a=index - 1
        )
        assert pencil_index(system) == index


def test_a_singular_A22_is_refused_with_its_evidence():
    """Assumption 2: the message has rank and index, and the form that may have this index."""
    system = DescriptorSystem.partitioned(
        A=np.array([[0.0, 1], [1, 0]]),
        Bu=np.ones((2, 1)),
        Bd=np.ones((2, 1)),
        C=np.ones((1, 2)),
        n_a=1,
    )
    with pytest.raises(
        AssumptionError,
        match=r"\(0 of 1; Assumption 2\).*A\[1:, 1:\] is singular.* INDEX_2: .* index 1, "
        r"got index 2.*with E in place of n_a",
    ):
        reduce(system)


def test_a_singular_pencil_is_refused():
    """det(s E - A) = 0 at every s: the verdict names it."""
    system = DescriptorSystem.partitioned(
        A=np.array([[1.0, 0], [0, 0]]),
        Bu=np.ones((2, 1)),
        Bd=np.ones((2, 1)),
        C=np.ones((1, 2)),
        n_a=1,
    )
    with pytest.raises(
        AssumptionError,
        match=r"\(0 of 1; Assumption 2\); PENCIL_SINGULAR: det\(s E - A\) = 0 at every s",
    ):
        reduce(system)


def test_matrices_that_do_not_fit_are_refused(subtests):
    """The message names the matrix, the shape found and the shape needed."""
    for change, message in [
        ({"A": np.ones((2, 3))}, r"A: .* \(n, n\).* got \(2, 3\)"),
        ({"Bu": np.ones((2, 1))}, r"Bu: .* \(3, n_u\).* got \(2, 1\)"),
        ({"Bd": np.ones((4, 1))}, r"Bd: .* \(3, n_d\).* got \(4, 1\)"),
        ({"C": np.ones((1, 2))}, r"C: .* \(n_y, 3\).* got \(1, 2\)"),
        ({"C": np.ones((0, 3))}, r"C: .* \(n_y, 3\).* got \(0, 3\)"),
        (
            {"Bd": np.ones(3)},
            r"Bd: expected a matrix: .*\(3,\)",
        ),
        ({"C": np.array([[1.0, np.nan, 0]])}, r"C\[0, 1\]: .* got nan"),
        ({"A": np.diag([1.0, 1, np.inf])}, r"A\[2, 2\]: .* got inf"),
        ({"n_a": 0}, r"n_a: expected 1 to 3, .* got 0"),
        ({"n_a": 4}, r"n_a: expected 1 to 3, .* got 4"),
    ]:
        with subtests.test(message=message):
            system = {
                "A": np.eye(3),
                "Bu": np.ones((3, 1)),
                "Bd": np.ones((3, 1)),
                "C": np.ones((1, 3)),
                "n_a": 2,
            }
            with pytest.raises(AssumptionError, match=message):
                DescriptorSystem.partitioned(**(system | change))


def test_matrices_are_frozen():
    """Systems are data: no one can change a matrix after it was checked."""
    assert isinstance(reduce(academic()), ReducedSystem)
    for matrix in (academic().A, reduce(academic()).A_a):
        with pytest.raises(ValueError, match="read-only"):
            matrix[0, 0] = 1.0
