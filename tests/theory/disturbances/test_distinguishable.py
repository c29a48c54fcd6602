"""Terms of one alpha that say the same, and alphas that make one term of another."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.errors import AssumptionError
from cosim.theory.disturbances.distinguishable import check_distinguishable, check_exchangeable
from cosim.theory.disturbances.families import (
    DampedSine,
    Exponential,
    Polynomial,
    Sine,
    TExponential,
)

CONSTANT = Polynomial(0, "constant")
RAMP = Polynomial(1, "ramp")
BY_CHANCE = 0.3 + math.sqrt(2.0)  # what a free parameter of the first term is at the first trial


def check(families, fixed=(), bounds=None, alphas=None, span=20.0):
    """Check terms, with the theta of these numbers fixed, of one alpha if nothing else is said."""
    both = {j: (value, value) for j, value in enumerate(fixed) if value is not None}
    both.update(bounds or {})
    alphas = alphas or ["a"] * len(families)
    check_distinguishable(families, alphas, alphas, bounds=both, span=span)


def test_terms_that_say_the_same_are_refused(subtests):
    """The message has both terms, their alpha and the signal, and what to do."""
    for number, (families, fixed, message) in enumerate(
        [
            ([CONSTANT, CONSTANT], (), r"a constant: .*merge them: one term of family 'constant'"),
            ([CONSTANT, RAMP], (), r"a constant: .*merge them: one term of family 'ramp'"),
            ([RAMP, CONSTANT], (), r"a constant: .*merge them: one term of family 'ramp'"),
            ([Exponential(), CONSTANT], (0.0,), r"a constant: .*merge them into one term"),
            ([CONSTANT, Exponential()], (5e-7,), r"a constant: .*merge them into one term"),
            ([Exponential(), Exponential()], (-0.2, -0.2), r"exp\(-0.2 t\): "),
            ([Exponential(), Exponential()], (1.0, 1.0 + 5e-7), r"exp\(1 t\): "),
            ([Exponential(), Exponential()], (-100.0, -100.0 - 5e-5), r"exp\(-100 t\): "),
            ([TExponential(), Exponential()], (-0.2, -0.2), r"exp\(-0.2 t\): "),
            ([Sine(), Sine()], (1.5, 1.5), r"a sine of 1.5 rad/s: "),
            ([DampedSine(), Sine()], (0.0, 1.5, 1.5), r"a sine of 1.5 rad/s: "),
        ]
    ):
        with subtests.test(number=number):
            names = r"terms\[0\] \(.*\) and terms\[1\] \(.*\) share alpha 'a', .* make "
            with pytest.raises(AssumptionError, match=names + message):
                check(families, fixed)


def test_terms_that_differ_for_some_theta_are_accepted(subtests):
    """A parameter that is free, values apart by more than rounding, an agreement by chance."""
    for number, (families, fixed) in enumerate(
        [
            ([Exponential(), Exponential()], ()),
            ([Exponential(), CONSTANT], ()),
            ([Exponential(), CONSTANT], (2e-6,)),
            ([Exponential(), Exponential()], (1.0, 1.0 + 2e-6)),
            ([Exponential(), Exponential()], (-100.0, -100.0 - 2e-4)),
            ([Exponential(), Exponential()], (None, BY_CHANCE)),
            ([Sine(), Sine()], ()),
            ([Sine(), CONSTANT], ()),
            ([DampedSine(), Sine()], (0.1, 1.5, 1.5)),
            ([Exponential(), Sine(), Exponential()], (-0.2, -0.2, -0.3)),
        ]
    ):
        with subtests.test(number=number):
            check(families, fixed)


def test_terms_of_other_alphas_are_not_compared():
    """Equal terms are told apart by their alphas; the message counts all terms."""
    check([CONSTANT, CONSTANT], alphas=["a", "b"])
    with pytest.raises(AssumptionError, match=r"terms\[0\] .* terms\[2\] .* alpha 'a'"):
        check([Exponential(), Sine(), Exponential()], (-0.2, 3.0, -0.2), alphas=["a", "b", "a"])


def test_a_sine_as_slow_as_a_straight_line_is_refused_beside_a_constant(subtests):
    """Below 0.02 rad in a run of 20 s, whichever comes first."""
    for families, bounds, rate in [
        ([Sine(), CONSTANT], {0: (0.0, 9e-4)}, "0.0009"),
        ([CONSTANT, Sine()], {0: (-9e-4, 0.0)}, "0.0009"),
        ([CONSTANT, Sine()], {0: (-9e-4, 5e-4)}, "0.0009"),
        ([Exponential(), CONSTANT, DampedSine()], {2: (0.0, 5e-4)}, "0.0005"),
    ]:
        with subtests.test(bounds=bounds):
            message = rf"bounded by {rate} rad/s: .* in the 20 s .* above 0.001 rad/s"
            with pytest.raises(AssumptionError, match=message):
                check(families, bounds=bounds)


def test_a_sine_that_may_be_seen_is_accepted():
    """From the rate on at which it bends, in a longer run, or beside no constant."""
    check([Sine(), CONSTANT], bounds={0: (0.0, 1e-3)})
    check([Sine(), CONSTANT], bounds={0: (-1.1e-3, 9e-4)})
    check([Sine(), CONSTANT], bounds={0: (0.0, 9e-4)}, span=30.0)
    check([CONSTANT, Sine()], bounds={0: (0.0, 1e-3)})
    check([Sine(), Exponential()], bounds={0: (0.0, 9e-4)})
    check([Exponential(), Sine()], bounds={1: (0.0, 9e-4)})


T = np.linspace(0.0, 4.0, 41)
BASE = 2.0 + np.sin(1.7 * T)
ONE = [[Exponential()], [Exponential()]]


def test_an_alpha_that_is_another_times_an_exponential_is_refused(subtests):
    """Terms with an exponent take it up; the message has the rate and both alphas."""
    for number, (other, families, family) in enumerate(
        [
            (BASE * np.exp(0.5 * T), ONE, "exponential"),
            (-3.0 * BASE * np.exp(0.5 * T), ONE, "exponential"),
            (BASE * np.exp(0.5 * T), [[Sine(), DampedSine()], [DampedSine()]], "damped-sine"),
            (
                BASE * np.exp(0.5 * T),
                [[TExponential()], [CONSTANT, TExponential()]],
                "t-exponential",
            ),
        ]
    ):
        with subtests.test(number=number):
            alpha = np.column_stack([other, BASE])
            message = (
                rf"alpha 'p' is a multiple of exp\(0.5 t\) times alpha 'q', .* '{family}' .* by 0.5"
            )
            with pytest.raises(AssumptionError, match=message):
                check_exchangeable(T, alpha, families, ["p", "q"])


def test_a_ratio_counts_where_the_other_alpha_is_not_small():
    """A thousandth of its largest value; 8 such samples are enough, 7 are not."""
    for kept, is_refused in ((8, True), (7, False)):
        small = np.arange(len(T)) >= kept
        base = np.where(small, 9e-4, 1.0)
        other = np.where(small, -7.0, np.exp(0.5 * T))
        alpha = 5.0 * np.column_stack([other, base])
        if is_refused:
            with pytest.raises(AssumptionError, match=r"exp\(0.5 t\)"):
                check_exchangeable(T, alpha, ONE, ["p", "q"])
        else:
            check_exchangeable(T, alpha, ONE, ["p", "q"])


def test_alphas_that_exchange_nothing_are_accepted(subtests):
    """No term to take the exponent up, or a ratio that is no exponential."""
    for number, (other, families) in enumerate(
        [
            (BASE * np.exp(0.5 * T), [[Exponential()], [Sine()]]),
            (BASE * np.exp(0.5 * T), [[Exponential()], [TExponential()]]),
            (BASE * np.exp(0.5 * T), [[Sine()], [Sine()]]),
            (BASE * np.exp(0.01 * T**2), ONE),
            (BASE * np.exp(0.5 * T) * (1.0 + 1e-5 * np.sin(T)), ONE),
            (BASE * np.exp(0.5 * T) * np.where(T > 2.0, 1.0, -1.0), ONE),
            (BASE * np.exp(0.5 * T) * np.where(T == 2.0, 0.0, 1.0), ONE),
        ]
    ):
        with subtests.test(number=number):
            check_exchangeable(T, np.column_stack([other, BASE]), families, ["p", "q"])
