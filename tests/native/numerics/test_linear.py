"""Matrix exponential, discretization, and sums in a fixed order."""

import math
from fractions import Fraction

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cosim.core.linear import Linear, LinearModel, with_dependencies
from cosim.core.signals import Interface, Signal
from cosim.native.numerics.linear import (
    affine,
    first_order_hold,
    first_order_holds,
    invert,
    matrix_exponential,
)
from tests.blocks.stepping import drive

EPS = np.finfo(np.float64).eps
finite = st.floats(-4.0, 4.0)
squares = st.integers(1, 6).flatmap(lambda n: arrays(np.float64, (n, n), elements=finite))


def exact_exponential(M):
    """Sum the series in integers of 400 bits.

    Its terms are at most 24^k / k!, so that 150 of them leave less than 1e-55.
    """
    one = 1 << 400
    P = np.array([[int(Fraction(float(x)) * one) for x in row] for row in M], dtype=object)
    E = term = np.array(
        [[one * (i == j) for j in range(len(M))] for i in range(len(M))], dtype=object
    )
    for k in range(1, 151):
        term = (term @ P) // (k * one)
        E = E + term
    return (E / one).astype(np.float64)


@settings(deadline=None)
@given(squares)
def test_exponential_agrees_with_exact_arithmetic(M):
    """Any matrix of norm up to 24."""
    norm = np.linalg.norm(M, np.inf)
    scale = np.linalg.norm(exact_exponential(np.abs(M)), np.inf)  # bounds every partial sum
    # a product rounds n times; each squaring doubles the errors before it, which makes n norm of
    # the first
    np.testing.assert_allclose(
        matrix_exponential(M),
        exact_exponential(M),
        rtol=0,
        atol=4 * len(M) * max(norm, 1.0) * EPS * scale,
    )


def test_exponential_agrees_with_scipy():
    """A symmetric matrix with the eigenvalues 0 and 4: (e^4 + 1)/2 and (e^4 - 1)/2, too."""
    computed = matrix_exponential(np.full((2, 2), 2.0))
    e4 = math.exp(4.0)
    expected = [[(e4 + 1) / 2, (e4 - 1) / 2], [(e4 - 1) / 2, (e4 + 1) / 2]]
    np.testing.assert_allclose(computed, expected, rtol=32 * EPS)  # norm 4: three squarings
    np.testing.assert_allclose(
        computed, scipy.linalg.expm(np.full((2, 2), 2.0)), rtol=1e-12
    )  # scipy's own error here: 5e-13


@given(st.floats(-50.0, 50.0))
def test_exponential_of_a_rotation_is_a_rotation(angle):
    """The entries are cosine and sine of the angle.

    Their error is the angle's own last bit, and one rounding in each squaring, which doubles the
    errors before.
    """
    computed = matrix_exponential(np.array([[0.0, -angle], [angle, 0.0]]))
    expected = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    np.testing.assert_allclose(computed, expected, rtol=0, atol=8 * EPS * max(abs(angle), 1.0))


