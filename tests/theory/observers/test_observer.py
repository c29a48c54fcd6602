from fractions import Fraction
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cosim.errors import AssumptionError
from cosim.theory.observers.observer import (
    design,
    identification_start_time,
    initial_state_map,
    realize,
)
from cosim.theory.plants.descriptor import (
    DescriptorSystem,
    ReducedSystem,
    invariant_zeros,
    reduce,
)
from tests.theory.academic import academic, algebraic_state, ordinary

halves = st.integers(-8, 8).map(lambda k: k / 2)


def reduced_system(A, B, C) -> ReducedSystem:
    return reduce(ordinary(A, B, C))


def test_the_observer_is_the_papers(case):
    """(16), the fixed mode and the eigenvalues of the example."""
    expected = case("C01")["expected"]
    tol = case("C01")["tol"]
    reduced = reduce(academic())
    observer = design(reduced, L=case("C01")["system"]["L"], filter_rate=1e3)
    np.testing.assert_allclose(observer.F[:, 0], expected["F"], rtol=0, atol=tol)
    np.testing.assert_allclose(observer.M, expected["M_a"], rtol=0, atol=tol)
    np.testing.assert_allclose(observer.N[:, 0], expected["N"], rtol=0, atol=tol)
    np.testing.assert_allclose(
        observer.fixed_modes, expected["fixed_observer_modes"], rtol=0, atol=tol
    )
    np.testing.assert_allclose(observer.eigenvalues, expected["eig_Ma_minus_LC3"], rtol=0, atol=tol)
    assert (
        len(observer.eigenvalues) - len(observer.fixed_modes)
        == expected["observability_rank_Ma_C3"]
    )
    assert abs(observer.lambda_obs - expected["lambda_obs"]) <= tol


def test_the_papers_gain_follows_from_its_pole():
    """L = (4, 0) is the one gain in the observable direction that gives -4."""
    observer = design(reduce(academic()), poles=[-4], filter_rate=1e3)
    np.testing.assert_allclose(
        observer.L, [[4.0], [0.0]], rtol=0, atol=1e-12
    )  # one division; L0 orthogonal to the fixed mode


def test_the_identification_start_time_is_the_papers(case, subtests):
    """(36)-(38)."""
    for epsilon in ["0.1", "0.01", "0.001", "0.0001"]:
        with subtests.test(epsilon=epsilon):
            times = identification_start_time(
                lambda_obs=2.0,
                filter_rate=1e3,
                delays=(1.0, 2.0, 3.0),
                epsilon_observer=float(epsilon),
                epsilon_filter=float(epsilon),
            )
            assert abs(times.T_id - case("C01")["expected"]["T_id"][epsilon]) <= case("C01")["tol"]
            assert times.T_id == times.T_obs + times.T_f + times.D_max


def test_a_gain_for_one_output_may_be_a_list_or_a_column():
    """Both are the same observer."""
    reduced = reduce(academic())
    as_list = design(reduced, L=[4, 0], filter_rate=1e3)
    as_column = design(reduced, L=[[4], [0]], filter_rate=1e3)
    assert np.array_equal(as_list.L, as_column.L)


def test_a_slow_design_starts_as_much_later():
    """(36)-(38) have no time of their own: all rates over 2^12, all delays times that, so T_id."""
    slower = 2.0**12
    fast = identification_start_time(
        lambda_obs=2.0,
        filter_rate=1e3,
        delays=(1.0,),
        epsilon_observer=0.1,
        epsilon_filter=0.2,
    )
    slow = identification_start_time(
        lambda_obs=2.0 / slower,
        filter_rate=1e3 / slower,
        delays=(slower,),
        epsilon_observer=0.1,
        epsilon_filter=0.2,
    )
    assert slow.T_id == slower * fast.T_id


