"""The methods of identification as components: the arithmetic of the theory, step by step."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.blocks.adaptive_identifier import AdaptiveIdentifier
from cosim.blocks.estimator import Estimator
from cosim.core.contracts import Stopped
from cosim.errors import UsageError
from cosim.testing import check_component
from tests.blocks.examples import EXAMPLES, STEP_NS, H
from tests.blocks.stepping import drive
from tests.theory.estimators.passes import drem, gradient

LAWS = ("gradient", "drem")


def adaptive(name, law, *, start=3.5, gain=2.0, forgetting=5.0):
    recovery = EXAMPLES[name].recovery
    method = AdaptiveIdentifier(
        law=law, recovery=recovery, start_time=start, gain=gain, forgetting=forgetting
    )
    return Estimator(method)


def rows(example, start):
    first = round(start / H)
    return example.t[first:], example.mu[first:]


@pytest.mark.parametrize("law", LAWS)
def test_an_adaptive_law_keeps_the_contract_of_a_component(law):
    """Any blocks, any holds, going back."""
    inputs = np.random.default_rng(1).standard_normal((31, 6))
    check_component(lambda: adaptive("two alphas", law, start=5e-3), inputs=inputs)


@pytest.mark.parametrize(("law", "function"), [("gradient", gradient), ("drem", drem)])
def test_an_adaptive_law_is_that_of_the_theory(law, function):
    """The component that takes row after row ends with the bits of the pass over all rows."""
    example = EXAMPLES["two alphas"]
    computed = drive(adaptive("two alphas", law, gain=3.0), example.mu, step_ns=STEP_NS)
    t, mu = rows(example, 3.5)
    options = {"gain": 3.0} if law == "gradient" else {"gain": 3.0, "forgetting": 5.0}
    expected = function(t, mu, example.recovery, **options)
    np.testing.assert_array_equal(computed[-1], [*expected.theta[-1], *expected.eta[-1]])
    assert np.isnan(computed[:351]).all()


def interpolated(t, mu):
    def at(time):
        return np.array([np.interp(time, t, column) for column in mu.T])

    return at


def test_the_gradient_follows_its_differential_equation():
    """eta' = gain m (p - m'eta) / m'm, by another solver: the error is of second order in h."""
    example = EXAMPLES["two alphas"]
    t, mu = rows(example, 3.5)
    at = interpolated(t, mu)

    def rate(time, eta):
        row = at(time)
        m = row[1:]
        return 2.0 * m * (-row[0] - m @ eta) / (m @ m)

    end = 301
    solution = solve_ivp(rate, (t[0], t[end - 1]), np.zeros(5), rtol=1e-8, atol=1e-10, max_step=H)
    computed = gradient(t[:end], mu[:end], example.recovery, gain=2.0)
    # (gain h)^2 = 4e-4 of a step, less over steps whose directions hardly differ
    np.testing.assert_allclose(computed.eta[-1], solution.y[:, -1], atol=1e-4)


def test_mixing_is_that_of_the_adjugate():
    """Every eta_i follows adj(Omega) Y over det Omega, by the filters' differential equations."""
    example = EXAMPLES["two alphas"]
    t, mu = rows(example, 3.5)
    at = interpolated(t, mu)

    def rate(time, state):
        row = at(time)
        m = row[1:]
        Omega = state[:25].reshape(5, 5)
        growth = np.outer(m, m) - Omega / 5.0
        return np.concatenate([growth.ravel(), -m * row[0] - state[25:] / 5.0])

    end = 601
    solution = solve_ivp(rate, (t[0], t[end - 1]), np.zeros(30), rtol=1e-10, atol=1e-14, max_step=H)
    Omega = solution.y[:25, -1].reshape(5, 5)
    Y = solution.y[25:, -1]
    mixed = []
    for i in range(5):
        replaced = Omega.copy()
        replaced[:, i] = Y
        mixed.append(np.linalg.det(replaced) / np.linalg.det(Omega))
    # so large a gain that eta is what was mixed last
    computed = drem(t[:end], mu[:end], example.recovery, gain=1e9, forgetting=5.0)
    # on exact data the mixed eta is the exact one, whatever the filters
    np.testing.assert_allclose(computed.eta[-1], mixed, rtol=1e-5)
    np.testing.assert_allclose(computed.eta[-1], example.exact_eta(), rtol=1e-7)


@pytest.mark.parametrize("name", EXAMPLES)
def test_extension_and_mixing_converges_on_exact_data(name):
    """theta of every form of recovery; without forgetting."""
    example = EXAMPLES[name]
    t, mu = rows(example, max(example.delays) + 0.5)
    computed = drem(t, mu, example.recovery, gain=100.0, forgetting=np.inf)
    # Omega has the square of the condition of its rows: 1e-16 * 3e4^2 at most
    np.testing.assert_allclose(computed.theta[-1], example.thetas, rtol=1e-7)


@pytest.mark.parametrize("law", LAWS)
def test_an_adaptive_law_says_nothing_without_information(law):
    """Zero, or fewer rows than unknowns; the unit of delta does not matter."""
    example = EXAMPLES["two alphas"]
    assert np.isnan(drive(adaptive("two alphas", law), 0.0 * example.mu, step_ns=STEP_NS)).all()
    computed = drive(adaptive("two alphas", law), example.mu, step_ns=STEP_NS, held=True)
    assert np.isnan(computed[: 350 + 5]).all()
    scaled = drive(adaptive("two alphas", law), 2.0**40 * example.mu, step_ns=STEP_NS, held=True)
    np.testing.assert_array_equal(scaled, computed)


@pytest.mark.parametrize("law", LAWS)
def test_an_adaptive_law_stops_where_the_regressor_has_no_value(law):
    """As least squares does."""
    with pytest.raises(Stopped, match=r"at 2\.5 s"):
        drive(adaptive("two alphas", law, start=2.5), EXAMPLES["two alphas"].mu, step_ns=STEP_NS)


def test_gains_that_make_no_law_are_refused():
    """With the value and what is needed."""
    with pytest.raises(UsageError, match=r"gain:.*0\.0 1/s"):
        adaptive("two alphas", "gradient", gain=0.0)
    with pytest.raises(UsageError, match=r"forgetting: .*> 0, got nan s"):
        adaptive("two alphas", "drem", forgetting=np.nan)
