"""Regressor and identifier against the theory."""

import math

import numpy as np
import pytest

from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.core.contracts import Stopped
from cosim.errors import UsageError
from cosim.testing import check_component
from cosim.theory.disturbances.families import Exponential
from tests.blocks.examples import EXAMPLES, STEP_NS, Example, H
from tests.blocks.stepping import drive


@pytest.mark.parametrize("name", EXAMPLES)
def test_mu_is_that_of_the_theory(name):
    """The kernel's products over its ring are `theory.regression.mu` on delayed samples.

    There is no value before the longest delay.
    """
    example = EXAMPLES[name]
    computed = drive(example.regressor(), example.delta[:, None], step_ns=STEP_NS)
    assert (np.isnan(computed) == np.isnan(example.mu)).all()
    # l factors, each of two functions of t rounded within one last bit by C and numpy, and the
    # products
    np.testing.assert_allclose(computed, example.mu, rtol=1e-15)


def test_no_value_is_always_the_same_nan():
    """Also where an alpha is none: the NaN of a processor's arithmetic has a sign of its own."""
    alphas = ["sqrt(t - 5)", "0*log(t - 6)"]
    example = Example(alphas, [Exponential()] * 2, [-0.1, -0.3], [1.0, 2.0, 3.0], 12.0)
    computed = drive(example.regressor(), np.ones((1001, 1)), step_ns=STEP_NS)
    without_value = np.isnan(computed)
    assert without_value[400:800].any()
    assert np.isfinite(computed[950:]).all()
    assert set(computed[without_value].view(np.uint64).tolist()) == {0x7FF8000000000000}


def test_mu_without_delay_follows_its_input():
    """Only a delay of nothing feeds through, and is declared to."""
    assert EXAMPLES["delays in another order"].regressor().interface.feeds("mu") == ("delta",)
    assert EXAMPLES["two alphas"].regressor().interface.feeds("mu") == ()


@pytest.mark.parametrize("held", [False, True], ids=["lines", "held"])
@pytest.mark.parametrize("P0", [None, 1e3, 1.0], ids=["no prior", "P0 = 1e3", "P0 = 1"])
@pytest.mark.parametrize("name", EXAMPLES)
def test_the_identifier_is_the_least_squares_of_the_theory(name, P0, held):
    """Givens rotations row by row in C give the eta and theta of QR of all rows, at any time."""
    example = EXAMPLES[name]
    start = max(example.delays) + 0.5
    identifier = LeastSquaresIdentifier(example.recovery, start_time=start, P0=P0)
    computed = drive(identifier, example.mu, step_ns=STEP_NS, held=held)
    n_theta = example.recovery.n_theta
    first = round(start / H)
    assert np.isnan(computed[: first + 1]).all()
    for end in (first + 300, len(computed) - 1):
        expected = example.expected(start, end, None if P0 is None else 1.0 / P0, held=held)
        # both solve the factor of the data to rounding times its condition, about 2e2 for the root
        # of 3e4: 1e-13; theta likewise
        np.testing.assert_allclose(
            computed[end, n_theta:], expected[n_theta:], rtol=1e-9, atol=1e-9
        )
        np.testing.assert_allclose(
            computed[end, :n_theta], expected[:n_theta], rtol=1e-9, atol=1e-9
        )
    if P0 is None:
        np.testing.assert_allclose(computed[-1, n_theta:], example.exact_eta(), rtol=1e-9)
        np.testing.assert_allclose(computed[-1, :n_theta], example.thetas, rtol=1e-9)


def test_two_exponentials_of_one_alpha_are_those_of_the_reference(case):
    """C09: theta from the samples, the larger one first."""
    reference = case("C09")
    example = EXAMPLES["two exponentials of one alpha"]
    for times_, values in zip(
        reference["delta_samples"]["t_minus_D"], reference["delta_samples"]["values"], strict=True
    ):
        np.testing.assert_allclose(
            np.exp(-0.1 * np.array(times_)) + np.exp(-0.3 * np.array(times_)),
            values,
            atol=reference["tol"],
        )
    computed = drive(
        LeastSquaresIdentifier(example.recovery, start_time=3.0), example.mu, step_ns=STEP_NS
    )
    np.testing.assert_allclose(
        computed[-1, :2], reference["expected"]["recovered_theta_sorted"][::-1], rtol=1e-9
    )


