import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.errors import AssumptionError
from cosim.theory.disturbances.families import Exponential, Sine, coefficients, group_by_alpha
from cosim.theory.disturbances.regression import (
    Term,
    check_alpha_products,
    check_delays,
    chi,
    count_terms,
    eta,
    expand,
    linear_route_problem,
    linear_route_warning,
    mu,
)
from tests.theory.academic import DELAYS, THETA, alpha, delayed
from tests.theory.closed_forms import FORMS

SIZES = [[1], [2], [1, 1], [3], [2, 1], [1, 2], [1, 1, 1], [2, 2], [1, 1, 2]]


def test_the_number_of_terms_is_known(case):
    """(l + 1)! / prod V_b!, each term once."""
    for text, expected in case("C07")["expected"].items():
        sizes = tuple(int(size) for size in text.strip("[]").split(","))
        terms = expand(sizes)
        assert len(terms) == len(set(terms)) == count_terms(sizes) == expected


def test_two_exponentials_give_the_papers_six_terms():
    """(32): mu_1..mu_6 in the paper's order with the paper's signs; rows are D_1, D_2, D_3."""
    assert expand((1, 1)) == (
        Term(2, ((0,), (1,)), 1),
        Term(2, ((1,), (0,)), -1),
        Term(0, ((2,), (1,)), -1),
        Term(1, ((2,), (0,)), 1),
        Term(0, ((1,), (2,)), 1),
        Term(1, ((0,), (2,)), -1),
    )


def test_the_papers_signals_and_constants_are_reproduced(case):
    """The signals at t = 10, eta_2..eta_6, and the residual of (26)."""
    expected = case("C03")["expected"]
    tol = case("C03")["tol"]
    terms = expand((1, 1))
    signals = mu(terms, *delayed(np.array([10.0])))[0]
    np.testing.assert_allclose(signals, expected["mu_1_to_6_at_t10_true_delta"], rtol=tol["rel"])
    K = [coefficients([Exponential()], [theta], DELAYS) for theta in THETA]
    np.testing.assert_allclose(eta(terms, K), expected["eta_2_to_6"], rtol=tol["rel"])
    residual = -signals[0] - signals[1:] @ eta(terms, K)
    assert abs(residual - expected["residual_at_t10"]) <= tol["residual"]


@pytest.mark.parametrize(
    ("name", "families", "factor"), [("C08", [Sine()], "a"), ("C09", [Exponential()] * 2, "one")]
)
def test_one_group_of_two_gives_the_reference_terms(case, name, families, factor):
    """Rows, signs and chi as computed elsewhere, and the reference signal satisfies (25)."""
    reference = case(name)
    terms = expand((2,))
    constants = chi(terms, [coefficients(families, reference["theta"], reference["D"])])
    computed = {
        (term.row + 1, tuple(row + 1 for row in term.parts[0])): (term.sign, value)
        for term, value in zip(terms, constants, strict=True)
    }
    assert len(computed) == reference["q"] + 1
    for term in reference["terms_chi"]:
        sign, value = computed[term["row"], tuple(term["parts"][0])]
        assert sign == term["sign"]
        assert abs(value - term["chi"]) <= reference["tol"]
    times = np.array(reference["delta_samples"]["t_minus_D"])
    alphas = {"a": 1.35 + 0.25 * np.sin(1.7 * times), "one": np.ones_like(times)}[factor]
    products = (
        mu(terms, np.array(reference["delta_samples"]["values"]), alphas[:, :, None]) * constants
    )
    relative = np.abs(products.sum(axis=1)) / np.abs(products).sum(axis=1)
    np.testing.assert_allclose(relative, reference["residual_rel"], rtol=0, atol=reference["tol"])


def test_the_columns_of_two_exponentials_collapse_when_alpha_is_shared(case):
    """Six naive columns have nullity 4: three signals with one recurrence between them."""
    t = np.linspace(5.0, 20.0, 200)
    times = np.subtract.outer(t, DELAYS)
    signals = mu(
        expand((1, 1)),
        np.exp(np.multiply.outer(times, THETA)).sum(axis=-1),
        np.ones((*times.shape, 2)),
    )
    assert (
        6 - np.linalg.matrix_rank(signals, tol=1e-10)
        == case("C09")["expected"]["naive_six_column_nullity"]
    )


MIXTURES = [
    *([name] for name in FORMS),
    ["exponential"] * 2,
    ["exponential"] * 3,
    ["exponential"] * 4,
    ["sine", "exponential"],
    ["sine"] * 2,
    ["damped-sine", "constant"],
    ["ramp", "exponential"],
    ["t-exponential", "linear"],
]


def permanent(matrix):
    """Return the sum of the products that a determinant has, all with the same sign."""
    rows = range(len(matrix))
    orders = np.array(list(permutations(rows)))
    return float(np.sum(np.prod(matrix[orders, list(rows)], axis=1)))