def test_exponential_of_a_nilpotent_matrix_is_its_series():
    """I + N + N^2/2 with N^3 = 0: small numbers, exact up to a last bit."""
    N = np.array([[0.0, 2.0, 5.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        matrix_exponential(N),
        [[1.0, 2.0, 8.0], [0.0, 1.0, 3.0], [0.0, 0.0, 1.0]],
        rtol=4 * EPS,
        atol=0,
    )


def test_exponential_of_zero_is_the_identity():
    """Exactly, also of nothing."""
    assert (matrix_exponential(np.zeros((4, 4))) == np.eye(4)).all()
    assert matrix_exponential(np.zeros((0, 0))).shape == (0, 0)


def test_a_slow_mode_beside_a_fast_one_keeps_its_digits():
    """Twenty squarings for the fast mode cost the slow one a few last bits, not a million."""
    computed = matrix_exponential(np.diag([-1e6, -1.0, -1e-6, 0.0]))
    np.testing.assert_allclose(
        np.diag(computed)[1:], np.exp([-1.0, -1e-6, 0.0]), rtol=24 * EPS
    )  # one rounding a squaring
    assert abs(computed[0, 0]) < 24 * EPS
    assert (computed[~np.eye(4, dtype=bool)] == 0.0).all()


def test_matrices_of_integers_are_taken_as_numbers():
    """They are converted, not read as if they were doubles."""
    assert (
        matrix_exponential(np.array([[0, 1], [0, 0]])) == np.array([[1.0, 1.0], [0.0, 1.0]])
    ).all()
    discrete = first_order_hold(np.array([[0]]), np.array([[2]]), 0.5, np.array([True]))
    assert (discrete.Ad, discrete.B0, discrete.B1) == ([[1.0]], [[1.0]], [[0.0]])
    transposed = np.array([[0.0, 0.0], [1.0, 0.0]]).T
    assert (matrix_exponential(transposed) == [[1.0, 1.0], [0.0, 1.0]]).all()


@pytest.mark.parametrize("rate", [1e-3, 1.0, 50.0, 1000.0])
def test_first_order_hold_is_the_closed_form(rate):
    """x' = -a x + u with z = a h, both columns side by side.

    Zero-order hold: B0 = (1 - e^-z)/a; linear interpolation: B1 = (z - 1 + e^-z)/(a z).
    """
    h = 0.01
    n = 2
    z = rate * h
    computed = first_order_hold(np.array([[-rate]]), np.ones((1, n)), h, np.array([False, True]))
    whole = -math.expm1(-z) / rate
    end = (
        (0.5 * z - z**2 / 6 + z**3 / 24 - z**4 / 120) / rate
        if z < 1e-3
        else (z + math.expm1(-z)) / (rate * z)
    )
    # one rounding of numbers of size h in each of a few squarings
    atol = 32 * EPS * h
    np.testing.assert_allclose(computed.Ad, math.exp(-z), rtol=0, atol=32 * EPS)
    np.testing.assert_allclose(computed.B0, [[whole - end, whole]], rtol=0, atol=atol)
    np.testing.assert_allclose(computed.B1, [[end, 0.0]], rtol=0, atol=atol)
    assert computed.B1[0, 1] == 0.0


def test_a_double_integrator_is_discretized_exactly():
    """x1' = x2, x2' = u interpolated linearly: h^2/3 u0 + h^2/6 u1 and h/2 (u0 + u1)."""
    h = 0.5
    computed = first_order_hold(
        np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), h, np.array([False])
    )
    np.testing.assert_allclose(computed.Ad, [[1.0, h], [0.0, 1.0]], rtol=2 * EPS)
    np.testing.assert_allclose(computed.B0, [[h**2 / 3], [h / 2]], rtol=4 * EPS)
    np.testing.assert_allclose(computed.B1, [[h**2 / 6], [h / 2]], rtol=4 * EPS)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(squares, st.data())
def test_first_order_hold_agrees_with_quadrature(A, data):
    """Any matrix: Ad = e^(hA), B0 + B1 = int e^(As) ds B and B1 = int e^(As) (1 - s/h) ds B.

    The integrals are computed by Gauss-Legendre.
    """
    n = len(A)
    h = 0.25
    B = data.draw(arrays(np.float64, (n, 2), elements=finite))
    computed = first_order_hold(A, B, h, np.array([False, True]))
    x, w = np.polynomial.legendre.leggauss(
        20
    )  # 20 points are exact to degree 39: (norm h)^40 / 40! < 1e-16
    nodes = h * (x + 1) / 2
    weights = h * w / 2
    flows = np.array([exact_exponential(A * s) @ B for s in nodes])
    whole = np.tensordot(weights, flows, 1)
    end = np.tensordot(weights * (1 - nodes / h), flows, 1)
    atol = (
        64
        * EPS
        * np.linalg.norm(exact_exponential(np.abs(A) * h), np.inf)
        * (1 + h * np.abs(B).sum())
    )
    np.testing.assert_allclose(computed.Ad, exact_exponential(A * h), rtol=0, atol=atol)
    np.testing.assert_allclose(
        computed.B0, np.column_stack([(whole - end)[:, 0], whole[:, 1]]), rtol=0, atol=atol
    )
    np.testing.assert_allclose(
        computed.B1, np.column_stack([end[:, 0], np.zeros(n)]), rtol=0, atol=atol
    )


def augmented(A, B, h):
    """Return the generator of the state beside an input that is a straight line, and its slope."""
    n, m = B.shape
    M = np.zeros((n + 2 * m, n + 2 * m))
    M[:n, :n] = h * A
    M[:n, n : n + m] = h * B
    M[n : n + m, n + m :] = np.eye(m)
    return M


def test_a_discretization_is_the_exponential_of_the_augmented_matrix_bit_by_bit():
    """What is not computed is 0 or 1: of any sizes, stiff, singular, of short and long steps."""
    different = [seed for seed in range(60) if not has_bits_of_the_exponential(seed)]
    assert different == []


def has_bits_of_the_exponential(seed):
    """Compare the discretizations of random systems with the exponentials."""
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 6), rng.integers(0, 5)
    A = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-8.0, 4.0)
    B = rng.standard_normal((n, m)) * 10.0 ** rng.uniform(-6.0, 6.0)
    if seed % 2:
        A = -A @ A.T / np.abs(A).max(initial=1e-300)
    A[rng.random((n, n)) < 0.3] = 0.0
    B[rng.random((n, m)) < 0.3] = 0.0
    held = rng.random(m) < 0.4
    steps = 10.0 ** rng.uniform(-9.0, -3.0, 3)
    for h, *computed in zip(steps, *first_order_holds(A, B, steps, held), strict=True):
        E = matrix_exponential(augmented(A, B, h))
        whole = E[:n, n : n + m]
        slope = E[:n, n + m :]
        starts = np.where(held, whole, whole - slope)
        expected = (E[:n, :n], starts, np.where(held, 0.0, slope))
        for found, needed in zip(computed, expected, strict=True):
            if np.ascontiguousarray(found).tobytes() != np.ascontiguousarray(needed).tobytes():
                return False
    return True


