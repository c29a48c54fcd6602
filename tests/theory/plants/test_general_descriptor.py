"""Descriptor systems with any square E, against the pencil s E - A itself."""

import itertools
import re

import mpmath
import numpy as np
import pytest

from cosim.blocks.plant import descriptor_model
from cosim.errors import AssumptionError
from cosim.theory.plants.descriptor import (
    DescriptorSystem,
    pencil_index,
    reduce,
)
from cosim.theory.plants.index import LEAST_ACCURACY
from tests.theory.academic import academic
from tests.theory.scrambled import Matrices, index_one, mixing

POINTS = (0.3 + 1.1j, 2.0j, -0.7 + 0.2j)


def sizes(rng):
    """Return n up to 12, and n_a of it."""
    n = int(rng.integers(2, 13))
    return {"n": n, "n_a": int(rng.integers(1, n + 1))}


def in_any_units(seed):
    """Return a scrambled system, every second one in other units, and its number of states."""
    rng = np.random.default_rng(seed)
    size = sizes(rng)
    matrices = index_one(rng, **size).scrambled(rng)
    return (matrices.in_other_units(rng) if seed % 2 else matrices), size["n_a"]


def check_reduction(seed):
    """Check eigenvalues, transfer functions and the user's states against the pencil."""
    matrices, n_a = in_any_units(seed)
    reduced = reduce(matrices.system)
    assert reduced.A_a.shape == (n_a, n_a)
    assert not reduced.C5.any()
    B = np.hstack([reduced.B_1a, reduced.B_2a])
    D = np.hstack([reduced.C4, reduced.C5])
    coordinates = reduced.coordinates
    for s in POINTS:
        x_a = np.linalg.solve(s * np.eye(n_a) - reduced.A_a, B)
        expected = matrices.transfer(s)
        # each entry relative to the terms that it is made of
        terms = np.abs(matrices.C) @ np.abs(matrices.states_at(s)) + np.abs(D)
        assert (np.abs(reduced.C3 @ x_a + D - expected) <= 1e-10 * terms).all()
        x = coordinates.X @ x_a + np.hstack([coordinates.Xu, coordinates.Xd])
        states = matrices.states_at(s)
        rows = np.abs(states).max(axis=0)
        if seed % 2 == 0:
            assert (np.abs(x - states) <= 1e-10 * rows).all()
            assert np.abs(coordinates.R @ states - x_a).max() <= 1e-10 * np.abs(x_a).max()
    if seed % 2 == 0:
        eigenvalues = np.sort_complex(np.linalg.eigvals(reduced.A_a))
        found = np.poly(eigenvalues)
        size = np.abs(eigenvalues).max() ** np.arange(n_a + 1)
        expected = np.poly(matrices.finite_eigenvalues(n_a))
        assert (np.abs(found - expected) <= 1e-10 * 2.0**n_a * size).all()


def test_a_scrambled_system_has_the_eigenvalues_and_transfers_of_its_pencil(subtests):
    """Any E of index 1, in units up to 1e6 apart: y, x and eigenvalues are those of s E - A.

    Mixing has condition 10 on either side, so the data have it 100: 1e-10 is 1e4 roundings.
    """
    for seed in range(40):
        with subtests.test(seed=seed):
            check_reduction(seed)


@pytest.mark.campaign
def test_scrambled_systems_at_length():
    """The same for 2000 systems."""
    for seed in range(100, 2100):
        check_reduction(seed)


def test_a_direct_path_is_told_from_what_a_coordinate_change_leaves(subtests):
    """C5 = 0 stays 0 to the last bit in any coordinates and units; 1e-9 of size 1 stays there."""
    for seed in range(20):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            n_a = int(rng.integers(1, 6))
            plain = index_one(rng, n=n_a + 3, n_a=n_a)
            direct = np.array([[1e-9], [0.0]])
            small = Matrices(plain.E, plain.A, plain.Bu, plain.Bd, plain.C, plain.Du, direct)
            for matrices, expected in ((plain, np.zeros((2, 1))), (small, direct)):
                found = reduce(matrices.scrambled(rng).system).C5
                np.testing.assert_allclose(found, expected, rtol=1e-3, atol=0.0)
            found = reduce(plain.scrambled(rng).in_other_units(rng).system)
            assert not found.C5.any()


