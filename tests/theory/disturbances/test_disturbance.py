"""Families of disturbance components: their rows, basis, constants, roots and refusals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import AssumptionError
from cosim.theory.disturbances.families import (
    FAMILIES,
    DampedSine,
    Exponential,
    Family,
    K,
    Polynomial,
    Sine,
    TExponential,
    coefficients,
    even_parameters,
    family_named,
    generators,
    group_by_alpha,
    search_box,
)
from cosim.theory.disturbances.linear_family import LinearFamily
from tests.theory.closed_forms import FORMS, OSCILLATOR

KNOWN = st.sampled_from(sorted(FORMS)).flatmap(FORMS.__getitem__)


def states(form, t):
    """Return beta(t) by `beta' = G beta`: f and, from its derivatives, the other states.

    As f = beta_1 for every family of the package, f' = (G beta)_1, f'' = (G G beta)_1, and so on;
    the derivatives are those of a polynomial through 2 v + 5 close points of the closed form.
    """
    v = form.family.v
    points = np.linspace(-0.25, 0.25, 2 * v + 5)
    values = [form(t + x) for x in points]
    fitted = np.polynomial.Polynomial.fit(points, values, len(points) - 1)
    derivatives = [fitted.deriv(k)(0.0) for k in range(v)]
    G = form.family.G(np.array(form.theta))
    observed = [form.family.c]
    for _ in range(v - 1):
        observed.append(observed[-1] @ G)
    return np.linalg.solve(np.array(observed), derivatives)


@given(KNOWN, st.floats(0.0, 5.0))
def test_a_delayed_component_is_K_times_the_basis(form, D):
    """(5): f(t - D) = K(theta, D)' beta(t), for the closed forms of all families."""
    t = 1.7
    row = K(form.family, form.theta, D)
    beta = states(form, t)
    # derivatives of order v - 1 <= 3 by interpolation on spacing 0.05: rounding 2e-16 / 0.05^3 and
    # a remainder of 1e-9 for rates up to 3; K magnifies both by its size
    bound = 1e-7 * max(1.0, float(np.abs(row) @ np.abs(beta)), float(np.abs(row).sum()))
    assert abs(row @ beta - form(t - D)) <= bound


@given(KNOWN)
def test_the_constants_are_those_of_the_state_at_zero(form):
    """constants_of inverts what beta(0) is, and its derivatives are those of differences."""
    family = form.family
    beta = states(form, 0.0)
    constants, slopes = family.constants_of(beta)
    if "phase" in family.constants:
        if abs(form.constants[0]) < 0.1:
            return  # of a component that is not there the phase has no value
        sign = np.sign(form.constants[0])
        np.testing.assert_allclose(constants[0], abs(form.constants[0]), rtol=1e-6)
        assert math.sin(constants[1] - form.constants[1]) == pytest.approx(0.0, abs=1e-5)
        assert sign * math.cos(constants[1] - form.constants[1]) > 0.0
    else:
        np.testing.assert_allclose(constants, form.constants, rtol=0, atol=1e-6)
    h = 1e-6
    for k in range(family.v):
        step = h * np.eye(family.v)[k]
        above = family.constants_of(beta + step)[0]
        below = family.constants_of(beta - step)[0]
        if np.abs(above - below).max() < 1.0:  # the angle did not jump by a turn
            np.testing.assert_allclose(slopes[:, k], (above - below) / (2 * h), atol=1e-4)


@given(KNOWN, st.floats(0.1, 1.0))
def test_theta_follows_from_the_roots_of_its_recurrence(form, spacing):
    """theta_from_roots inverts z = exp(lambda spacing), lambda the eigenvalues of G."""
    family = form.family
    z = np.exp(spacing * np.linalg.eigvals(family.G(np.array(form.theta))))
    computed = family.theta_from_roots(list(z), spacing)
    assert computed.shape == (len(family.parameters),)
    # multiple eigenvalues are known to the root of the rounding; acos is steep at both ends
    atol = 1e-6 if family.name in ("linear", "t-exponential") else 1e-9
    np.testing.assert_allclose(computed, form.theta, rtol=0, atol=atol / spacing)


def test_roots_that_belong_to_no_theta_give_nan():
    """Not real, not positive, beyond 2 cos: no value, never a wrong one."""
    for root in (-0.5, 0.0, 1j, math.inf):
        assert np.isnan(Exponential().theta_from_roots([root], 1.0)).all()
    assert np.isnan(Sine().theta_from_roots([2.0, 0.5], 1.0)).all()
    assert np.isnan(DampedSine().theta_from_roots([2.0, 0.5], 1.0)).all()
    assert np.isnan(DampedSine().theta_from_roots([-2.0, 0.5], 1.0)).all()
    assert np.isnan(TExponential().theta_from_roots([-0.5, -0.5], 1.0)).all()
    assert np.isnan(OSCILLATOR.theta_from_roots([0.0, 0.5], 1.0)).all()


