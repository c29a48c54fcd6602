import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import AssumptionError
from cosim.theory.disturbance import (
    FAMILIES,
    Exponential,
    Family,
    K,
    Sine,
    coefficients,
    family_named,
    group_by_alpha,
)


@given(
    st.sampled_from(sorted(FAMILIES)),
    st.floats(-3, 3),
    st.floats(0, 5),
    st.floats(-2, 2),
    st.floats(-2, 2),
)
def test_a_delayed_component_is_K_times_the_basis(name, theta, D, a, b):
    """(5): f(t - D) = K(theta, D)' beta(t), for the closed forms of the families."""
    family = FAMILIES[name]
    t = 1.7
    if name == "exponential":
        beta = [a * math.exp(theta * t)]
        delayed = a * math.exp(theta * (t - D))
    else:
        beta = [
            a * math.sin(theta * t) + b * math.cos(theta * t),
            a * math.cos(theta * t) - b * math.sin(theta * t),
        ]
        delayed = a * math.sin(theta * (t - D)) + b * math.cos(theta * (t - D))
    # expm leaves norms up to 5.4 unscaled, where terms of size e^5 cancel, and squares twice:
    # 1e-16 * 150 * 4, times a few
    bound = 1e-12 * max(1.0, float(np.abs(K(family, theta, D)) @ np.abs(beta)))
    assert abs(K(family, theta, D) @ beta - delayed) <= bound


@given(st.floats(-3, 3), st.floats(0.1, 2))
def test_an_exponential_follows_from_its_root(theta, spacing):
    """theta_from_roots inverts z = exp(theta spacing)."""
    computed = Exponential().theta_from_roots([math.exp(theta * spacing)], spacing)
    np.testing.assert_allclose(
        computed, [theta], rtol=0, atol=1e-15 / spacing + 1e-15
    )  # rounding of z, relative, over the spacing


@given(st.floats(0.1, 3.0), st.floats(0.1, 1.0))
def test_a_sine_follows_from_its_roots(rate, spacing):
    """theta_from_roots inverts z = exp(+-j w spacing) below pi / spacing."""
    z = complex(math.cos(rate * spacing), math.sin(rate * spacing))
    computed = Sine().theta_from_roots([z, z.conjugate()], spacing)
    # acos magnifies the rounding of the cosine by 1 / sin
    np.testing.assert_allclose(
        computed, [rate], rtol=0, atol=1e-15 / (spacing * math.sin(rate * spacing))
    )


def test_roots_that_belong_to_no_theta_give_nan():
    """Not real, not positive, beyond 2 cos: no value, never a wrong one."""
    for root in (-0.5, 0.0, 1j, math.inf):
        assert np.isnan(Exponential().theta_from_roots([root], 1.0)).all()
    assert np.isnan(Sine().theta_from_roots([2.0, 0.5], 1.0)).all()


def test_families_are_found_by_name():
    """The registry knows each family by its own name, and guesses at a wrong one."""
    assert all(
        family_named(name).name == name and family_named(name).c.shape == (family_named(name).v,)
        for name in FAMILIES
    )
    with pytest.raises(
        AssumptionError,
        match=r"no disturbance family 'sinus' in this package; did you mean 'sine'\? There is: ",
    ):
        family_named("sinus")


def test_a_theta_of_the_wrong_size_is_refused():
    """K names the parameters."""
    with pytest.raises(
        AssumptionError, match=r"theta of family 'sine' has shape \(2,\); needed \(1,\): rate"
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
