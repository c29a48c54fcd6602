"""Pole placement for observers: L with given eigenvalues of `A - L C`, (A, C) observable."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.descriptor import ComplexVector
from cosim.theory.geometry import RANK_TOLERANCE

PLACED = 1e-6  # largest error of the characteristic polynomial, rates relative to the fastest pole, that still counts as placed


def place(A: Matrix, C: Matrix, poles: Sequence[complex], fixed_modes: ComplexVector) -> Matrix:
    """Give L, shape ``(n, p)``, with the eigenvalues of `A - L C` at ``poles``.

    Parameters
    ----------
    A, C : Matrix
        An observable pair, shapes ``(n, n)`` and ``(p, n)``.
    poles : sequence of complex
        As many as A has rows [1/s].
    fixed_modes : ComplexVector
        The modes outside this pair, for the messages.

    Raises
    ------
    AssumptionError
        If the number of poles is wrong, one is not stable, complex ones do not come in pairs, one is repeated more often than C
        has independent rows, or the placement is too ill conditioned.
    """
    n = len(A)
    wanted = np.sort_complex(np.asarray(poles, dtype=np.complex128).reshape(-1))
    _need_placeable(wanted, n, fixed_modes)
    left, values, right = np.linalg.svd(C, full_matrices=False)
    k = int((values > RANK_TOLERANCE * values.max(initial=0.0)).sum())
    rows = values[:k, None] * right[:k]  # the independent rows of C, C = left rows
    if k == 1:
        gain = _ackermann(A, rows[0], wanted)[:, None]
    else:
        pole, times = Counter(wanted.tolist()).most_common(1)[0]
        if times > k:
            raise AssumptionError(
                f"(17): pole {modes([pole])} is given {times} times; needed at most {k}, the number of independent outputs"
            )
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # what it warns of, a placement not reached, is checked below
            from scipy.signal import place_poles  # half a second to import, and seldom needed

            gain = place_poles(A.T, rows.T, wanted).gain_matrix.T
    placed = np.sort_complex(np.linalg.eigvals(A - gain @ rows).astype(np.complex128))
    scale = np.abs(wanted).max()
    if not np.allclose(np.poly(placed / scale), np.poly(wanted / scale), rtol=PLACED, atol=PLACED):
        raise AssumptionError(
            f"(17): poles {modes(wanted)} cannot be placed accurately, found {modes(placed)}; choose poles further apart or "
            f"closer to {modes(np.linalg.eigvals(A).astype(np.complex128))}"
        )
    L: Matrix = gain @ left[:, :k].T
    return L


def modes(eigenvalues: Sequence[complex] | ComplexVector) -> str:
    """Write eigenvalues for a message: `+1, -2+3j`, or `none`."""
    return (
        ", ".join(
            f"{mode.real:+.6g}" + (f"{mode.imag:+.6g}j" if mode.imag else "")
            for mode in map(complex, eigenvalues)
        )
        or "none"
    )


def _need_placeable(poles: ComplexVector, n: int, fixed_modes: ComplexVector) -> None:
    if len(poles) != n:
        raise AssumptionError(
            f"(17): {len(poles)} poles given; needed {n}, as many as L can place; fixed: {modes(fixed_modes)}"
        )
    if not np.isfinite(poles).all() or (poles.real >= 0.0).any():
        raise AssumptionError(
            f"(17): poles {modes(poles)}; needed finite poles with negative real parts"
        )
    if not np.array_equal(poles, np.sort_complex(poles.conj())):
        raise AssumptionError(f"(17): poles {modes(poles)}; complex poles come in conjugate pairs")


def _ackermann(A: Matrix, c: Vector, poles: ComplexVector) -> Vector:
    """Ackermann's formula for one output: `phi(A) O^-1 (0, ..., 0, 1)'`, phi the polynomial with the given roots."""
    n = len(A)
    observability = np.array([c @ np.linalg.matrix_power(A, k) for k in range(n)])
    last = np.linalg.solve(observability, np.eye(n)[-1])
    for pole in poles:  # phi(A) in real factors: one per real pole, one per conjugate pair
        if pole.imag == 0.0:
            last = A @ last - pole.real * last
        elif pole.imag > 0.0:
            last = A @ (A @ last) - 2.0 * pole.real * (A @ last) + abs(pole) ** 2 * last
    return last
