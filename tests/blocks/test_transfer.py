"""Transfer functions against closed forms, and discrete-time systems against their recursion."""

import numpy as np
import pytest
from mpmath import mp

from cosim.blocks.state_space import DiscreteStateSpace, system_matrices
from cosim.blocks.transfer import transfer_function
from cosim.core.linear import Linear
from cosim.errors import UsageError
from tests.blocks.stepping import drive, times


def test_the_step_response_of_an_oscillator_is_exact():
    """1/(s^2 + 2 d w s + w^2) w^2 with d = 0.2: overshoots as Ogata's closed form says."""
    damping, rate = 0.2, 300.0
    model = transfer_function([rate**2], [1.0, 2.0 * damping * rate, rate**2])
    y = drive(Linear(model), np.ones((101, 1)), held=True)[:, 0]
    root = np.sqrt(1.0 - damping**2)
    phase = rate * root * times(100)
    decay = np.exp(-damping * rate * times(100))
    expected = 1.0 - decay * (np.cos(phase) + damping / root * np.sin(phase))
    np.testing.assert_allclose(y, expected, rtol=0, atol=100 * 2.3e-16 * 3)


def test_a_proper_one_feeds_through():
    """(2 s + 3)/(s + 10) for a ramp u = t: 0.3 t + 0.17 (1 - exp(-10 t)), with D = 2."""
    model = transfer_function([2.0, 3.0], [1.0, 10.0])
    assert model.D == 2.0
    assert model.interface.feeds("y") == ("u",)
    t = times(300)
    y = drive(Linear(model), t[:, None])[:, 0]
    np.testing.assert_allclose(y, 0.3 * t - 0.17 * np.expm1(-10.0 * t), rtol=0, atol=300 * 2.3e-16)
    assert transfer_function([1.0], [1.0, 1.0]).interface.feeds("y") == ()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("order", [2, 5, 8])
def test_the_frequency_response_is_that_of_the_polynomials(order, scale):
    """C (s - A)^-1 B + D is the quotient, whatever the scale of time and of the coefficients."""
    poles = -scale * np.logspace(-1.0, 1.0, order)
    denominator = 3.0 * np.poly(poles)
    numerator = 0.5 * np.poly(-scale * np.linspace(0.2, 2.0, order))
    model = transfer_function(list(numerator), list(denominator))
    for frequency in scale * np.logspace(-2.0, 2.0, 9):
        s = 1j * frequency
        resolvent = np.linalg.solve(s * np.eye(order) - model.A, model.B)
        found = (model.C @ resolvent + model.D)[0, 0]
        expected = np.polyval(numerator, s) / np.polyval(denominator, s)
        assert abs(found - expected) <= 1e-10 * abs(expected)


def test_the_matrix_has_no_entry_far_beyond_its_eigenvalues():
    """Without the scaling the norm of that of 8 poles near 1e6 were 1e48, and its exponential off.

    The step response is the sum of the partial fractions.
    """
    poles = -1e6 * np.linspace(1.0, 2.0, 8)
    denominator = np.poly(poles)
    model = transfer_function([denominator[-1]], list(denominator))
    # Fujiwara: the largest pole is at least 1/n of the rate, and at most twice that
    assert abs(model.A).sum(axis=1).max() <= 2 * 8 * 8 * 2e6
    y = drive(Linear(model), np.ones((21, 1)), step_ns=1000, held=True)[:, 0]
    expected = step_response(denominator, poles, times(20, 1000))
    # 1e-16 of the norm of h A, which is 130, a step
    np.testing.assert_allclose(y, expected, rtol=0, atol=20 * 130 * 2.3e-16)


def step_response(denominator, poles, t):
    """Sum the partial fractions of a_0/denominator, with 60 digits; ``poles`` are near its own."""
    with mp.workdps(60):
        coefficients = [mp.mpf(a) for a in denominator]

        def polynomial(s):
            value = mp.mpf(0)
            for coefficient in coefficients:
                value = value * s + coefficient
            return value

        rows = np.zeros(len(t))
        for start in poles:
            pole = mp.findroot(polynomial, start, solver="newton", tol=1e-60, verify=False)
            residue = coefficients[-1] / mp.diff(polynomial, pole)
            terms = [residue / pole * mp.expm1(pole * instant) for instant in map(mp.mpf, t)]
            rows = rows + np.array(terms)
    return rows.astype(np.float64)


def test_a_steady_one_begins_without_a_transient():
    """With constant inputs it stays at numerator(0)/denominator(0)."""
    model = transfer_function([2.0, 6.0], [1.0, 40.0, 4.0], steady=True)
    assert model.interface.feeds_initially("y") == ("u",)
    y = drive(Linear(model), np.full((50, 1), 2.0))
    np.testing.assert_allclose(y, 3.0, rtol=0, atol=50 * 3 * 2.3e-16)
    assert drive(Linear(transfer_function([1.0], [1.0, 1.0])), np.ones((2, 1)))[0] == 0.0


@pytest.mark.parametrize(
    ("numerator", "denominator", "steady", "text"),
    [
        ([1.0], [2.0], False, r"denominator.*power of s"),
        (
            [1.0, 0.0, 0.0],
            [1.0, 1.0],
            False,
            "1 to 2 coefficients.* (proper), got 3",
        ),
        ([], [1.0, 1.0], False, r"2 coefficients.*0"),
        ([1.0], [0.0, 1.0, 1.0], False, "coefficient of the denominator is 0"),
        ([1.0], [1.0, 0.0], True, r'is zero.*=.*so there is no steady state.*initial = "zero"'),
    ],
)
def test_only_proper_transfer_functions_are_taken(numerator, denominator, steady, text):
    with pytest.raises(UsageError, match=text.replace("(proper)", r"\(proper\)")):
        transfer_function(numerator, denominator, steady=steady)


def test_a_discrete_time_system_is_its_recursion():
    """The sum in the order of the matrices, with the same bits."""
    A = np.array([[0.5, 0.25], [-1.0, 0.75]])
    B = np.array([[1.0], [0.3]])
    C = np.array([[0.2, -1.0]])
    D = np.array([[0.1]])
    u = np.random.default_rng(2).standard_normal((40, 1))
    system = system_matrices("test", A=A, B=B, C=C, D=D, x0=np.array([1.0, 2.0]))
    rows = drive(DiscreteStateSpace(system), u)
    x = [1.0, 2.0]
    for k, (value,) in enumerate(u):
        assert rows[k, 0] == 0.0 + 0.2 * x[0] + -1.0 * x[1] + 0.1 * value
        assert rows[k, 1:].tolist() == x
        x = [
            0.0 + 0.5 * x[0] + 0.25 * x[1] + 1.0 * value,
            0.0 + -1.0 * x[0] + 0.75 * x[1] + 0.3 * value,
        ]