@pytest.mark.parametrize("is_shared", [True, False], ids=["one alpha", "an alpha each"])
@settings(max_examples=10)
@given(data=st.data())
def test_the_regression_holds_for_every_signal_of_the_class(is_shared, data):
    """(25) vanishes whatever the amplitudes, parameters, alphas and delays, for l = 1 to 4.

    The signals are closed forms, the alphas any numbers. What is left is rounding, relative to the
    sum of the absolute products of the determinant, expanded to the last factor: components of one
    alpha that are nearly the same have minors whose products cancel.
    """
    for names in MIXTURES:
        forms = [data.draw(FORMS[name]) for name in names]
        alphas_of = ["a"] * len(forms) if is_shared else list("abcd"[: len(forms)])
        groups = group_by_alpha(alphas_of, [form.family for form in forms])
        sizes = tuple(group.size for group in groups)
        gaps = data.draw(
            st.lists(st.floats(0.2, 0.9), min_size=sum(sizes) + 1, max_size=sum(sizes) + 1)
        )
        times = 2.0 - np.cumsum(gaps)
        delays = 2.0 - times
        seed = data.draw(st.integers(0, 1000))
        alphas = np.random.default_rng(seed).uniform(0.5, 2.0, (len(delays), len(groups)))
        delta = np.zeros(len(delays))
        size = np.zeros(len(delays))
        K = []
        for b, group in enumerate(groups):
            own = [forms[i] for i in group.components]
            K.append(coefficients(group.families, [form.theta for form in own], delays))
            for form in own:
                delta += alphas[:, b] * [form(t) for t in times]
                size += alphas[:, b] * [form.size(t) for t in times]
        terms = expand(sizes)
        products = mu(terms, delta[None], alphas[None])[0] * chi(terms, K)
        columns = [np.abs(alphas[:, [b]] * rows) for b, rows in enumerate(K)]
        absolute = permanent(np.column_stack([size, *columns]))
        assert abs(products.sum()) <= 1e-12 * absolute + np.finfo(np.float64).tiny, names


@given(st.sampled_from(SIZES), st.randoms(use_true_random=False))
def test_the_expansion_is_the_determinant(sizes, random):
    """For arbitrary numbers the sum of mu chi is the determinant of [delta, alpha_b K_b']."""
    rows = sum(sizes) + 1

    def normal(*shape):
        return np.array([random.uniform(-1, 1) for _ in range(math.prod(shape))]).reshape(shape)

    delta = normal(rows)
    alphas = normal(rows, len(sizes))
    K = [normal(rows, size) for size in sizes]
    terms = expand(tuple(sizes))
    computed = float(mu(terms, delta[None], alphas[None])[0] @ chi(terms, K))
    matrix = np.column_stack([delta, *(alphas[:, [b]] * K[b] for b in range(len(sizes)))])
    # at most 60 terms below 1, rounded at 1e-16 each
    assert abs(computed - np.linalg.det(matrix)) <= 1e-13


def test_an_empty_expansion_is_refused():
    """No groups, or a group without basis functions."""
    for sizes in ((), (1, 0)):
        with pytest.raises(AssumptionError, match=r"group sizes: .* got \[.*\]"):
            expand(sizes)


def test_eta_needs_a_first_constant():
    """chi_0 = sin(w (D_2 - D_1)) vanishes for a sine at rest: eta is not defined."""
    with pytest.raises(AssumptionError, match="chi_0, is zero; choose other delays"):
        eta(expand((2,)), [coefficients([Sine()], [0.0], DELAYS)])


def test_delays_that_do_not_fit_are_refused(subtests):
    """Assumption 3: as many as needed, finite, pairwise distinct."""
    for delays, message in [
        ((1.0, 2.0, 1.0), r"delays 1 and 3: .* got 1 s twice"),
        ((1.0, 2.0), r"delays: expected 3, .* got 2"),
        ((1.0, -2.0, 3.0), r"delay 2: .* got -2 s"),
        ((1.0, 2.0, math.nan), r"delay 3: .* got nan s"),
    ]:
        with subtests.test(message=message), pytest.raises(AssumptionError, match=message):
            check_delays(delays, 3)


def grid(*functions, delays=DELAYS):
    times = np.subtract.outer(np.linspace(5.0, 40.0, 400), delays)
    return np.stack([function(times) for function in functions], axis=-1)


def test_the_papers_alphas_are_independent():
    """Its six columns are distinguishable without any data."""
    check_alpha_products(
        expand((1, 1)), alpha(np.subtract.outer(np.linspace(5.0, 40.0, 400), DELAYS)), ["a", "b"]
    )
    check_delays(DELAYS, 3)


def test_dependent_alpha_products_are_refused(subtests):
    """The message names proportional alphas; alphas that a delay scales or repeats are refused."""
    for alphas, message in [
        (
            grid(np.cos, lambda t: -3.0 * np.cos(t)),
            r"alpha 'a' and alpha 'b' are proportional; merge their components into one group",
        ),
        (
            grid(lambda t: np.exp(-0.1 * t), lambda t: np.exp(-0.2 * t)),
            r"the 2 alpha products of 'a', 'b' at delay 1 have rank 1; choose delays",
        ),
        (
            grid(lambda t: 2 + np.sin(2 * np.pi * t), lambda t: 2 + np.cos(2 * np.pi * t)),
            r"have rank 1; choose delays that are no multiples",
        ),
        (
            grid(np.cos, lambda t: 2 + np.sin(t))[:1],
            r"at least 2 instants .* alpha products, got 1",
        ),
    ]:
        with subtests.test(message=message), pytest.raises(AssumptionError, match=message):
            check_alpha_products(expand((1, 1)), alphas, ["a", "b"])


def test_the_limits_of_the_linear_route_are_warned_of():
    """No warning for l = 2 or one alpha; marginal at l = 3; unusable from l = 4."""
    assert linear_route_warning((1, 1)) == linear_route_warning((4,)) == ""
    assert linear_route_warning((2, 1)).startswith(
        "the linear route is marginal: l = 3 with different alphas makes 11 unknowns"
    )
    assert linear_route_problem((2, 1)) == linear_route_problem((7,)) == ""
    assert linear_route_warning((2, 2)) == ""
    assert linear_route_problem((2, 2)).startswith(
        "the linear route is unusable: l = 4 with different alphas makes 29 unknowns, "
        "with a condition of 4e12"
    )
