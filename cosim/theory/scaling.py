"""Units in which a descriptor system is of size one, so that its ranks do not rest on units.

Rows (equations, outputs) and columns (states, inputs) of::

    [ E/T and A   B ]
    [     C       D ]

are divided by powers of two until the largest entry of each is about one. T is a time, of which
E x' is as large as A x. The powers round nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector

MOST_SWEEPS: Final = 60  # each halves the exponents that are left
COARSE: Final = 10.0  # binary digits of a coarse scale


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

    Shapes: ``E (n, n)``, ``A (n, n)``, ``B (n, m)``, ``C (p, n)``, ``D (p, m)``.
    """
    n = len(A)
    sizes_of_E = _exponents(E)
    sizes_of_A = _exponents(A)
    top = np.hstack([sizes_of_A, _exponents(B)])
    bottom = np.hstack([_exponents(C), _exponents(D)])
    fixed = np.vstack([top, bottom])  # log2 of sizes
    rows = np.zeros(len(fixed))
    columns = np.zeros(fixed.shape[1])
    for _ in range(MOST_SWEEPS):
        scaled = fixed - rows[:, np.newaxis] - columns
        scaled_E = sizes_of_E - rows[:n, np.newaxis] - columns[:n]
        time = _difference(_largest(scaled_E), _largest(scaled[:n, :n]))
        scaled[:n, :n] = np.maximum(scaled[:n, :n], scaled_E - time)
        of_rows = _finite(scaled.max(axis=1, initial=-np.inf))
        of_columns = _finite(scaled.max(axis=0, initial=-np.inf))
        rows += of_rows / 2.0
        columns += of_columns / 2.0
        if (np.abs(np.concatenate([of_rows, of_columns])) < 0.5).all():
            break
    return Scales(
        equations=_power(rows[:n]),
        states=_power(-columns[:n]),
        inputs=_power(-columns[n:]),
        outputs=_power(rows[n:]),
    )


def rank_between(matrix: Matrix, magnitudes: Matrix, tolerance: float) -> int:
    """Compute the rank of a product whose terms have these magnitudes.

    Relative to the product itself, which may be all rounding, the rank would be meaningless. Units
    of rows and columns do not matter.

    Parameters
    ----------
    matrix : Matrix, shape (p, m)
    magnitudes : Matrix, shape (p, m)
        Of each entry the sum of the absolute values of its terms.
    tolerance : float
        Of singular values, where magnitudes are of size one.
    """
    if not matrix.size:
        return 0
    p, m = matrix.shape
    no_states = np.zeros((0, 0))
    scales = scales_of(
        no_states, no_states, np.zeros((0, m)), np.zeros((p, 0)), np.asarray(magnitudes)
    )
    values = np.linalg.svd(scales.scaled_D(matrix), compute_uv=False)
    return int((values > tolerance).sum())


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
