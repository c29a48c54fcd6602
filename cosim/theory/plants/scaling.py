"""Units in which a descriptor system is of size one, so that its ranks do not rest on units.

Rows (equations, outputs) and columns (states, inputs) of::

    [ E/T and A   B ]
    [     C       D ]

are divided by powers of two until the largest entry of each is about one. T is a time, of which
E x' is as large as A x. The powers round nothing.

Where E is the identity and is to stay so, a state and its equation have one scale:
:func:`state_space_scales`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError

MOST_SWEEPS: Final = 60  # each halves the exponents that are left
NEGLIGIBLE: Final = 1e-13  # of the largest entry: it may be rounding
COARSE: Final = 10.0  # binary digits of a coarse scale


@contextmanager
def within_range() -> Iterator[None]:
    """Refuse a computation that leaves the range of numbers.

    Raises
    ------
    AssumptionError
        If a number becomes too large, or one to divide by too small.
    """
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            yield
    except FloatingPointError as error:
        raise AssumptionError(
            f"the matrices have numbers too large or too small to compute with ({error}); choose "
            "other units"
        ) from error


@dataclass(frozen=True, eq=False)
class Scales:
    """The size of each equation, state, input and output, powers of two.

    Parameters
    ----------
    equations, states, inputs, outputs : Vector, shapes (n,), (n,), (m,), (p,)
    """

    equations: Vector
    states: Vector
    inputs: Vector
    outputs: Vector

    def coarse(self) -> Scales:
        """Return the scales in powers of 1024: what is of usual size keeps it, bit for bit."""
        return Scales(
            equations=_coarse(self.equations),
            states=_coarse(self.states),
            inputs=_coarse(self.inputs),
            outputs=_coarse(self.outputs),
        )

    def scaled_E(self, E: Matrix) -> Matrix:
        """Return E, or A, between scaled states and equations."""
        return E * self.states / self.equations[:, np.newaxis]

    def scaled_B(self, B: Matrix) -> Matrix:
        """Return B between scaled inputs and equations."""
        return B * self.inputs / self.equations[:, np.newaxis]

    def scaled_C(self, C: Matrix) -> Matrix:
        """Return C between scaled states and outputs."""
        return C * self.states / self.outputs[:, np.newaxis]

    def scaled_D(self, D: Matrix) -> Matrix:
        """Return D between scaled inputs and outputs."""
        return D * self.inputs / self.outputs[:, np.newaxis]


def scales_of(E: Matrix, A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Scales:
    """Compute the scales of a system; what is zero altogether has the scale 1.

    Equations and states have those of the pencil: what drives it, or is measured of it, does not
    change its ranks. Inputs and outputs follow.

    Shapes: ``E (n, n)``, ``A (n, n)``, ``B (n, m)``, ``C (p, n)``, ``D (p, m)``.
    """
    equations, states = _equilibrated_pencil(_exponents(A), _exponents(E))
    of_B = _exponents(B) - equations[:, np.newaxis]
    of_C = _exponents(C) - states
    of_D = _exponents(D)
    of_inputs = of_B.max(axis=0, initial=-np.inf)
    of_outputs = of_C.max(axis=1, initial=-np.inf)
    of_y_alone = of_D - _finite(of_outputs)[:, np.newaxis]  # inputs that act on y alone
    acts_on_states = np.isfinite(of_inputs)
    of_inputs = np.where(acts_on_states, of_inputs, of_y_alone.max(axis=0, initial=-np.inf))
    inputs = _finite(of_inputs)
    outputs = _finite(np.maximum(of_outputs, (of_D - inputs).max(axis=1, initial=-np.inf)))
    return Scales(_power(equations), _power(-states), _power(-inputs), _power(outputs))


def _equilibrated_pencil(of_A: Matrix, of_E: Matrix) -> tuple[Vector, Vector]:
    """Return the exponents of the rows and columns of E and A.

    That the largest are of size one leaves others open: `[[E11, A12], [0, E22]]` has them whatever
    A12 is. So of the entries that are not rounding then, the logarithms are made as small as can be
    in the sense of least squares (A. Curtis, J. Reid, J. Inst. Maths Applics 10 (1972) 118-124),
    which gives the same in all units, and the largest are made of size one again.
    """
    n = len(of_A)
    start = _equilibrated(of_A, of_E)
    offsets = start[0][:, np.newaxis] + start[1]
    entries = []
    sizes = []
    for number, matrix in enumerate((of_A, of_E)):
        scaled = matrix - offsets
        significant = np.argwhere(scaled > _largest(scaled) + np.log2(NEGLIGIBLE))
        for row, column in significant:
            entry = np.zeros(2 * n + 1)
            entry[[row, n + column]] = 1.0
            entry[2 * n] = number
            entries.append(entry)
            sizes.append(matrix[row, column])
    if not entries:
        return start
    solved = np.linalg.lstsq(np.array(entries), np.array(sizes), rcond=None)[0]
    rows = solved[:n]
    columns = solved[n : 2 * n]
    left = rows[:, np.newaxis] + columns
    more_rows, more_columns = _equilibrated(of_A - left, of_E - left)
    return rows + more_rows, columns + more_columns


def _equilibrated(sizes: Matrix, other: Matrix | None = None) -> tuple[Vector, Vector]:
    """Return the exponents of rows and columns whose largest entries are then of size one.

    Parameters
    ----------
    sizes : Matrix, shape (p, m)
        Binary logarithms.
    other : Matrix, shape (p, m), optional
        A second matrix, with the same rows and columns, but for one common factor.
    """
    rows = np.zeros(len(sizes))
    columns = np.zeros(sizes.shape[1])
    for _ in range(MOST_SWEEPS):
        scaled = sizes - rows[:, np.newaxis] - columns
        if other is not None:
            scaled_other = other - rows[:, np.newaxis] - columns
            factor = _difference(_largest(scaled_other), _largest(scaled))
            scaled = np.maximum(scaled, scaled_other - factor)
        of_rows = _finite(scaled.max(axis=1, initial=-np.inf))
        of_columns = _finite(scaled.max(axis=0, initial=-np.inf))
        rows += of_rows / 2.0
        columns += of_columns / 2.0
        if (np.abs(np.concatenate([of_rows, of_columns])) < 0.5).all():
            break
    return rows, columns


def state_space_scales(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Scales:
    """Compute the scales of `x' = A x + B u, y = C x + D u`: of an equation that of its state.

    A state is scaled so that what drives it is as large as what it drives; the unit of time is that
    of the largest rate.

    Shapes: ``A (n, n)``, ``B (n, m)``, ``C (p, n)``, ``D (p, m)``.
    """
    n, m = B.shape
    of_A = _exponents(A)
    coupling = of_A.copy()
    np.fill_diagonal(coupling, -np.inf)
    of_B = _exponents(B)
    of_C = _exponents(C)
    of_D = _exponents(D)
    states = np.zeros(n)
    inputs = np.zeros(m)
    outputs = np.zeros(len(C))
    for _ in range(MOST_SWEEPS):
        between = states - states[:, np.newaxis]
        rate = _finite(np.array([_largest(of_A + between)]))[0]
        A_now = coupling + between - rate
        B_now = of_B + inputs - states[:, np.newaxis] - rate
        C_now = of_C + states - outputs[:, np.newaxis]
        D_now = of_D + inputs - outputs[:, np.newaxis]
        driven = np.hstack([A_now, B_now]).max(axis=1, initial=-np.inf)
        drives = np.vstack([A_now, C_now]).max(axis=0, initial=-np.inf)
        of_inputs = _finite(np.vstack([B_now, D_now]).max(axis=0, initial=-np.inf))
        of_outputs = _finite(np.hstack([C_now, D_now]).max(axis=1, initial=-np.inf))
        of_states = 0.5 * (_finite(driven) - _finite(drives))
        states += 0.5 * of_states
        inputs -= 0.5 * of_inputs
        outputs += 0.5 * of_outputs
        if (np.abs(np.concatenate([of_states, of_inputs, of_outputs])) < 0.5).all():
            break
    return Scales(_power(states), _power(states), _power(inputs), _power(outputs))


def rank_between(
    matrix: Matrix | NDArray[np.complex128], magnitudes: Matrix, tolerance: float
) -> int:
    """Count the singular values of a product beyond ``tolerance``; see :func:`values_between`."""
    return int((values_between(matrix, magnitudes) > tolerance).sum())


def values_between(matrix: Matrix | NDArray[np.complex128], magnitudes: Matrix) -> Vector:
    """Compute the singular values of a product in units where its terms are of size one.

    Relative to the product itself, which may be all rounding, its rank would be meaningless. Units
    of rows and columns do not matter.

    Parameters
    ----------
    matrix : Matrix, shape (p, m)
        Also of complex numbers.
    magnitudes : Matrix, shape (p, m)
        Of each entry the sum of the absolute values of its terms.
    """
    if not matrix.size:
        return np.zeros(0)
    rows, columns = _equilibrated(_exponents(magnitudes))
    scaled = matrix / _power(rows)[:, np.newaxis] / _power(columns)
    values = np.linalg.svd(scaled, compute_uv=False)
    return np.asarray(values, np.float64)


def _exponents(matrix: Matrix) -> Matrix:
    """Return the binary logarithms of sizes; -inf for 0."""
    sizes = np.abs(matrix)
    logarithms = np.full(sizes.shape, -np.inf)
    np.log2(sizes, out=logarithms, where=sizes > 0.0)
    return logarithms


def _largest(exponents: Matrix) -> float:
    return float(exponents.max(initial=-np.inf))


def _difference(a: float, b: float) -> float:
    return a - b if np.isfinite(a) and np.isfinite(b) else 0.0


def _finite(values: Vector) -> Vector:
    """Return the values with 0 in place of -inf: of a row or column of zeros."""
    return np.where(np.isfinite(values), values, 0.0)


def _coarse(powers: Vector) -> Vector:
    return np.exp2(COARSE * np.rint(np.log2(powers) / COARSE))


def _power(exponents: Vector) -> Vector:
    return np.exp2(np.rint(exponents))