def test_the_realization_is_the_papers(case):
    """(29)-(30) written out by hand: z' , delta_hat and x_b_hat of the example."""
    reduced = reduce(academic())
    system = realize(reduced, design(reduced, L=[4, 0], filter_rate=1e3))
    z1 = 0.3
    z2 = -0.7
    q = 0.2
    u = 0.9
    y = -1.1
    x1 = z1 + y + u
    x2 = z2
    w = y + u
    states = np.array([z1, z2, q])
    inputs = np.array([u, y])
    rates = [-4 * x1 + 4 * w, -x1 - 2 * x2 + u, 1e3 * (w - q)]
    delta = 1e3 * (w - q) + x1 - x2 + u
    outputs = [x1, x2, delta, -x1 - u, z1, z2, q]
    # values up to 1e3 from a handful of operations: 1e3 * 2e-16 * 10
    np.testing.assert_allclose(system.A @ states + system.B @ inputs, rates, rtol=0, atol=2e-12)
    np.testing.assert_allclose(system.C @ states + system.D @ inputs, outputs, rtol=0, atol=2e-12)


def test_the_initial_state_is_the_papers(case):
    """x_hat_a(0) = 0 gives z(0) = (-1, 0), and q(0) = 0 stays."""
    system = case("C01")["system"]
    reduced = reduce(academic())
    observer = design(reduced, L=[4, 0], filter_rate=1e3)
    X0, Xw = initial_state_map(reduced, observer, x_a0=system["xhat_a0"], q0=[0.0])
    np.testing.assert_array_equal(X0 + Xw @ [0.0, 1.0], [*system["z0"], 0.0])


def test_the_default_initial_state_is_consistent_with_the_output():
    """C3 x_hat_a(0) = y(0) - C4 u(0) = q(0): w' is 0 and delta_hat has no filter transient."""
    reduced = reduce(academic())
    observer = design(reduced, L=[4, 0], filter_rate=1e3)
    X0, Xw = initial_state_map(reduced, observer)
    u = 0.9
    y = -1.1
    state = X0 + Xw @ [u, y]
    system = realize(reduced, observer)
    outputs = system.C @ state + system.D @ [u, y]
    np.testing.assert_allclose(reduced.C3 @ outputs[:2], y + u, rtol=0, atol=1e-15)
    np.testing.assert_allclose(state[2], y + u, rtol=0, atol=1e-15)
    # filter_rate * rounding of w - q
    np.testing.assert_allclose(outputs[2], (y + u) + u, rtol=0, atol=1e3 * 1e-15)


@given(
    arrays(np.float64, (4, 4), elements=halves),
    arrays(np.float64, (4, 2), elements=halves),
    arrays(np.float64, (3, 4), elements=halves),
)
def test_the_observer_never_sees_the_disturbance(A, B, C):
    """(I - F C3) B_2a = 0: whatever delta does, the error obeys e' = (M - L C3) e."""
    values = np.linalg.svd(C @ B, compute_uv=False)
    assume(values[-1] > 1e-2 * max(values[0], 1.0))
    shifted = A - 40.0 * np.eye(
        4
    )  # makes most of the zeros stable, so that L = 0 will do; the rest is refused
    try:
        observer = design(reduced_system(shifted, B, C), L=np.zeros((4, 3)), filter_rate=1.0)
    except AssumptionError as error:
        if "not Hurwitz" not in str(error):
            raise
        return
    reduced = reduced_system(shifted, B, C)
    # condition of C B below 1e2 by assumption, entries up to 50
    np.testing.assert_allclose(B - observer.F @ C @ B, 0.0, atol=1e-10)
    np.testing.assert_allclose(observer.M, shifted - observer.F @ C @ shifted, rtol=0, atol=1e-9)
    np.testing.assert_allclose(observer.G @ C @ B, np.eye(2), rtol=0, atol=1e-10)
    assert len(observer.fixed_modes) == len(invariant_zeros(reduced))


@cache
def realized():
    """Return the reduced example and the realization of its observer."""
    reduced = reduce(academic())
    return reduced, realize(reduced, design(reduced, L=[4, 0], filter_rate=10.0))