@pytest.mark.parametrize("h", [1e-9, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    "A",
    [
        pytest.param([[-1e5, 1.0], [0.0, -1e-2]], id="stiff"),
        pytest.param([[0.0, 1.0], [0.0, 0.0]], id="double integrator"),
        pytest.param([[-2.0, 1.0], [-4.0, 2.0]], id="nilpotent, no triangle"),
        pytest.param([[-1.0, 50.0], [-50.0, -1.0]], id="oscillator"),
        pytest.param([[0.02, 0.0], [1.0, -3.0]], id="unstable"),
    ],
)
def test_steps_of_any_length_agree_with_sixty_digits(A, h):
    """The exponential of mpmath; each squaring rounds exp - I once, an oscillator keeps errors."""
    mpmath = pytest.importorskip("mpmath")
    A = np.array(A)
    B = np.array([[1.0, 0.5], [-0.3, 2.0]])
    held = np.array([False, True])
    with mpmath.workdps(60):
        exact = mpmath.expm(mpmath.matrix(A) * mpmath.mpf(h))
        inputs = mpmath.zeros(6, 6)
        inputs[0:2, 0:2] = mpmath.matrix(A) * mpmath.mpf(h)
        inputs[0:2, 2:4] = mpmath.matrix(B) * mpmath.mpf(h)
        inputs[2, 4] = inputs[3, 5] = mpmath.mpf(1)
        whole = mpmath.expm(inputs)
        Ad = np.array(exact.tolist(), np.float64)
        E = np.array(whole.tolist(), np.float64)
    expected = (Ad, [[E[0, 2] - E[0, 4], E[0, 3]], [E[1, 2] - E[1, 4], E[1, 3]]])
    computed = first_order_hold(A, B, h, held)
    turns = 50.0 * h if A[0, 1] == 50.0 else 1.0
    sizes = (max(1.0, np.abs(Ad).max()), np.abs(expected[1]).max())
    for found, needed, size in zip((computed.Ad, computed.B0), expected, sizes, strict=True):
        atol = 64 * EPS * max(turns, 1.0) * size
        np.testing.assert_allclose(found, needed, rtol=0, atol=atol)


def dirty_derivative(rate):
    """Return q' = rate (u - q) with the outputs rate (u - q), fresh, and q (19)."""
    model = LinearModel(
        Interface((Signal("u"),), (Signal("fresh"), Signal("q"))),
        states=("q",),
        A=np.array([[-rate]]),
        B=np.array([[rate]]),
        C=np.array([[-rate], [1.0]]),
        D=np.array([[rate], [0.0]]),
        X0=np.zeros(1),
        Xu=np.zeros((1, 1)),
    )
    return Linear(with_dependencies(model))


@pytest.mark.parametrize(
    "key",
    [
        "lambda_f=1000,H=0.0001",
        "lambda_f=1000,H=0.001",
        "lambda_f=1000,H=0.01",
        "lambda_f=100,H=0.01",
    ],
)
def test_the_dirty_derivative_of_a_ramp_is_one_only_with_linear_interpolation(case, key):
    """C06: a zero-order hold over-reads a ramp by z/(1 - e^-z), or under-reads it with old outputs.

    Linear interpolation gives 1.
    """
    reference = case("C06")
    rate, h = (float(part.split("=")[1]) for part in key.split(","))
    steps = max(40, math.ceil(40.0 / (rate * h)))  # e^-40 of the transient is left
    u = (np.arange(steps + 1) * h)[:, None]
    expected = reference["expected_gain"][key]
    zero_order, linear = (
        drive(dirty_derivative(rate), u, step_ns=round(h * 1e9), held=held)
        for held in (True, False)
    )
    stale = rate * (u[-2, 0] - zero_order[-1, 1])
    assert abs(zero_order[-1, 0] - expected["zoh_fresh_output"]) <= reference["tol"]
    assert abs(stale - expected["zoh_stale_output"]) <= reference["tol"]
    assert abs(linear[-1, 0] - expected["foh"]) <= reference["tol"]


@given(st.integers(1, 5), st.integers(1, 5), st.integers(0, 3), st.data())
def test_affine_gives_the_bits_of_a_plain_loop(rows, columns, more, data):
    """From left to right, one pair after the other, no fused operation, no blocks."""
    numbers = st.floats(-1e3, 1e3)
    shapes = [((rows, n), (n,)) for n in (columns, more)]
    pairs = [
        tuple(data.draw(arrays(np.float64, shape, elements=numbers)) for shape in pair)
        for pair in shapes
    ]
    expected = []
    for i in range(rows):
        total = 0.0
        for M, v in pairs:
            for j in range(len(v)):
                total += float(M[i, j]) * float(v[j])
        expected.append(total)
    assert (affine(pairs).view(np.uint64) == np.array(expected).view(np.uint64)).all()


def test_the_inverse_is_the_inverse():
    """The product is I to the condition of the matrix times rounding; pivots may be zero."""
    rng = np.random.default_rng(3)
    for n in (1, 2, 5, 12):
        M = rng.standard_normal((n, n))
        M[0, 0] = 0.0 if n > 1 else 3.0
        error = abs(M @ invert(M) - np.eye(n)).max()
        assert error < 20.0 * n * np.linalg.cond(M) * np.finfo(np.float64).eps


def test_a_singular_matrix_has_no_inverse():
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        invert(np.array([[1.0, 2.0], [2.0, 4.0]]))