def test_rounding_in_the_data_of_the_partitioned_form_is_no_direct_path():
    """C5 = 1.8e-16 of a disturbance of size 1: what a coordinate change leaves in B22."""
    A = np.array([[-1.0, 0.5], [1.0, -2.0]])
    for left, expected in ((3.6e-16, 0.0), (2e-9, 1e-9)):
        Bd = np.array([[1.0], [left]])
        C = np.array([[1.0, 1.0]])
        system = DescriptorSystem.partitioned(A=A, Bu=np.zeros((2, 0)), Bd=Bd, C=C, n_a=1)
        C5 = float(reduce(system).C5[0, 0])
        np.testing.assert_allclose(C5, expected, rtol=1e-6, atol=0.0)


def test_the_partitioned_form_and_the_general_one_are_the_same_system():
    """E = diag(I, 0) as E: x is (x_a, x_b), and y, x answer alike."""
    paper = academic()
    partitioned = reduce(paper)
    general = reduce(
        DescriptorSystem.general(E=paper.E, A=paper.A, Bu=paper.Bu, Bd=paper.Bd, C=paper.C)
    )
    X = np.vstack([np.eye(2), partitioned.Kx])
    T = general.coordinates.R @ X  # x_a of the one in terms of the other
    inverse = np.linalg.inv(T)
    np.testing.assert_allclose(inverse @ general.A_a @ T, partitioned.A_a, rtol=0, atol=1e-14)
    np.testing.assert_allclose(general.C3 @ T, partitioned.C3, rtol=0, atol=1e-14)
    np.testing.assert_allclose(general.coordinates.X @ T, X, rtol=0, atol=1e-14)
    np.testing.assert_allclose(general.coordinates.Xu[2:], partitioned.Ku, rtol=0, atol=1e-14)
    assert partitioned.coordinates is None
    assert not general.C5.any()
    np.testing.assert_array_equal(general.C4, partitioned.C4)


def test_a_regular_E_keeps_the_states():
    """x_a is x, bit for bit with E = I; else x' = E^-1 A x + ..."""
    A = np.array([[0.1, 1.0], [-2.0, -0.3]])
    B = np.array([[0.0], [1.0]])
    plain = reduce(DescriptorSystem.general(A=A, Bd=B, C=np.eye(2)))
    np.testing.assert_array_equal(plain.A_a, A)
    np.testing.assert_array_equal(plain.coordinates.X, np.eye(2))
    E = np.array([[2.0, 1.0], [0.0, 4.0]])
    mass = reduce(DescriptorSystem.general(E=E, A=A, Bd=B, C=np.eye(2)))
    np.testing.assert_allclose(E @ mass.A_a, A, rtol=0, atol=1e-15)
    np.testing.assert_allclose(E @ mass.B_2a, B, rtol=0, atol=1e-15)


def test_units_of_inputs_and_outputs_do_not_touch_the_pencil(subtests):
    """E and A have ranks of their own: B and C only scale what follows."""
    for size in [1e-100, 1e-12, 1e12, 1e100]:
        with subtests.test(size=size):
            matrices = {"E": np.diag([1.0, 0.0]), "A": [[-1.0, 1.0], [1.0, 1.0]]}
            B = np.array([[1.0], [2.0]])
            C = np.array([[1.0, 3.0]])
            plain = reduce(DescriptorSystem.general(**matrices, Bd=B, C=C))
            scaled = reduce(DescriptorSystem.general(**matrices, Bd=size * B, C=C / size**2))
            # powers of ten are rounded: one rounding for each
            np.testing.assert_allclose(scaled.B_2a, size * plain.B_2a, rtol=1e-15)
            np.testing.assert_allclose(scaled.C5, plain.C5 / size, rtol=1e-15)


