"""Observers of disturbances that reach the output directly (C5), all of them or some."""

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import linear_sum_assignment

from cosim.errors import AssumptionError
from cosim.theory.observers.observer import delta_rows, design, realize, realize_averages
from cosim.theory.plants.descriptor import (
    DescriptorSystem,
    ReducedSystem,
    invariant_zeros,
    reduce,
)
from tests.theory.scrambled import Matrices, mixing, movable

RATE = 50.0


def transmission_zeros(A, B, C, D):
    """Return the finite zeros of a square system: eigenvalues of its Rosenbrock pencil."""
    n = len(A)
    m = B.shape[1]
    pencil = np.block([[A, B], [C, D]])
    E = np.zeros((n + m, n + m))
    E[:n, :n] = np.eye(n)
    values = scipy.linalg.eigvals(pencil, E)
    count = n - (m - np.linalg.matrix_rank(D))
    return values[np.argsort(np.abs(values))][:count]


def square_system(rng):
    """Return A, B, C, D with stable zeros, and these: n to 12, D of any rank, C B regular enough.

    A shift of A is one of the zeros.
    """
    n = int(rng.integers(2, 13))
    m = int(rng.integers(1, min(n, 4) + 1))
    r = int(rng.integers(0, m + 1))
    A = rng.normal(size=(n, n))
    B = rng.normal(size=(n, m))
    C = mixing(m, rng) @ np.linalg.qr(B)[0].T + 0.1 * rng.normal(size=(m, n))
    D = rng.normal(size=(m, r)) @ rng.normal(size=(r, m))
    zeros = transmission_zeros(A, B, C, D)
    shift = zeros.real.max(initial=0.0) + 0.5
    return (A - shift * np.eye(n), B, C, D), zeros - shift


def reduced_system(A, B, C, D) -> ReducedSystem:
    """Return a system with all inputs unknown."""
    return reduce(DescriptorSystem.general(A=A, Bd=B, C=C, Dd=D))


def check_fixed_modes(seed):
    """Check the fixed modes of an observer against the zeros, one to one."""
    matrices, zeros = square_system(np.random.default_rng(seed))
    reduced = reduced_system(*matrices)
    n = len(matrices[0])
    movable = n - len(zeros)
    observer = design(reduced, poles=list(-1.0 - np.arange(movable)))
    assert len(observer.fixed_modes) == len(zeros)
    distances = np.abs(np.subtract.outer(observer.fixed_modes, zeros))
    found, expected = linear_sum_assignment(distances)
    size = np.maximum(1.0, np.abs(zeros[expected]))
    assert (distances[found, expected] <= 1e-8 * size).all(), seed


def test_fixed_modes_are_the_invariant_zeros():
    """What no gain moves are the zeros of the Rosenbrock pencil, whatever the rank of D."""
    for seed in range(60):
        check_fixed_modes(seed)


def test_invariant_zeros_do_not_rest_on_units():
    """Zeros are rates: units of states, inputs and outputs up to 1e6 either way leave them."""
    for seed in range(30):
        rng = np.random.default_rng(seed)
        (A, B, C, D), zeros = square_system(rng)
        n = len(A)
        nothing = np.zeros((n, 0))
        matrices = Matrices(np.eye(n), A, nothing, B, C, np.zeros((len(C), 0)), D)
        reduced = reduce(matrices.in_other_units(rng).system)
        found = invariant_zeros(reduced)
        distances = np.abs(np.subtract.outer(found, zeros))
        rows, columns = linear_sum_assignment(distances)
        assert len(found) == len(zeros)
        assert (distances[rows, columns] <= 1e-8 * np.maximum(1.0, np.abs(zeros[columns]))).all()


