import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cosim.errors import AssumptionError
from cosim.native.estimation.regression import LeastSquares, LeastSquaresConstants
from cosim.theory.disturbances.families import (
    DampedSine,
    Exponential,
    Polynomial,
    Sine,
    TExponential,
    coefficients,
    group_by_alpha,
)
from cosim.theory.disturbances.regression import eta, expand, mu
from cosim.theory.estimators.least_squares import (
    RecoveryKind,
    least_squares,
    plan,
    recover,
    recovery_constants,
    trapezoid_weights,
)
from tests.theory.academic import DELAYS, THETA, delayed


def gauss(a, b, pieces):
    """Return times and weights of Gauss-Legendre's rule with 10 points on each piece of [a, b]."""
    x, w = np.polynomial.legendre.leggauss(10)
    edges = np.linspace(a, b, pieces + 1)
    begin = edges[:-1, None]
    half_width = np.diff(edges)[:, None] / 2.0
    times = begin + half_width * (x + 1.0)
    weights = half_width * w
    return times.ravel(), weights.ravel()


def recovery(alphas, families, delays):
    groups = group_by_alpha(alphas, families)
    terms = expand(tuple(group.size for group in groups))
    return terms, groups, plan(terms, groups, delays)


def exact_eta(terms, groups, thetas, delays):
    return eta(
        terms,
        [
            coefficients(group.families, [thetas[i] for i in group.components], delays)
            for group in groups
        ],
    )


def test_the_papers_formula_is_reproduced_to_the_last_bit(case):
    """(35): theta_1 = ln(eta_3) / (D_1 - D_3), theta_2 = ln(eta_6) / (D_2 - D_3)."""
    _, _, planned = recovery(["a", "b"], [Exponential()] * 2, DELAYS)
    assert [group.terms for group in planned.groups] == [(2, 0), (5, 0)]
    assert [group.signs for group in planned.groups] == [(-1, 1), (-1, 1)]
    eta_2_to_6 = np.array(case("C03")["expected"]["eta_2_to_6"])
    computed = recover(planned, eta_2_to_6)
    assert computed[0] == math.log(eta_2_to_6[1]) / (1.0 - 3.0)
    assert computed[1] == math.log(eta_2_to_6[4]) / (2.0 - 3.0)
    np.testing.assert_allclose(computed, THETA, rtol=0, atol=1e-15)


def test_a_sine_is_recovered_from_two_cosines(case):
    """C08: eta of equal spacing is 2 cos(w spacing)."""
    reference = case("C08")
    terms, groups, planned = recovery(["a"], [Sine()], reference["D"])
    constants = exact_eta(terms, groups, reference["theta"], reference["D"])
    expected = reference["expected"]
    assert (
        abs(constants[[term.row for term in terms[1:]].index(1)] - expected["value"])
        <= reference["tol"]
    )
    np.testing.assert_allclose(
        recover(planned, constants), [expected["omega"]], rtol=0, atol=reference["tol"]
    )
    assert planned.groups[0].kind is RecoveryKind.SINE
    assert planned.groups[0].limit == math.pi / 0.5


def test_two_exponentials_of_one_alpha_are_recovered_from_a_quadratic(case):
    """C09: the recurrence d(t) - s1 d(t - 1) + s2 d(t - 2), theta sorted descending."""
    reference = case("C09")
    terms, groups, planned = recovery(["one", "one"], [Exponential()] * 2, reference["D"])
    constants = exact_eta(terms, groups, reference["theta"], reference["D"])
    chosen = planned.groups[0]
    c = [
        sign * np.append(1.0, constants)[term]
        for term, sign in zip(chosen.terms, chosen.signs, strict=True)
    ]
    assert abs(-c[1] / c[0] - reference["expected"]["s1"]) <= reference["tol"]
    assert abs(c[2] / c[0] - reference["expected"]["s2"]) <= reference["tol"]
    expected = reference["expected"]["recovered_theta_sorted"][::-1]
    np.testing.assert_allclose(recover(planned, constants), expected, rtol=0, atol=reference["tol"])


rates = st.floats(0.3, 2.5)  # sines below pi / spacing, away from its ends
decays = st.floats(-1.0, 0.2)
COMPONENTS = {
    "two alphas": (["a", "b"], "ee"),
    "three alphas": (["a", "b", "c"], "eee"),
    "a sine": (["a"], "s"),
    "a pair": (["a", "a"], "ee"),
    "a sine and an exponential": (["a", "b"], "se"),
    "an exponential and a sine": (["a", "b"], "es"),
    "two sines": (["a", "b"], "ss"),
    "a pair around an exponential": (["a", "b", "a"], "eee"),
}