def kronecker(rng, *, chains, n_a, singular):
    """Return E and A of chains of algebraic integrators beside dynamics, mixed, and these."""
    blocks_E = [np.eye(n_a)]
    blocks_A = [rng.normal(size=(n_a, n_a))]
    for length in chains:
        blocks_E.append(np.diag(np.ones(length - 1), 1))
        blocks_A.append(np.eye(length))
    if singular:  # one equation less for k + 1 states, one more for k
        k = int(rng.integers(0, 3))
        wide_E = np.eye(k, k + 1)
        wide_A = np.eye(k, k + 1, 1)
        blocks_E += [wide_E, wide_E.T]
        blocks_A += [wide_A, wide_A.T]
    rows = sum(len(block) for block in blocks_E)
    E = np.zeros((rows, rows))
    A = np.zeros((rows, rows))
    row = 0
    column = 0
    for of_E, of_A in zip(blocks_E, blocks_A, strict=True):
        m, n = of_E.shape
        E[row : row + m, column : column + n] = of_E
        A[row : row + m, column : column + n] = of_A
        row += m
        column += n
    P = mixing(rows, rng)
    Q = mixing(rows, rng)
    return P @ E @ Q, P @ A @ Q, blocks_A[0]


def test_the_index_is_found_in_any_coordinates(subtests):
    """The longest chain of the Weierstrass form is the index; without inputs, any is reduced.

    What is left has the eigenvalues of the dynamics beside the chains.
    """
    for seed in range(30):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            chains = [int(k) for k in rng.integers(1, 5, size=int(rng.integers(1, 4)))]
            singular = seed % 3 == 0
            E, A, dynamics = kronecker(
                rng, chains=chains, n_a=int(rng.integers(1, 5)), singular=singular
            )
            system = DescriptorSystem.general(E=E, A=A, C=np.ones((1, len(A))))
            if singular:
                verdict = (
                    r"PENCIL_SINGULAR: .*reciprocal condition at 5 points: at most .*one is missing"
                )
                for refusing in (pencil_index, reduce):
                    with pytest.raises(AssumptionError, match=verdict):
                        refusing(system)
            else:
                assert pencil_index(system) == max(chains)
                eigenvalues = np.sort_complex(np.linalg.eigvals(reduce(system).A_a))
                expected = np.sort_complex(np.linalg.eigvals(dynamics))
                np.testing.assert_allclose(eigenvalues, expected, rtol=0.0, atol=1e-8)


def joined_masses(B, *, x1_x2=(1.0, -1.0)):
    """Return masses of 2 kg (on a spring of 10 N/m) and 3 kg whose positions are constrained.

    The states are both positions, both velocities, and the force of the constraint.
    """
    A = np.zeros((5, 5))
    A[0, 2] = A[1, 3] = 1.0
    A[2, 0] = -10.0
    A[2:4, 4] = x1_x2
    A[4, :2] = x1_x2
    E = np.diag([1.0, 1.0, 2.0, 3.0, 0.0])
    return DescriptorSystem.general(E=E, A=A, Bu=np.reshape(B, (5, 1)), C=np.eye(5))


def test_a_rigid_constraint_is_differentiated():
    """Index 3: two masses become one of 5 kg, and the force is what accelerates the second."""
    reduced = reduce(joined_masses([0, 0, 1, 0, 0]))
    omega = np.sqrt(10.0 / 5.0)
    np.testing.assert_allclose(np.linalg.eigvals(reduced.A_a).real, 0.0, atol=1e-14)
    np.testing.assert_allclose(abs(np.linalg.eigvals(reduced.A_a).imag), omega, rtol=1e-14)
    for s in (0.3, 1.0 + 2.0j):
        x = reduced.C3 @ np.linalg.solve(s * np.eye(2) - reduced.A_a, reduced.B_1a) + reduced.C4
        position = 1.0 / (5.0 * s**2 + 10.0)
        force = -3.0 * s**2 * position
        expected = [position, position, s * position, s * position, force]
        np.testing.assert_allclose(x[:, 0], expected, rtol=1e-13)