def test_a_search_has_a_range_for_every_parameter_that_holds_what_can_be_seen():
    """A period and a decay of a tenth of the record are within, and none is empty."""
    theta = {
        "exponential": [-0.5],
        "sine": [3.0],
        "damped-sine": [0.5, 3.0],
        "t-exponential": [-0.5],
        "linear": [9.0, 1.0],
    }
    for family in (*FAMILIES.values(), Polynomial(4), OSCILLATOR):
        ranges = family.search(20.0, 0.5)
        assert len(ranges) == len(family.parameters) == len(family.even)
        for value, (lower, upper) in zip(theta.get(family.name, []), ranges, strict=True):
            assert lower < value < upper


def test_families_are_found_by_name():
    """The registry knows each family by its own name, and guesses at a wrong one."""
    for name in FAMILIES:
        family = family_named(name)
        assert family.name == name
        assert family.c.shape == (family.v,)
        assert len(family.constants) == family.v
        filled = dict.fromkeys([*family.constants, *family.parameters], "x")
        assert "x" in family.formula.format(**filled)
    with pytest.raises(
        AssumptionError,
        match=r"no disturbance family 'sinus' in this package; did you mean 'sine'\?",
    ):
        family_named("sinus")


def test_a_chirp_is_refused_with_what_can_be_done():
    """A sine of unknown, growing rate is outside (5); one of known growth is two alphas."""
    with pytest.raises(AssumptionError, match=r"'chirp'.*outside the class.*sin\(k\*t\*\*2/2\)"):
        family_named("chirp")


