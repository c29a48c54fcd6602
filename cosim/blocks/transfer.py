"""Transfer function: a proper quotient of polynomials in s as a linear model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.arrays import Vector
from cosim.core.linear import LinearModel, with_dependencies
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError


def transfer_function(
    numerator: Sequence[float],
    denominator: Sequence[float],
    *,
    steady: bool = False,
    unit: str | None = None,
) -> LinearModel:
    """Build ``y = (b_m s^m + ... + b_0)/(a_n s^n + ... + a_0) u`` in controllable canonical form.

    The states are ``x_i = z^(i)/rate^i`` with ``a_n z^(n) + ... + a_0 z = u``. The rate is the
    largest that a coefficient suggests for the poles, rounded to a power of two: so the companion
    matrix has no entry much larger than its eigenvalues, and the scaling is exact.

    Parameters
    ----------
    numerator, denominator : sequence of float
        Coefficients, that of the highest power first.
    steady : bool
        The initial state is the steady one for the initial input; else it is zero.
    unit : str, optional
        The unit of y.

    Raises
    ------
    UsageError
        If the quotient is not proper or has no pole, a leading coefficient is zero, or there is no
        steady state.
    """
    _check(numerator, denominator)
    n = len(denominator) - 1
    leading = denominator[0]
    a = np.array(denominator[:0:-1]) / leading  # a_0, ..., a_(n-1)
    b = np.zeros(n + 1)
    b[: len(numerator)] = np.array(numerator[::-1]) / leading
    if steady:
        _check_steady(a)
    exponent = _exponent(a)
    powers = np.ldexp(1.0, exponent * np.arange(n))
    A = math.ldexp(1.0, exponent) * np.eye(n, k=1)
    A[-1] = -a * powers / powers[-1]
    B = np.zeros((n, 1))
    B[-1] = 1.0 / powers[-1]
    proper = b[:n] - b[n] * a  # the numerator without the direct feedthrough
    C = (proper * powers)[np.newaxis]
    Xu = np.zeros((n, 1))
    if steady:
        Xu[0] = 1.0 / a[0]
    model = LinearModel(
        Interface((Signal("u"),), (Signal("y", 1, unit),)),
        states=tuple(Signal("x", n).elements),
        A=A,
        B=B,
        C=C,
        D=np.array([[b[n]]]),
        X0=np.zeros(n),
        Xu=Xu,
    )
    return with_dependencies(model)


def _check_steady(a: Vector) -> None:
    if a[0] == 0.0:
        raise UsageError(
            "transfer function: the denominator is zero at s = 0, so there is no steady state; "
            'use initial = "zero"'
        )


def _exponent(a: Vector) -> int:
    """Return the exponent of a power of two near max |a_(n-k)|^(1/k).

    That is near the largest pole: at least half of it, and at most n times (Fujiwara).
    """
    n = len(a)
    exponents = []
    for k in range(1, n + 1):
        _, exponent = math.frexp(a[n - k])
        if a[n - k] != 0.0:
            exponents.append(math.ceil(exponent / k))
    return max(exponents, default=0)


def _check(numerator: Sequence[float], denominator: Sequence[float]) -> None:
    if len(denominator) < 2:
        raise UsageError(
            "transfer function: the denominator is constant; expected a power of s, or the kind "
            "'gain'"
        )
    if not 1 <= len(numerator) <= len(denominator):
        raise UsageError(
            f"transfer function: expected 1 to {len(denominator)} coefficients in the numerator "
            f"(proper), got {len(numerator)}"
        )
    if denominator[0] == 0.0:
        raise UsageError(
            "transfer function: the leading coefficient of the denominator is 0; expected that of "
            "the highest power of s"
        )