@given(st.lists(halves, min_size=4, max_size=4), st.floats(-2, 2), st.floats(-2, 2))
def test_the_steady_state_is_exact(x_a, u, delta):
    """At rest, with true states and w' = 0, the realization has the outputs x_a, delta and x_b."""
    reduced, system = realized()
    x = -np.linalg.solve(reduced.A_a, reduced.B_1a @ [u] + reduced.B_2a @ [delta])
    y = reduced.C3 @ x + reduced.C4 @ [u]
    inputs = np.array([u, y[0]])
    rest = -np.linalg.solve(system.A, system.B @ inputs)
    expected = np.concatenate(
        [x, [delta], algebraic_state(reduced, x, u=np.array([u]), delta=np.array([delta]))]
    )
    # filter_rate times rounding of values up to 4
    np.testing.assert_allclose(
        (system.C @ rest + system.D @ inputs)[:4], expected, rtol=0, atol=1e-12
    )


def system_of_three_outputs() -> DescriptorSystem:
    """Three outputs, one disturbance, two inputs, one algebraic state."""
    A = np.array(
        [[-1.0, 1, 0, 0, 1], [0, -2, 1, 0, 0], [0, 1, -3, 1, 0], [1, 0, 0, -1, 0], [1, 1, 0, 0, -2]]
    )
    Bu = np.array([[1.0, 0], [0, 1], [0, 0], [1, 0], [0, 1]])
    C = np.array([[1.0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [1, 0, 1, 0, 0]])
    return DescriptorSystem.partitioned(
        A=A, Bu=Bu, Bd=np.array([[1.0], [0], [0], [0], [0]]), C=C, n_a=4
    )


def test_several_inputs_and_outputs_converge_to_the_truth():
    """Driven by (u, y) of an exact trajectory x(t) = X exp(s t), the realization follows it.

    It gives x_a, x_b and the filtered delta.
    """
    reduced = reduce(system_of_three_outputs())
    poles = [-1.0, -2.0, -3.0 + 1.0j, -3.0 - 1.0j]
    observer = design(reduced, poles=poles, filter_rate=50.0)
    # a simple placement of four poles: eigenvalues accurate to condition (about 1e3) times 1e-16
    np.testing.assert_allclose(observer.eigenvalues, np.sort_complex(poles), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(observer.M - observer.L @ reduced.C3)),
        np.sort_complex(poles),
        rtol=0,
        atol=1e-9,
    )
    assert observer.fixed_modes.size == 0
    system = realize(reduced, observer)
    s = 0.4
    u = np.array([1.0, -0.5])
    delta = np.array([0.7])
    x = np.linalg.solve(s * np.eye(4) - reduced.A_a, reduced.B_1a @ u + reduced.B_2a @ delta)
    w = reduced.C3 @ x
    inputs = np.concatenate([u, w + reduced.C4 @ u])
    state = np.linalg.solve(s * np.eye(7) - system.A, system.B @ inputs)
    outputs = system.C @ state + system.D @ inputs
    # the filter (19) turns s w into s w filter_rate / (s + filter_rate)
    delta_hat = delta - observer.G @ (s * w) * (1 - 50.0 / 50.4)
    x_b_hat = algebraic_state(reduced, x, u=u, delta=delta_hat)
    np.testing.assert_allclose(
        outputs[:6], np.concatenate([x, delta_hat, x_b_hat]), rtol=0, atol=1e-11
    )


def test_poles_may_repeat_with_one_independent_output():
    """Ackermann's formula has no limit on multiplicity.

    A double pole is accurate to sqrt(rounding) only.
    """
    reduced = reduced_system([[0.0, 1], [-2, -3]], np.zeros((2, 0)), [[1.0, 0], [2, 0]])
    observer = design(reduced, poles=[-5, -5], filter_rate=1.0)
    np.testing.assert_allclose(
        np.poly(observer.M - observer.L @ reduced.C3), [1, 10, 25], rtol=1e-12
    )
    pair = design(reduced, poles=[-1 + 2j, -1 - 2j], filter_rate=1.0)
    np.testing.assert_allclose(np.poly(pair.M - pair.L @ reduced.C3), [1, 2, 5], rtol=1e-12)