def test_invariant_zeros_are_found_in_skewed_coordinates():
    """Those of A - B D^-1 C, where D is regular; T = I + v w' with w'v = 0 leaves them as they are.

    There A and B are far larger than D. A is rounded to eps |A|, which moves a zero by that times
    the condition of T.
    """
    D = np.array([[1.0, 0.5], [-0.3, 1.0]])
    v = 100.0 * np.array([[1.0], [2.0], [-1.0], [1.0]])
    w = np.array([[1.0, -1.0, 0.0, 1.0]])
    T = np.eye(4) + v @ w
    inverse = np.eye(4) - v @ w
    for seed in range(4):
        rng = np.random.default_rng(seed)
        A = rng.normal(size=(4, 4))
        B = rng.normal(size=(4, 2))
        C = rng.normal(size=(2, 4))
        zeros = np.linalg.eigvals(A - B @ np.linalg.solve(D, C))
        skewed = T @ A @ inverse
        found = invariant_zeros(reduced_system(skewed, T @ B, C @ inverse, D))
        condition = np.linalg.norm(T, 2) * np.linalg.norm(inverse, 2)
        tolerance = 10.0 * np.finfo(float).eps * np.linalg.norm(skewed, 2) * condition
        assert tolerance < 1e-2
        np.testing.assert_allclose(found, np.sort_complex(zeros), rtol=0, atol=tolerance)


@pytest.mark.campaign
def test_fixed_modes_are_the_invariant_zeros_at_length():
    """The same for 1000 systems."""
    for seed in range(1000, 2000):
        check_fixed_modes(seed)


def mixed(rng, rank):
    """Return a scrambled system of 3 disturbances, ``rank`` of them direct, and 4 outputs."""
    n = 7
    n_a = 5
    A = rng.normal(size=(n, n)) - 6.0 * np.eye(n)
    Dd = np.zeros((4, 3))
    Dd[:, :rank] = rng.normal(size=(4, rank))
    mixed_delta = mixing(3, rng)
    Bd = rng.normal(size=(n, 3))
    Bd[n_a:] = 0.0
    return Matrices(
        E=np.diag(np.repeat([1.0, 0.0], [n_a, n - n_a])),
        A=A,
        Bu=rng.normal(size=(n, 1)),
        Bd=Bd @ mixed_delta,
        C=rng.normal(size=(4, n)),
        Du=rng.normal(size=(4, 1)),
        Dd=Dd @ mixed_delta,
    ).scrambled(rng)


@pytest.mark.parametrize("rank", range(4))
@pytest.mark.parametrize("units", [False, True])
def test_the_observer_gives_the_users_states_and_all_of_delta(rank, units):
    """Driven by an exact trajectory exp(s t): x exactly; of delta what is direct exactly.

    What follows from a derivative is short of it by G s w (1 - F(s)), F of the filter (19). The
    averages have no filter: rate + s level is delta itself.
    """
    s = 0.4
    for seed in range(5):
        rng = np.random.default_rng(seed)
        matrices = mixed(rng, rank)
        if units:
            matrices = matrices.in_other_units(rng)
        reduced = reduce(matrices.system)
        size = np.abs(reduced.C3).max(axis=1)
        observer = design(reduced, poles=-2.0 - np.arange(movable(reduced)), filter_rate=RATE)
        delta = rng.normal(size=3) / np.abs(reduced.B_2a).max(axis=0)
        u = rng.normal(size=1) / np.abs(reduced.B_1a).max(axis=0)
        x = matrices.states_at(s) @ np.concatenate([u, delta])
        y = matrices.C @ x + matrices.Du @ u + matrices.Dd @ delta
        inputs = np.concatenate([u, y])
        system = realize(reduced, observer)
        outputs = answer(system, inputs, s)
        w = y - reduced.C4 @ u
        expected = delta - observer.G @ (s * w) * (1.0 - RATE / (RATE + s))
        found = outputs[delta_rows(reduced)]
        terms = np.abs(observer.G) @ np.abs(w) * RATE + np.abs(observer.direct) @ np.abs(w)
        assert (np.abs(found - expected) <= 1e-9 * (terms + np.abs(delta))).all(), size
        dynamic = np.abs(reduced.coordinates.X) @ np.abs(reduced.coordinates.R @ x)
        of_delta = np.abs(reduced.coordinates.Xd) @ (np.abs(delta) + terms)
        if not reduced.coordinates.Xd.any():
            assert (np.abs(outputs[: len(x)] - x) <= 1e-9 * (dynamic + of_delta)).all()
        averages = realize_averages(reduced, observer)
        rows = answer(averages.system, inputs, s)
        width = averages.width
        rate, level = rows[-2 * width : -width], rows[-width:]
        found = (rate + s * level)[:3]
        assert (np.abs(found - delta) <= 1e-9 * (terms + np.abs(delta))).all()