def test_any_index_has_the_transfers_of_its_pencil(subtests):
    """Random masses with random constraints, mixed: y is C (s E - A)^-1 B of the file."""
    for seed in range(10):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            n, k = int(rng.integers(2, 5)), 1 + seed % 2
            G = rng.normal(size=(k, n))
            E = np.diag(np.concatenate([np.ones(n), rng.uniform(0.5, 2.0, n), np.zeros(k)]))
            A = np.zeros(E.shape)
            A[:n, n : 2 * n] = np.eye(n)
            A[n : 2 * n, : 2 * n] = rng.normal(size=(n, 2 * n))
            A[n : 2 * n, 2 * n :] = G.T
            A[2 * n :, :n] = G
            B = np.zeros((len(E), 2))
            B[n : 2 * n] = rng.normal(size=(n, 2))
            P, Q = mixing(len(E), rng), mixing(len(E), rng)
            E, A, B = P @ E @ Q, P @ A @ Q, P @ B
            C = rng.normal(size=(2, len(E)))
            reduced = reduce(DescriptorSystem.general(E=E, A=A, Bu=B[:, :1], Bd=B[:, 1:], C=C))
            assert len(reduced.A_a) == 2 * (n - k)
            for s in (0.7, -0.4 + 1.3j):
                states = np.linalg.solve(s * np.eye(2 * (n - k)) - reduced.A_a, reduced.B_2a)
                expected = C @ np.linalg.solve(s * E - A, B[:, 1:])
                np.testing.assert_allclose(
                    reduced.C3 @ states + reduced.C5, expected, rtol=1e-8, atol=1e-10
                )


def test_dense_constraints_without_inputs_are_differentiated(subtests):
    """The rows of the constraints are exact, their columns in any coordinates: index 3 and 4."""
    for index, seed in itertools.product((3, 4), range(4)):
        with subtests.test(index=index, seed=seed):
            rng = np.random.default_rng(seed)
            n = 2 + index
            dynamic = rng.normal(size=(2, 2)) - np.eye(2)
            E = np.diag(np.ones(n - 1), 1)
            E[:2] = np.eye(2, n)
            A = np.eye(n)
            A[:2, :2] = dynamic
            B = np.zeros((n, 1))
            B[:2] = rng.normal(size=(2, 1))
            states = rng.normal(size=(n, n))
            columns = np.linalg.inv(states)[:, :2]
            C = np.eye(n)
            reduced = reduce(DescriptorSystem.general(E=E @ states, A=A @ states, Bu=B, C=C))
            for s in POINTS:
                x_a = np.linalg.solve(s * np.eye(2) - reduced.A_a, reduced.B_1a)
                expected = columns @ np.linalg.solve(s * np.eye(2) - dynamic, B[:2])
                error = np.abs(reduced.C3 @ x_a + reduced.C4 - expected)
                assert error.max() <= 1e-10 * np.abs(expected).max()
            B[-1] = 1e-9
            with pytest.raises(AssumptionError, match=f"rows {n - 1} of E"):
                reduce(DescriptorSystem.general(E=E @ states, A=A @ states, Bu=B, C=C))


def test_a_constraint_with_an_input_is_refused_by_its_row():
    """Its derivative would be needed, which no signal has."""
    message = r"rows 4 of E and A.*derivative of u\[0\].*INDEX_3"
    with pytest.raises(AssumptionError, match=message) as caught:
        reduce(joined_masses([0, 0, 1, 0, 1e-6]))
    assert "A22" not in f"{caught.value}{caught.value.cure}"