@given(st.sampled_from(sorted(COMPONENTS)), st.data())
def test_recovery_inverts_the_expansion(name, data):
    """From theta to chi to eta and back is the identity.

    It is where the delays of the first term are not equally spaced, too.
    """
    alphas, kinds = COMPONENTS[name]
    thetas = [data.draw(rates if kind == "s" else decays) for kind in kinds]
    paired = [
        theta for alpha, theta in zip(alphas, thetas, strict=True) if alphas.count(alpha) == 2
    ]
    assume(not paired or paired[0] - paired[1] > 0.1)
    delays = [1.0 + j for j in range(sum(1 + (kind == "s") for kind in kinds) + 1)]
    terms, groups, planned = recovery(
        alphas, [Sine() if kind == "s" else Exponential() for kind in kinds], delays
    )
    chi_0_scale = [
        abs(math.sin(theta)) for theta, kind in zip(thetas, kinds, strict=True) if kind == "s"
    ]
    assume(all(value > 0.1 for value in chi_0_scale))
    computed = recover(planned, exact_eta(terms, groups, thetas, delays))
    # minors of numbers up to e^5 divided by gaps of 0.1 in two places: 1e-16 * 150 / 0.1^2 * some
    np.testing.assert_allclose(computed, thetas, rtol=0, atol=1e-10)


@settings(max_examples=25)
@given(rates, decays, decays, st.floats(0.2, 0.9))
def test_terms_of_other_families_are_recovered_beside_one_without_parameters(
    rate, decay, exponent, spacing
):
    """A damped sine, a ramp, and t exp: theta stands by component, the ramp has none."""
    assume(math.sin(rate * spacing) > 0.2)
    assume(abs(exponent) > 0.1)
    families = [DampedSine(), Polynomial(1, "ramp"), TExponential()]
    delays = [spacing * j for j in range(1, 8)]
    terms, groups, planned = recovery(["a", "b", "c"], families, delays)
    assert planned.n_theta == 3
    thetas = [[decay, rate], [], [exponent]]
    eta = exact_eta(terms, groups, thetas, delays)
    # a double root is known to the root of the rounding that the minors leave
    np.testing.assert_allclose(recover(planned, eta), [decay, rate, exponent], rtol=0, atol=1e-6)


def test_the_kernel_recovers_theta_as_the_formula_does(subtests):
    """One row for each unknown of the regression, which has eta as its solution."""
    for family, theta in [(DampedSine(), [0.2, 1.3]), (Sine(), [1.3]), (TExponential(), [-0.4])]:
        with subtests.test(theta=theta):
            terms, groups, planned = recovery(["a"], [family], [0.5, 1.0, 1.5])
            eta = exact_eta(terms, groups, [theta], [0.5, 1.0, 1.5])
            kernel = LeastSquares(
                LeastSquaresConstants(
                    unknowns=len(eta),
                    start_time=0.0,
                    information=0.0,
                    recovery=recovery_constants(planned),
                    held=True,
                )
            )
            kernel.initialize()
            mu = np.column_stack([-eta, np.eye(len(eta))])
            rows = np.vstack([mu, mu[-1]])
            y = kernel.step.advance(np.arange(len(rows)) * 1.0, 1.0, rows)
            np.testing.assert_allclose(
                y[-1, : len(theta)], recover(planned, eta), rtol=0, atol=1e-7
            )
            np.testing.assert_allclose(y[-1, : len(theta)], theta, rtol=0, atol=1e-6)


def test_terms_without_parameters_have_no_recovery():
    """There is no theta; the way out is named."""
    with pytest.raises(AssumptionError, match=r"no theta to recover; method = \"output-error\""):
        recovery(["a"], [Polynomial(2)], (1, 2, 3, 4))


def test_delays_may_come_in_any_order():
    """Only their values count: a sine and an exponential with D = (1, 2, 1.5, 3)."""
    delays = [1.0, 2.0, 1.5, 3.0]
    terms, groups, planned = recovery(["a", "b"], [Sine(), Exponential()], delays)
    assert planned.groups[0].spacing == 1.0
    np.testing.assert_allclose(
        recover(planned, exact_eta(terms, groups, [1.3, -0.2], delays)),
        [1.3, -0.2],
        rtol=0,
        atol=1e-12,
    )


