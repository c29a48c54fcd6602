"""Pole placement for observers: L with given eigenvalues of `A - L C`, (A, C) observable.

A state feedback K is the same by duality: `A' - C' K'`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.filters import ignored_warnings
from cosim.theory.plants.descriptor import ComplexVector
from cosim.theory.plants.geometry import RANK_TOLERANCE

# largest error of the characteristic polynomial, with rates relative to the fastest pole
PLACED = 1e-6


@dataclass(frozen=True, slots=True)
class PlacementWords:
    """What messages call the design, its gain, and the rows of C."""

    design: str
    gain: str
    rows: str


OBSERVER: Final = PlacementWords("observer", "L", "outputs")
STATE_FEEDBACK: Final = PlacementWords("state feedback", "K", "inputs")


def place(
    A: Matrix,
    C: Matrix,
    poles: Sequence[complex],
    fixed_modes: ComplexVector,
    words: PlacementWords = OBSERVER,
) -> Matrix:
    """Compute L of (17), shape ``(n, p)``, with the eigenvalues of `A - L C` at ``poles``.

    Parameters
    ----------
    A, C : Matrix
        An observable pair, shapes ``(n, n)`` and ``(p, n)``.
    poles : sequence of complex
        As many as A has rows [1/s].
    fixed_modes : ComplexVector
        The modes outside this pair [1/s], for the messages.
    words : PlacementWords
        For the messages.

    Raises
    ------
    AssumptionError
        If the number of poles is wrong, one is not finite or not stable, complex ones do not come
        in pairs, one is repeated more often than C has independent rows, or the placement is too
        ill conditioned.
    """
    unsorted = np.asarray(poles, dtype=np.complex128)
    wanted = np.sort_complex(unsorted.reshape(-1))
    _check_poles(wanted, len(A), fixed_modes, words)
    if not len(A):
        return np.zeros((0, len(C)))
    left, values, right = np.linalg.svd(C, full_matrices=False)
    largest = values.max(initial=0.0)
    significant = values > RANK_TOLERANCE * largest
    k = int(significant.sum())
    rows = values[:k, None] * right[:k]  # the independent rows of C, C = left rows
    if k == 1:
        gain_vector = _ackermann(A, rows[0], wanted)
        gain = gain_vector[:, None]
    else:
        gain = _place_with_several_outputs(A, rows, wanted, words)
    closed = A - gain @ rows
    _check_placed(A, closed, wanted, words)
    to_rows = left[:, :k].T
    L: Matrix = gain @ to_rows
    return L


def modes(eigenvalues: Sequence[complex] | ComplexVector) -> str:
    """Format eigenvalues for a message: `+1, -2+3j`, or `none`."""
    formatted = [_mode(complex(value)) for value in eigenvalues]
    return ", ".join(formatted) or "none"


def _mode(value: complex) -> str:
    imaginary = f"{value.imag:+.6g}j" if value.imag else ""
    return f"{value.real:+.6g}{imaginary}"


def _check_poles(
    poles: ComplexVector, n: int, fixed_modes: ComplexVector, words: PlacementWords
) -> None:
    if len(poles) != n:
        fixed = modes(fixed_modes)
        raise AssumptionError(
            f"{words.design}: expected {n} poles, as many as {words.gain} can place, got "
            f"{len(poles)}; fixed: {fixed}"
        )
    finite = np.isfinite(poles)
    stable = poles.real < 0.0
    if not (finite & stable).all():
        raise AssumptionError(
            f"{words.design}: expected finite poles with negative real parts, got {modes(poles)}"
        )
    given = Counter(poles.tolist())
    conjugates = Counter(poles.conj().tolist())
    missing = list((conjugates - given).elements())
    if missing:
        raise AssumptionError(
            f"{words.design}: poles {modes(poles)}; complex poles come in conjugate pairs, and "
            f"{modes(missing)} is missing"
        )


def _check_placed(A: Matrix, closed: Matrix, wanted: ComplexVector, words: PlacementWords) -> None:
    """Check the characteristic polynomial of ``closed = A - L C`` against that of the poles."""
    eigenvalues = np.linalg.eigvals(closed).astype(np.complex128)
    placed = np.sort_complex(eigenvalues)
    scale = np.abs(wanted).max()
    reached = np.poly(placed / scale)
    needed = np.poly(wanted / scale)
    if not np.allclose(reached, needed, rtol=PLACED, atol=PLACED):
        open_loop = modes(np.linalg.eigvals(A).astype(np.complex128))
        raise AssumptionError(
            f"{words.design}: poles {modes(wanted)} cannot be placed accurately, got "
            f"{modes(placed)}; choose poles further apart or closer to {open_loop}"
        )


def _ackermann(A: Matrix, c: Vector, poles: ComplexVector) -> Vector:
    """Compute the gain for one output row c by Ackermann's formula, shape ``(n,)``.

    The gain is `phi(A) O^-1 (0, ..., 0, 1)'` with the observability matrix O and phi the polynomial
    with the given roots. It allows poles of any multiplicity.
    """
    n = len(A)
    rows = [c @ np.linalg.matrix_power(A, k) for k in range(n)]
    observability = np.array(rows)
    last_unit = np.eye(n)[-1]
    last = np.linalg.solve(observability, last_unit)
    for pole in poles:  # phi(A) in real factors: one per real pole, one per conjugate pair
        shifted = A @ last
        if pole.imag == 0.0:
            last = shifted - pole.real * last
        elif pole.imag > 0.0:
            linear = 2.0 * pole.real * shifted
            constant = abs(pole) ** 2 * last
            last = A @ shifted - linear + constant
    return last


def _place_with_several_outputs(
    A: Matrix, rows: Matrix, poles: ComplexVector, words: PlacementWords
) -> Matrix:
    """Compute the gain, shape ``(n, k)``, for k independent output rows (Tits and Yang)."""
    most_common = Counter(poles.tolist()).most_common(1)
    pole, multiplicity = most_common[0]
    k = len(rows)
    if multiplicity > k:
        repeated = modes([pole])
        raise AssumptionError(
            f"{words.design}: expected a pole at most {k} times, the number of independent "
            f"{words.rows}, got {repeated} {multiplicity} times"
        )
    from scipy.signal import place_poles  # takes 0.5 s to import, and is rarely needed

    with ignored_warnings():  # of poles that it did not reach, which is checked afterwards
        placement = place_poles(A.T, rows.T, poles)
    gain: Matrix = placement.gain_matrix.T
    return gain