@given(st.floats(0.2, 3.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_chirp_of_known_growth_is_two_sines_with_alphas(rate, growth, phase):
    """What the refusal says: sin(w t + k t^2 / 2 + p) is a sum of two sines of rate w."""
    for t in (0.0, 0.7, 3.1):
        angle = growth * t**2 / 2
        one = math.cos(angle) * math.sin(rate * t + phase)
        other = math.sin(angle) * math.sin(rate * t + phase + math.pi / 2)
        assert one + other == pytest.approx(math.sin(rate * t + angle + phase), abs=1e-12)


def test_families_with_settings_are_no_names_alone():
    """A polynomial has a degree, a linear family its matrices."""
    with pytest.raises(AssumptionError, match=r"'polynomial': expected its settings.*degree"):
        family_named("polynomial")
    with pytest.raises(AssumptionError, match=r"'linear': expected its settings.*G0, G, c"):
        family_named("linear")


SQUARE = ((0.0, 1.0), (-1.0, 0.0))
ONE = (((0.0, 0.0), (-1.0, 0.0)),)


def test_a_generator_that_is_none_is_refused(subtests):
    """Shapes, names, an unobserved state, parameters that no signal depends on."""
    for arguments, message in [
        ((SQUARE, ONE, (1.0, 0.0, 0.0), ("a",)), r"G0: expected 3 rows of 3 .* got 2 rows of 2"),
        ((SQUARE, (((1.0,),),), (1.0, 0.0), ("a",)), r"G\[0\]: expected 2 rows .* got 1 rows of 1"),
        ((SQUARE, ONE, (1.0, 0.0), ()), r"parameters: expected 1 names, .* got 0"),
        ((SQUARE, ONE, (1.0, 0.0), ("beta_1",)), r"parameters: .* got 'beta_1'"),
        ((SQUARE, ONE * 2, (1.0, 0.0), ("a", "a")), r"parameters: .* got a, a"),
        ((SQUARE, ONE, (0.0, math.inf), ("a",)), r"got NaN or infinity"),
        ((SQUARE, ONE, (), ("a",)), r"c: expected 1 to 16 numbers, .* got 0"),
        (
            (((0.0, 0.0), (0.0, -1.0)), (((1.0, 0.0), (0.0, 0.0)),), (1.0, 0.0), ("a",)),
            r"does not observe the state of G that goes with the eigenvalue -1",
        ),
        (
            (((0.0, 1.0), (0.0, 0.0)), (((0.0, 1.0), (0.0, 0.0)),), (1.0, 0.0), ("a",)),
            r"a does not move the eigenvalues of G",
        ),
        ((SQUARE, ONE * 2, (1.0, 0.0), ("a", "b")), r"the 2 parameters a, b move the 2 eig"),
        ((SQUARE, ONE, (1.0, 0.0), ("a",), ((2.0, 1.0),)), r"search of a: .* got \[2, 1\]"),
        ((SQUARE, ONE, (1.0, 0.0), ("a",), ()), r"search: expected 1 ranges, .* got 0"),
    ]:
        with subtests.test(message=message), pytest.raises(AssumptionError, match=message):
            LinearFamily(*arguments)


def test_a_theta_of_the_wrong_size_is_refused():
    """K names the parameters."""
    with pytest.raises(
        AssumptionError, match=r"theta of family 'sine': .* \(1,\): rate; got \(2,\)"
    ):
        K(Sine(), [1.0, 2.0], 1.0)


def test_components_are_grouped_by_alpha():
    """Equal alpha, one group; in the order of their first component, sized by basis functions."""
    families: list[Family] = [Exponential(), Sine(), Exponential()]
    first, second = group_by_alpha(["a", "b", "a"], families)
    assert (first.alpha, first.components, first.families, first.size) == (
        "a",
        (0, 2),
        (Exponential(), Exponential()),
        2,
    )
    assert (second.alpha, second.components, second.families, second.size) == (
        "b",
        (1,),
        (Sine(),),
        2,
    )


def test_coefficients_stack_the_components_of_a_group():
    """One row per delay, the columns of the components side by side."""
    stacked = coefficients([Exponential(), Sine()], [-0.1, 1.3], [0.0, 2.0])
    assert stacked.shape == (2, 3)
    expected = [math.exp(0.2), math.cos(2.6), -math.sin(2.6)]
    np.testing.assert_allclose(
        stacked, [[1, 1, 0], expected], rtol=0, atol=1e-14
    )  # expm of norm 2.6


def test_a_component_without_amplitude_has_no_phase():
    """Nor derivatives; one that is too large for a number has neither."""
    for beta, amplitude in ((np.zeros(2), 0.0), (np.array([math.inf, 1.0]), math.inf)):
        constants, slopes = Sine().constants_of(beta)
        assert constants[0] == amplitude
        assert math.isnan(constants[1])
        assert np.isnan(slopes).all()


def test_roots_at_the_ends_of_the_unique_range_have_their_rate():
    """cos(w spacing) = 1 is a constant, -1 the fastest rate that these delays tell."""
    assert Sine().theta_from_roots([1.0, 1.0], 0.5).tolist() == [0.0]
    assert Sine().theta_from_roots([-1.0, -1.0], 0.5) == pytest.approx([2.0 * math.pi])
    z = math.exp(-0.5)
    assert DampedSine().theta_from_roots([z, z], 0.5) == pytest.approx([1.0, 0.0], abs=1e-7)


def test_a_start_is_searched_on_the_time_scales_of_the_record():
    """From a decay to a twentieth within the shortest time to a tenfold growth over the record.

    Rates from a quarter of a period over the record to half of one in the shortest time.
    """
    span = 20.0
    shortest = 0.5
    families = [Exponential(), DampedSine(), Polynomial(2), Sine(), TExponential()]
    box = search_box(families, span=span, shortest=shortest)
    decay, growth = math.log(math.exp(-3.0)) / shortest, math.log(10.0) / span
    slow, fast = math.pi / 2.0 / span, math.pi / shortest
    np.testing.assert_allclose(box.lower, [decay, -growth, slow, slow, decay], rtol=1e-15)
    np.testing.assert_allclose(box.upper, [growth, -decay, fast, fast, growth], rtol=1e-15)
    np.testing.assert_allclose(box.step, (box.upper - box.lower) / 10.0, rtol=1e-15)
    assert box.graded == (True, True, False, False, True)  # exponents, not rates
    assert box.even == even_parameters(families)


def test_a_parameter_is_even_where_its_negative_has_the_same_modes():
    """So of rates: the eigenvalues of G are those of the same signals."""
    for family in FAMILIES.values():
        theta = np.array([0.7, 1.9])[: len(family.parameters)]
        modes = np.sort_complex(np.linalg.eigvals(family.G(theta)))
        for j, is_even in enumerate(family.even):
            negative = theta.copy()
            negative[j] = -theta[j]
            others = np.sort_complex(np.linalg.eigvals(family.G(negative)))
            assert np.allclose(modes, others, atol=1e-7) == is_even


def test_the_kernels_have_the_matrices_of_every_component():
    """G0 + sum theta_j G1_j is G, component by component; without parameters there is no slope."""
    families = [Polynomial(2), DampedSine(), Exponential()]
    theta = np.array([0.4, 1.3, -0.2])
    made = generators(families)
    assert made.size == (3, 2, 1)
    assert made.count == (0, 2, 1)
    assert made.parameters == 3
    np.testing.assert_array_equal(made.c, [1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    G0 = np.split(made.G0, [9, 13])
    G1 = np.split(made.G1, [4, 8])
    damped = G0[1] + theta[0] * G1[0] + theta[1] * G1[1]
    np.testing.assert_array_equal(G0[0], np.diag([1.0, 2.0], 1).ravel())
    np.testing.assert_allclose(damped, families[1].G(theta[:2]).ravel(), rtol=1e-15)
    np.testing.assert_allclose(G0[2] + theta[2] * G1[2], [theta[2]], rtol=1e-15)
    assert len(generators([Polynomial(0)]).G1) == 0
    with pytest.raises(AssumptionError, match="at least one component, got none"):
        generators([])


def test_a_polynomial_names_its_coefficients_by_power():
    """The formula is their sum."""
    cubic = Polynomial(3)
    assert cubic.constants == ("level", "slope", "coefficient_2", "coefficient_3")
    assert cubic.formula == "{level} + {slope} t + {coefficient_2} t^2 + {coefficient_3} t^3"
    assert Polynomial(0, "constant").formula == "{level}"
    assert cubic.theta_from_roots([1.0] * 4, 0.5).shape == (0,)