def test_initial_states_have_to_fulfill_constraints():
    """The hidden one too, between velocities; the force of the constraint follows from them."""
    system = joined_masses([0, 0, 1, 0, 0], x1_x2=(1.0, -2.0))
    coordinates = reduce(system).coordinates
    x0 = [0.2, 0.1, 0.4, 0.2, 0.0]
    descriptor_model(system, x0)
    consistent = coordinates.X @ (coordinates.R @ x0)
    np.testing.assert_allclose(consistent[:4], x0[:4], atol=1e-15)
    # x1'' = 2 x2'' : (-10 * 0.2 + force) / 2 = 2 (-2 force) / 3
    np.testing.assert_allclose(consistent[4], 1.0 / (0.5 + 4.0 / 3.0), rtol=1e-14)
    for wrong in ([0.2, 0.2, 0.4, 0.2, 0.0], [0.2, 0.1, 0.4, 0.3, 0.0]):
        with pytest.raises(AssumptionError, match=r"x0: .* constraints .*x\["):
            descriptor_model(system, wrong)


# --- E, or A22, between two ranks ---


def near_a_lower_rank(seed, *, E=0.0, A22=0.0, spread=0.0):
    """Return a random system in mixed coordinates: E or A22 have a small singular value.

    The equations are of sizes that differ by so many decades before they are mixed.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 9))
    n_a = int(rng.integers(1, n - 1))
    plain_E = np.diag(np.repeat([1.0, 0.0], [n_a, n - n_a]))
    plain_E[n_a, n_a] = E
    A = rng.normal(size=(n, n))
    if A22:
        left, values, right = np.linalg.svd(A[n_a:, n_a:])
        values[-1] = A22
        A[n_a:, n_a:] = left * values @ right
    P = np.linalg.qr(rng.normal(size=(n, n)))[0]
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    B = rng.normal(size=(n, 1))
    P = P * 10.0 ** rng.uniform(-spread / 2.0, spread / 2.0, n)
    return DescriptorSystem.general(E=P @ plain_E @ Q, A=P @ A @ Q, Bu=B, C=np.eye(n))


def exactly(matrix):
    return mpmath.matrix(matrix.tolist())


def error_of_states(system, reduced, s):
    """Return how far x of u = exp(s t) is from that of the pencil, in 40 digits, relative."""
    with mpmath.workdps(40):
        pencil = mpmath.mpc(s) * exactly(system.E) - exactly(system.A)
        expected = mpmath.lu_solve(pencil, exactly(system.Bu))
        n_a = len(reduced.A_a)
        rates = mpmath.mpc(s) * mpmath.eye(n_a) - exactly(reduced.A_a)
        x_a = mpmath.lu_solve(rates, exactly(reduced.B_1a))
        x = exactly(reduced.coordinates.X) * x_a + exactly(reduced.coordinates.Xu)
        largest = max(abs(value) for value in expected)
        return float(max(abs(value) for value in x - expected) / largest)


def check_border(seed, small):
    """Check that what is accepted is as good as it says; return the verdict on the rest."""
    system = near_a_lower_rank(seed, **small)
    try:
        reduced = reduce(system)
    except AssumptionError as error:
        return error.verdict
    assert reduced.accuracy <= LEAST_ACCURACY
    for s in (0.5j, 2.0 + 1.0j):
        assert error_of_states(system, reduced, s) <= reduced.accuracy
    assert bool(reduced.inaccuracy) is (reduced.accuracy > 1e-6)
    return ""


# verdicts that a small value may have, from those of a clear rank to those of the lower one
BORDERS = [
    ({"E": 1e-6}, {""}),
    ({"E": 1e-8}, {""}),
    ({"E": 1e-11}, {"", "RANK_OF_E_UNCLEAR"}),
    ({"E": 1e-12}, {"RANK_OF_E_UNCLEAR"}),
    ({"E": 1e-13}, {"", "RANK_OF_E_UNCLEAR"}),
    ({"E": 1e-16}, {""}),
    ({"A22": 1e-6}, {""}),
    ({"A22": 1e-8}, {""}),
    ({"A22": 1e-11}, {"", "INDEX_UNCLEAR"}),
    ({"A22": 1e-12}, {"INDEX_UNCLEAR", "INDEX_2"}),
    ({"A22": 1e-15}, {"INDEX_2"}),
    ({}, {""}),
]


@pytest.mark.slow
def test_a_reduction_near_a_lower_rank_is_as_accurate_as_it_says(subtests):
    """Nothing is accepted and more wrong than its accuracy; nothing well conditioned is refused.

    What is refused is refused for what is near to a lower rank, E or A22.
    """
    for small, verdicts in BORDERS:
        with subtests.test(small=small):
            assert {check_border(seed, small) for seed in range(6)} <= verdicts


def test_differences_of_large_terms_have_the_errors_of_the_terms(subtests):
    """Of x_b and its large gains little may be left in a reduced system, which is no more exact.

    At 54 A22 has no inverse at all, though its equations are independent.
    """
    for seed, A22 in [(20, 1e-6), (75, 1e-6), (81, 1e-8), (54, 1e-13)]:
        with subtests.test(seed=seed):
            assert check_border(seed, {"A22": A22, "spread": 6.0}) == "INDEX_UNCLEAR"


@pytest.mark.campaign
def test_borders_at_length():
    """The same for 12 x 150 systems."""
    for small, verdicts in BORDERS:
        assert {check_border(seed, small) for seed in range(100, 250)} <= verdicts


def test_an_unclear_rank_is_said_with_the_singular_values_and_the_gap():
    """It is not A22 that is to blame, and what can be done about it is said."""
    system = near_a_lower_rank(0, E=1e-12)
    with pytest.raises(AssumptionError) as caught:
        reduce(system)
    text = str(caught.value)
    values = np.linalg.svd(system.E, compute_uv=False)
    rank = int((values > 1e-13).sum())
    assert (
        f"the rank of E is not clear (Assumption 1): {rank} of its {len(values)} singular values"
        in text
    )
    assert re.search(r"the last of them \S+e-1[123] of the first, the next value \S+e-1[67]", text)
    assert "A22" not in text
    assert "give E exactly" in caught.value.cure
    assert reduce(near_a_lower_rank(0)).inaccuracy == ""


def test_a_general_system_that_does_not_fit_is_refused(subtests):
    """The message names the matrix, or what the system lacks."""
    for change, message in [
        ({"E": np.zeros((2, 2))}, r"E = 0 \(2 x 2\): there are no dynamic states"),
        (
            {"E": [[0.0, 1.0], [0.0, 0.0]], "A": np.eye(2)},
            r"INDEX_2: .*no finite eigenvalue: no dynamics at all",
        ),
        ({"E": np.eye(3)}, r"E: .* \(2, 2\), the shape of A; got \(3, 3\)"),
        ({"E": [[1.0, np.nan], [0.0, 0.0]]}, r"E\[0, 1\]: .* got nan"),
        ({"Du": [[1.0, 2.0]]}, r"Du: .* \(1, 1\): .* got \(1, 2\)"),
        (
            {"E": np.diag([1.0, 0.0]), "Bu": [[0.0], [1e200]], "C": [[0.0, 1e200]]},
            r"the matrices have numbers too large or too small to compute with \(overflow",
        ),
        ({"Dd": [[1.0]]}, r"Dd: .* \(1, 0\).* got \(1, 1\)"),
    ]:
        with subtests.test(message=message):
            matrices = {"A": [[-1.0, 1.0], [1.0, 1.0]], "Bu": [[1.0], [0.0]], "C": [[1.0, 0.0]]}
            with pytest.raises(AssumptionError, match=message):
                reduce(DescriptorSystem.general(**(matrices | change)))


def test_another_E_than_the_partition_says_is_refused():
    """n_a stands for diag(I, 0), and for nothing else."""
    paper = academic()
    matrices = {name: getattr(paper, name) for name in ("A", "Bu", "Bd", "C", "Du", "Dd")}
    message = re.escape("E is not diag(I, 0) with n_a = 2")
    with pytest.raises(AssumptionError, match=message):
        DescriptorSystem(E=np.eye(3), n_a=2, **matrices)