def test_a_sine_is_that_of_the_reference(case):
    """C08: the rate of a sine of unknown amplitude and phase under a known factor."""
    reference = case("C08")
    example = EXAMPLES["a sine"]
    row = [np.interp(650 - n, range(len(example.t)), example.delta) for n in (0, 50, 100)]
    np.testing.assert_allclose(
        row, reference["delta_samples"]["values"][0], rtol=0, atol=reference["tol"]
    )
    computed = drive(
        LeastSquaresIdentifier(example.recovery, start_time=1.5), example.mu, step_ns=STEP_NS
    )
    assert computed[-1, 0] == pytest.approx(reference["expected"]["omega"], rel=1e-9)


def test_there_is_no_estimate_before_there_is_information():
    """With a prior there is a value from the start time on.

    Without one there is none before as many rows as unknowns came in.
    """
    example = EXAMPLES["two alphas"]
    bare = drive(
        LeastSquaresIdentifier(example.recovery, start_time=3.0),
        example.mu,
        step_ns=STEP_NS,
        held=True,
    )
    assert np.isnan(bare[: 300 + 5]).all()  # five unknowns: the fifth row arrives at 3.0 s + 5 h
    assert np.isfinite(bare[300 + 30 :]).all()
    prior = drive(
        LeastSquaresIdentifier(example.recovery, start_time=3.0, P0=10.0),
        example.mu,
        step_ns=STEP_NS,
    )
    assert np.isnan(prior[:301]).all()
    assert np.isfinite(prior[301:, 2:]).all()


def test_a_disturbance_of_nothing_never_gives_an_estimate():
    """Zero, or so small that its square vanishes: no information, and no 0/0."""
    example = EXAMPLES["two alphas"]
    for scale in (0.0, 1e-180):
        computed = drive(
            LeastSquaresIdentifier(example.recovery, start_time=3.0),
            scale * example.mu,
            step_ns=STEP_NS,
        )
        assert np.isnan(computed).all()
    tiny = np.where(np.arange(len(example.mu))[:, None] < 500, 1e-180, 1.0) * example.mu
    computed = drive(
        LeastSquaresIdentifier(example.recovery, start_time=3.0), tiny, step_ns=STEP_NS
    )
    np.testing.assert_allclose(computed[-1, :2], example.thetas, rtol=1e-9)


def test_no_theta_where_eta_belongs_to_none():
    """A regression with the opposite sign has no logarithm: eta has a value, theta has none."""
    example = EXAMPLES["two alphas"]
    flipped = example.mu * np.array([-1.0, 1, 1, 1, 1, 1])
    computed = drive(
        LeastSquaresIdentifier(example.recovery, start_time=3.0), flipped, step_ns=STEP_NS
    )
    assert np.isnan(computed[-1, :2]).all()
    np.testing.assert_allclose(computed[-1, 2:], -example.exact_eta(), rtol=1e-9)


def test_a_start_time_before_the_longest_delay_stops_the_run():
    """With the reason, and every row up to there."""
    example = EXAMPLES["two alphas"]
    identifier = LeastSquaresIdentifier(example.recovery, start_time=2.5)
    text = r"the regressor has no value at the start time 2\.5 s; start after the longest delay"
    with pytest.raises(Stopped, match=text) as stop:
        drive(identifier, example.mu, step_ns=STEP_NS)
    assert stop.value.failed
    assert stop.value.steps == 250
    assert np.isnan(stop.value.outputs).all()


def test_a_recorded_start_time_is_used():
    """A replay starts where the run did, whatever the design would give now."""
    example = EXAMPLES["two alphas"]
    identifier = LeastSquaresIdentifier(example.recovery, start_time=3.0)
    identifier.prepare(H, np.zeros(6, np.bool_), {"start": np.array([5.0])})
    identifier.initialize(0.0, example.mu[0])
    computed = identifier.advance(example.t, H, example.mu)
    np.testing.assert_allclose(computed[-1], example.expected(5.0, len(example.t) - 1), rtol=1e-9)
    assert np.isnan(computed[499]).all()


@pytest.mark.parametrize("P0", [0.0, -1.0, math.inf, math.nan])
def test_a_prior_that_is_none_is_refused(P0):
    """P0 is positive and finite, or None."""
    with pytest.raises(
        UsageError,
        match=r"P0:.*a finite number.*it for no prior",
    ):
        LeastSquaresIdentifier(EXAMPLES["a sine"].recovery, start_time=2.0, P0=P0)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_identifier_keeps_the_contract_on_data_it_can_use(name):
    """Also once there is information."""
    example = EXAMPLES[name]
    last = max(example.steps) + 30
    start = last * H - 0.2
    check_component(
        lambda: LeastSquaresIdentifier(example.recovery, start_time=start),
        inputs=example.mu[: last + 1],
        h=H,
    )