def answer(system, inputs, s):
    """Return the outputs of a system whose inputs are exp(s t)."""
    states = np.linalg.solve(s * np.eye(len(system.A)) - system.A, system.B @ inputs)
    return system.C @ states + system.D @ inputs


def test_a_disturbance_on_the_output_alone_needs_no_derivative():
    """An unknown sensor offset beside a clean output: G = 0, delta is y1 - x by C5."""
    A = np.array([[-1.0, 0.0], [1.0, -2.0]])
    Bd = np.zeros((2, 1))
    C = np.eye(2)
    system = DescriptorSystem.general(A=A, Bu=[[1.0], [0.0]], Bd=Bd, C=C, Dd=[[2.0], [0.0]])
    observer = design(reduce(system), poles=[-5.0, -6.0], filter_rate=1.0)
    assert not observer.G.any()
    np.testing.assert_allclose(observer.direct, [[0.5, 0.0]], rtol=0, atol=1e-16)
    given = design(reduce(system), L=[[7.0, 0.0], [3.0, 9.0]], filter_rate=1.0)
    np.testing.assert_array_equal(given.L, [[0.0, 0.0], [0.0, 9.0]])  # y1 says delta, no more


def test_a_direct_path_of_1e_9_is_used_and_one_of_rounding_is_not():
    """The same plant, delta on y by 1e-9 and by 1.8e-16: solved directly, or by the derivative."""
    A = [[-1.0, 0.3], [0.2, -2.0]]
    for Dd, is_direct in ((1e-9, True), (1.8e-16, False)):
        system = DescriptorSystem.general(A=A, Bd=[[1.0], [0.0]], C=[[1.0, 0.0]], Dd=[[Dd]])
        reduced = reduce(system)
        if is_direct:  # its zero is at -1 - 1e9
            observer = design(reduced, poles=[])
            np.testing.assert_allclose(observer.direct, [[1e9]], rtol=1e-6)
        else:
            observer = design(reduced, poles=[-3.0])
            np.testing.assert_allclose(observer.G, [[1.0]], rtol=1e-15)


DOUBLE = ([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def test_verdicts_hold_beside_a_direct_path(subtests):
    """Each with its evidence: ranks, powers, the zero."""
    for Bd, Dd, message in [
        (
            [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
            [[0.0, 0.0], [0.0, 1.0]],
            r"1 of 2 disturbances reach y directly, and 0 "
            r"of the other 1 .*RELATIVE_DEGREE\): "
            r"C A\^0 B = .* of rank 0, C A\^1 B = .* of rank 1; measure an output",
        ),
        (
            [[1.0, 2.0], [0.0, 0.0], [0.0, 0.0]],
            [[0.5, 1.0], [0.0, 0.0]],
            r"2 disturbances act in 1 .*: .*DEPENDENT_DISTURBANCES",
        ),
        (
            [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]],
            [[0.0, 0.0], [0.0, 0.0]],
            r"2 disturbances act in 1 .*: delta\[1\] acts on no state and no output",
        ),
        (
            np.eye(3),
            [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
            r"at least 3 outputs for 3 disturbances, got 2 .*FEWER_OUTPUTS",
        ),
        (
            [[-3.0], [0.0], [0.0]],
            [[1.0], [0.0]],
            r"the invariant zero at \+3 cannot be moved by L \(NOT_DETECTABLE\)",
        ),
    ]:
        with subtests.test(message=message):
            A, C = DOUBLE
            if "NOT_DETECTABLE" in message:  # (s - 3)/s: delta of exp(3 t) is blocked
                A = [[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
            system = DescriptorSystem.general(A=A, Bd=Bd, C=C, Dd=Dd)
            with pytest.raises(AssumptionError, match=message):
                design(reduce(system), poles=[-1.0])