def test_matrices_of_the_design_are_frozen():
    """A design is data."""
    with pytest.raises(ValueError, match="read-only"):
        design(reduce(academic()), L=[4, 0], filter_rate=1.0).L[0, 0] = 1.0


INTEGRATORS = ([[0.0, 1], [0, -1]], [[0.0], [1]], [[1.0, 0]])
ZERO_AT_ONE = ([[0.0, 1], [-2, -3]], [[0.0], [1]], [[-1.0, 1]])


def test_a_design_that_cannot_work_is_refused(subtests):
    """Each verdict has its evidence."""
    for reduced, options, message in [
        (
            INTEGRATORS,
            {"L": [1, 0]},
            r"not decoupled \(Assumption 5\): 0 of 1 disturbance.*"
            r"RELATIVE_DEGREE.*"
            r"C A\^0 B = \[\[0\.0\]\] of rank 0, C A\^1 B = \[\[1\.0\]\] of rank 1; "
            r"measure an output",
        ),
        (
            ([[-1.0, 0], [0, -2]], np.eye(2), [[1.0, 1]]),
            {"L": [1, 0]},
            r"2 outputs for 2 disturbances, got 1 \(FEWER_OUTPUTS_THAN_DISTURBANCES\)",
        ),
        (
            ([[-1.0, 0], [0, -2]], [[1.0, 2], [1, 2]], np.eye(2)),
            {"L": np.eye(2)},
            r"2 disturbances act in 1 .*DEPENDENT_DISTURBANCES",
        ),
        (
            ZERO_AT_ONE,
            {"L": [1, 0]},
            r"M - L C is not Hurwitz: eigenvalue \+1; the invariant zero at \+1 cannot be moved by "
            r"L \(NOT_DETECTABLE\)",
        ),
        (ZERO_AT_ONE, {"poles": [-1]}, r"NOT_DETECTABLE"),
        (
            None,
            {"L": [0, 0]},
            r"M - L C is not Hurwitz: eigenvalue \+0; another L moves it: 1 eigenvalue\(s\) can be "
            r"placed, fixed: -2$",
        ),
        (None, {"L": [-4, 0]}, r"M - L C is not Hurwitz: eigenvalue \+4; another L moves it"),
        (None, {"poles": [-4, -5]}, r"expected 1 poles, as many as L can place, got 2; fixed: -2"),
        (None, {"poles": []}, r"expected 1 poles, .* got 0"),
        (None, {"poles": [1]}, r"negative real parts, got \+1"),
        (None, {"poles": [-1 + 1j]}, r"poles -1\+1j; complex poles come in conjugate pairs"),
        (None, {}, r"L or poles, got neither"),
        (None, {"L": [4, 0], "poles": [-4]}, r"L or poles, got both"),
        (None, {"L": [4, 0, 0]}, r"L: expected shape \(2, 1\), .* got \(3, 1\)"),
        (None, {"L": [4, np.nan]}, r"L: expected finite numbers, got .*nan"),
        (
            None,
            {"L": [4, 0], "filter_rate": 0.0},
            r"filter_rate: .* got 0",
        ),
        (
            ([[-1.0, 0, 0], [1, -2, 0], [0, 1, -3]], np.zeros((3, 0)), [[0.0, 0, 1], [1, 0, 0]]),
            {"poles": [-1, -1, -1]},
            r"at most 2 times, .* got -1 3 times",
        ),
    ]:
        with subtests.test(message=message), pytest.raises(AssumptionError, match=message):
            design(
                reduce(academic()) if reduced is None else reduced_system(*reduced),
                **({"filter_rate": 1e3} | options),
            )