def test_an_eta_that_belongs_to_no_theta_gives_nan():
    """The logarithm of a non-positive number, complex roots, a cosine beyond one and NaN: no value.

    Other groups keep their values.
    """
    _, _, two = recovery(["a", "b"], [Exponential()] * 2, DELAYS)
    computed = recover(two, np.array([1.0, -1.0, 1.0, 1.0, math.exp(0.3)]))
    assert np.isnan(computed[0])
    assert computed[1] == math.log(math.exp(0.3)) / (2.0 - 3.0)
    assert np.isnan(recover(two, np.full(5, np.nan))).all()
    assert np.isnan(recover(two, np.zeros(5))).all()
    terms, _, pair = recovery(["a", "a"], [Exponential()] * 2, DELAYS)
    assert [term.row for term in terms] == [2, 0, 1]
    assert np.isnan(recover(pair, np.array([1.0, 1.0]))).all()  # z^2 - z + 1
    assert np.isnan(
        recover(pair, np.array([-1.0, 0.0]))
    ).all()  # z^2 - 1: only +1 is an exponential
    assert np.isnan(recover(pair, np.array([0.0, 1.0]))).all()
    _, _, sine = recovery(["a"], [Sine()], DELAYS)
    assert np.isnan(recover(sine, np.array([1.0, 2.5]))).all()
    assert np.isnan(recover(sine, np.array([0.0, 1.0]))).all()


def test_a_recovery_that_does_not_exist_is_refused(subtests):
    """The message lists the possible families."""
    for alphas, families, delays, message in [
        (
            ["a"] * 3,
            [Exponential()] * 3,
            (1, 2, 3, 4),
            r"no formula .* components \[0, 1, 2\] that share alpha 'a' "
            r"\(exponential, .*\); possible",
        ),
        (
            ["a"] * 2,
            [Exponential(), Sine()],
            (1, 2, 3, 4),
            r"possible for one alpha: one exponential, two exponentials, one sine, one damped-sine",
        ),
        (
            ["a"],
            [Sine()],
            (1, 2, 4),
            r"share alpha 'a': expected 3 equally spaced delays, got 1, 2, 4 s",
        ),
        (["a", "b"], [Exponential()] * 2, (1, 2, 2), r"delays 2 and 3: .* got 2 s twice"),
    ]:
        with subtests.test(message=message), pytest.raises(AssumptionError, match=message):
            recovery(alphas, families, delays)


def test_least_squares_is_the_solution_of_the_papers_equations(case, subtests):
    """(33)-(34) from exact delta: theta_2 has the wrong sign with P(0) = 1e3 I, not with 1e9 I."""
    for name, prior in [("C04", 1e-3), ("C05", 1e-9)]:
        with subtests.test(name=name):
            reference = case(name)
            expected = reference["expected"] if name == "C04" else reference["expected"]["P0_1e9"]
            _, _, planned = recovery(["a", "b"], [Exponential()] * 2, DELAYS)
            for sample in expected["oracle_delta"]:
                t, weights = gauss(
                    reference["T_id"], sample["t"], 100
                )  # pieces below 0.4 s: the rule is exact to rounding
                computed = least_squares(mu(expand((1, 1)), *delayed(t)), weights, prior)
                np.testing.assert_allclose(computed, sample["eta"], rtol=0, atol=1e-9)
                np.testing.assert_allclose(
                    recover(planned, computed), sample["theta"], rtol=0, atol=1e-9
                )


def test_least_squares_without_a_prior_is_exact(case):
    """Exact delta, no prior: eta itself. Condition of the rows is sqrt(3.2e4) = 180."""
    t = np.linspace(case("C03")["expected"]["T_id"], 40.0, 2000)
    computed = least_squares(mu(expand((1, 1)), *delayed(t)), trapezoid_weights(t))
    np.testing.assert_allclose(computed, case("C03")["expected"]["eta_2_to_6"], rtol=0, atol=1e-11)


def test_least_squares_without_enough_data_has_no_value():
    """Fewer rows than unknowns, or dependent columns: NaN, and a prior makes it finite."""
    rows = np.array([[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [3.0, 1.0, 1.0]])
    assert np.isnan(least_squares(rows[:1], np.ones(1))).all()
    assert np.isnan(least_squares(rows, np.ones(3))).all()
    # (1 + 3 s) eta = -6 s for equal etas, s = 1: (1 I + 3 ones) eta = -6 ones, eta = -6 / 7
    np.testing.assert_allclose(least_squares(rows, np.ones(3), 1.0), [-6 / 7, -6 / 7], rtol=1e-14)


def test_trapezoid_weights_integrate_linear_functions():
    """The weighted sum of a linear function is its integral, on any grid."""
    t = np.array([0.0, 0.5, 2.0, 2.25])
    np.testing.assert_allclose(
        trapezoid_weights(t) @ (3.0 * t + 1.0), 1.5 * 2.25**2 + 2.25, rtol=1e-15
    )
