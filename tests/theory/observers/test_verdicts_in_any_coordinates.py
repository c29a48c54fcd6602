"""The named verdicts on systems whose form is hidden by coordinates, equations and units."""

import numpy as np
import pytest

from cosim.errors import AssumptionError
from cosim.theory.observers.observer import design, initial_state_map
from cosim.theory.plants.descriptor import reduce
from tests.theory.scrambled import Matrices, movable

N_B = 2  # algebraic states


def with_algebraic_states(rng, A, B, C, D) -> Matrices:
    """Return x' = A x + B delta, y = C x + D delta with states x_b = K x that act on x and y.

    What they add is taken out of A and C, so that this is the same system.
    """
    n, n_d = B.shape
    K = rng.normal(size=(N_B, n))
    A12 = rng.normal(size=(n, N_B))
    C2 = rng.normal(size=(len(C), N_B))
    A22 = rng.normal(size=(N_B, N_B)) + 3.0 * np.eye(N_B)
    no_B = np.zeros((N_B, n_d))
    return Matrices(
        E=np.diag(np.repeat([1.0, 0.0], [n, N_B])),
        A=np.block([[A - A12 @ K, A12], [-A22 @ K, A22]]),
        Bu=rng.normal(size=(n + N_B, 1)),
        Bd=np.vstack([B, no_B]),
        C=np.hstack([C - C2 @ K, C2]),
        Du=rng.normal(size=(len(C), 1)),
        Dd=np.asarray(D, np.float64),
    )


def stable(rng, n):
    """Return a random matrix whose eigenvalues are in the left half plane."""
    A = rng.normal(size=(n, n))
    return A - (np.linalg.eigvals(A).real.max() + 1.0) * np.eye(n)


def fewer_outputs(rng):
    return stable(rng, 4), rng.normal(size=(4, 2)), rng.normal(size=(1, 4)), np.zeros((1, 2))


def dependent(rng):
    B = rng.normal(size=(4, 1)) @ rng.normal(size=(1, 2))
    return stable(rng, 4), B, rng.normal(size=(3, 4)), np.zeros((3, 2))


def relative_degree(rng):
    """C B = 0, C A B is not."""
    B = rng.normal(size=(4, 1))
    C = rng.normal(size=(2, 4))
    return stable(rng, 4), B, C - C @ B @ B.T / (B.T @ B), np.zeros((2, 1))


def relative_degree_of_the_rest(rng):
    """One disturbance is direct, and the other one not seen by C B."""
    A, _, C, _ = relative_degree(rng)
    D = np.outer(rng.normal(size=2), [1.0, 0.0])
    U = np.linalg.svd(D)[0]
    second = U[:, 1] @ C  # the output that the first does not reach
    other = rng.normal(size=(4, 1))
    other -= np.outer(second, second @ other) / (second @ second)
    return A, np.hstack([rng.normal(size=(4, 1)), other]), C, D


def with_a_zero_at(zero):
    """Return zeros there, at -5 and -6, over a polynomial with roots -1 to -4."""
    roots = np.array([-1.0, -2.0, -3.0, -4.0])
    residues = np.array([(r - zero) / np.prod(r - roots[roots != r]) for r in roots])
    residues *= (roots + 5.0) * (roots + 6.0)
    return np.diag(roots), np.ones((4, 1)), residues[np.newaxis], np.zeros((1, 1))


def not_detectable(rng):
    return with_a_zero_at(1.0)


def at_the_border(rng):
    """Return a zero at 0, wherever rounding leaves it: there, or on either side."""
    return with_a_zero_at(0.0)


def not_detectable_directly(rng):
    """y = C x + delta with A - B C unstable: a zero at +1."""
    A = np.diag([-1.0, -2.0])
    C = np.array([[-2.0, 0.0]])
    return A, np.array([[1.0], [1.0]]), C, np.ones((1, 1))


VERDICTS = {
    fewer_outputs: "FEWER_OUTPUTS_THAN_DISTURBANCES",
    dependent: "DEPENDENT_DISTURBANCES",
    relative_degree: r"decoupled .*: 0 of .*RELATIVE_DEG.*: C A\^0 B .* of rank 0, .* of rank 1; m",
    relative_degree_of_the_rest: r"1 of 2 disturb.*, and 0 of the other 1 .*RELATIVE_DEG",
    not_detectable: r"the invariant zero at \+1(\.0*\d*)? cannot be moved .*NOT_DETECTABLE",
    at_the_border: r"the invariant zero at (\S*e-\S*|[+-]0) cannot be moved .*\(NOT_DETECTABLE\)",
    not_detectable_directly: r"the invariant zero at \+1(\.0*\d*)? cannot .*NOT_DETECTABLE",
}


@pytest.mark.parametrize("make", VERDICTS, ids=lambda make: make.__name__)
def test_a_verdict_is_the_same_in_any_coordinates_and_units(make):
    """Ranks and zeros belong to the system, not to how it is written."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        matrices = with_algebraic_states(rng, *make(rng)).scrambled(rng)
        if seed % 2:
            matrices = matrices.in_other_units(rng)
        reduced = reduce(matrices.system)
        with pytest.raises(AssumptionError, match=VERDICTS[make]):
            design(reduced, L=np.zeros(reduced.C3.T.shape))


def test_a_system_without_a_fault_gets_its_observer():
    """As many outputs as disturbances or more, direct or not, stable zeros: no verdict."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rank = seed % 3
        A = stable(rng, 4) - 3.0 * np.eye(4)
        B = rng.normal(size=(4, 2))
        C = np.vstack([B.T, rng.normal(size=(1, 4))])
        D = rng.normal(size=(3, rank)) @ rng.normal(size=(rank, 2))
        matrices = with_algebraic_states(rng, A, B, C, D).scrambled(rng)
        if seed % 2:
            matrices = matrices.in_other_units(rng)
        reduced = reduce(matrices.system)
        observer = design(reduced, poles=list(-1.0 - np.arange(movable(reduced))))
        assert (observer.eigenvalues.real < 0.0).all()


def test_an_output_that_follows_from_others_does_no_harm_to_the_start():
    """C3 x_hat(0) = w(0) with rows of C that depend on each other but for rounding."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        A = stable(rng, 4) - 3.0 * np.eye(4)
        B = rng.normal(size=(4, 1))
        C = np.vstack([B.T, rng.normal(size=(1, 4))])
        C = np.vstack([C, C[0] + 0.3 * C[1]])
        matrices = with_algebraic_states(rng, A, B, C, np.zeros((3, 1))).scrambled(rng)
        reduced = reduce(matrices.system)
        observer = design(reduced, poles=list(-1.0 - np.arange(movable(reduced))), filter_rate=1.0)
        _, Xw = initial_state_map(reduced, observer)
        w = reduced.C3 @ rng.normal(size=4)
        z = Xw[:4, 1:] @ w
        x_hat = z + observer.F @ w
        # mixing of condition 10, and outputs of which the smallest singular value is about 0.1
        np.testing.assert_allclose(reduced.C3 @ x_hat, w, rtol=0, atol=1e-9 * np.abs(w).max())