def exact(matrix):
    """Return a matrix of fractions that is what the doubles are, without rounding."""
    return np.vectorize(Fraction, otypes=[object])(np.asarray(matrix, np.float64))


def exact_decoupled(A, B, C):
    """Return M (16) in exact arithmetic, for one disturbance."""
    CB = exact(C) @ exact(B)
    G = CB.T / (CB.T @ CB)[0, 0]
    return exact(A) - exact(B) @ G @ exact(C) @ exact(A)


def large_states(size, rng):
    """Return A, B, C with a large A that L C has to cancel."""
    A = np.round(size * rng.normal(size=(2, 2)), 1)
    B = np.round(rng.normal(size=(2, 1)), 2)
    return A, B, np.round(rng.normal(size=(2, 2)), 2)


def large_in_the_direction_of_the_disturbance(size, rng):
    """Return A, B, C with a large A of which the decoupling leaves little: M is of order one."""
    B = np.round(rng.normal(size=(2, 1)), 2)
    A = B @ np.round(size * rng.normal(size=(1, 2)), 1) + np.round(rng.normal(size=(2, 2)), 2)
    return A, B, np.round(rng.normal(size=(2, 2)), 2)


def nearly_equal_outputs(size, rng):
    """Return A, B, C with rows of C so alike that L is large, and cancels in L C."""
    A = np.round(rng.normal(size=(2, 2)), 2)
    B = np.round(rng.normal(size=(2, 1)), 2)
    row = np.round(rng.normal(size=2), 2)
    return A, B, np.array([row, row + rng.normal(size=2) / size])


def with_a_movable_mode_at(rate, size, rng, make):
    """Return A, B, C and L with ``M - L C`` of about [-1 1; 0 rate].

    Also whether it is Hurwitz in exact arithmetic.
    """
    A, B, C = make(size, rng)
    M = exact_decoupled(A, B, C)
    goal = np.array([[-1.0, 1.0], [0.0, rate]])
    L = np.linalg.solve(C.T, (M.astype(np.float64) - goal).T).T
    closed = M - exact(L) @ exact(C)
    determinant = closed[0, 0] * closed[1, 1] - closed[0, 1] * closed[1, 0]
    return (A, B, C), L, closed.trace() < 0 < determinant


def one_output(size, rng):
    """Return A, B, C with one output and a large A in the direction of the disturbance."""
    A, B, C = large_in_the_direction_of_the_disturbance(size, rng)
    return A, B, C[:1]


def nearly_unseen_disturbance(size, rng):
    """Return A, B, C with one output that sees little of the disturbance: F is large, C A small."""
    C = np.round(rng.normal(size=(1, 2)), 2)
    B = np.array([[-C[0, 1]], [C[0, 0]]]) + rng.normal(size=(2, 1)) / size
    A = B @ np.round(rng.normal(size=(1, 2)), 2) + rng.normal(size=(2, 2)) / size
    return A, B, C


def with_a_fixed_mode_at(rate, size, rng, make):
    """Return A, B, C and L with one output and a fixed mode of about ``rate``.

    Also whether it is stable in exact arithmetic: C M = 0, so it is the trace of M.
    """
    A, B, C = make(size, rng)
    unseen = np.array([[-C[0, 1]], [C[0, 0]]])  # C unseen = 0: the decoupling leaves it
    shift = rate - float(exact_decoupled(A, B, C).trace())
    A = A + shift / (unseen.T @ unseen) * unseen @ unseen.T
    return (A, B, C), C.T, exact_decoupled(A, B, C).trace() < 0


MOVABLE = "M - L C is not Hurwitz: .*; another L moves it"
FIXED = "M - L C is not Hurwitz: .*NOT_DETECTABLE"


@pytest.mark.fast(
    "made0-M - L C is not Hurwitz: .*; another L moves it",
    "made3-M - L C is not Hurwitz: .*NOT_DETECTABLE",
)
@pytest.mark.parametrize(
    ("made", "verdict"),
    [
        (partial(with_a_movable_mode_at, make=large_states), MOVABLE),
        (
            partial(with_a_movable_mode_at, make=large_in_the_direction_of_the_disturbance),
            MOVABLE,
        ),
        (partial(with_a_movable_mode_at, make=nearly_equal_outputs), MOVABLE),
        (partial(with_a_fixed_mode_at, make=one_output), FIXED),
        (partial(with_a_fixed_mode_at, make=nearly_unseen_disturbance), FIXED),
    ],
)
def test_modes_stable_by_rounding_alone_are_refused(made, verdict):
    """The terms of M - L C cancel: what is left of a mode at 0 is their rounding, not its own.

    Beyond that, 100 eps times a few times their size, it is not refused.
    """
    size = 1e4
    unstable = 0
    for seed in range(40):
        matrices, L, is_stable = made(0.0, size, np.random.default_rng(seed))
        if not is_stable:
            unstable += 1
            with pytest.raises(AssumptionError, match=verdict):
                design(reduced_system(*matrices), L=L, filter_rate=1e3)
        matrices, L, is_stable = made(-1e-9 * size, size, np.random.default_rng(seed))
        assert is_stable
        design(reduced_system(*matrices), L=L, filter_rate=1e3)
    assert unstable > 10


def test_a_fixed_mode_at_zero_beside_fast_ones_is_refused():
    """Its rounding is that of the fast ones: exactly singular in whole numbers."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        left = rng.integers(1, 100, 2)
        right = -rng.integers(1, 100, 2)
        A = np.zeros((3, 3))
        A[:2, :2] = np.outer(left, right)  # its eigenvalues: 0 and right left < 0
        system = reduced_system(A, [[0.0], [0.0], [1.0]], [[0.0, 0.0, 1.0]])
        with pytest.raises(AssumptionError, match=FIXED):
            design(system, L=[0.0, 0.0, 1.0], filter_rate=1e3)


def test_an_inaccurate_placement_is_refused():
    """Thirty integrators in a chain, poles a thousand times faster: the message shows the poles."""
    n = 30
    reduced = reduced_system(np.diag(np.ones(n - 1), 1), np.zeros((n, 0)), np.eye(1, n) + 1e-3)
    with pytest.raises(
        AssumptionError,
        match=r"cannot be placed accurately, got .*; choose poles further apart or closer to",
    ):
        design(reduced, poles=list(-1e3 - np.arange(n)), filter_rate=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x_a0": [0.0]}, r"x_a0: .* \(2,\), got \(1,\)"),
        ({"q0": [0.0, 1.0]}, r"q0: .* \(1,\), got \(2,\)"),
        ({"x_a0": [0.0, np.inf]}, r"x_a0: .* got \[0\.0, inf\]"),
    ],
)
def test_an_initial_value_that_does_not_fit_is_refused(options, message):
    """Sizes and finiteness of given initial values."""
    reduced = reduce(academic())
    with pytest.raises(AssumptionError, match=message):
        initial_state_map(reduced, design(reduced, L=[4, 0], filter_rate=1.0), **options)


def test_a_start_time_that_does_not_exist_is_refused(subtests):
    """(36)-(38) need positive rates, fractions and a delay."""
    for change, message in [
        ({"lambda_obs": 0.0}, r"lambda_obs: .* got 0"),
        ({"filter_rate": np.inf}, r"filter_rate: .* got inf"),
        ({"epsilon_observer": 1.0}, r"epsilon_observer: .* got 1"),
        ({"epsilon_filter": 0.0}, r"epsilon_filter: .* got 0"),
        ({"delays": ()}, r"delays: .* got none"),
    ]:
        with subtests.test(message=message):
            options = {
                "lambda_obs": 2.0,
                "filter_rate": 1e3,
                "delays": (1.0,),
                "epsilon_observer": 0.1,
                "epsilon_filter": 0.1,
            }
            with pytest.raises(AssumptionError, match=message):
                identification_start_time(**(options | change))
