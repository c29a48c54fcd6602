"""The constants chi of the regression (25) and their derivatives by theta.

A minor is linear in each of its columns, so its derivative by a parameter of a component is the sum
of the minors in which one column of the component is replaced by its derivative. Those of
``c' expm(-G D)`` stand in the corner of the exponential of ``[[G, G1], [0, G]]``, as G is affine in
theta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.output_error import Generator, Generators
from cosim.theory.disturbances.families import AlphaGroup
from cosim.theory.disturbances.regression import Term
from cosim.theory.fitted_response import transitions


@dataclass(frozen=True, eq=False)
class _GroupMinors:
    """The minors of a group: which rows each has, and which of them each term takes."""

    components: tuple[Generator, ...]
    rows: NDArray[np.integer]  # (minors, V)
    of_term: NDArray[np.integer]  # (q + 1,)

    def columns(self, theta: Vector, delays: Vector) -> tuple[Matrix, dict[int, Matrix]]:
        """Return K_b (5), shape (delays, V), and by entry of theta its derivative."""
        parts = []
        derivatives: dict[int, Matrix] = {}
        width = sum(len(component.c) for component in self.components)
        at = 0
        for component in self.components:
            V = len(component.c)
            own = range(*component.theta.indices(len(theta)))
            G = component.matrix(theta[component.theta])
            K = None
            for j, slope in zip(own, component.G1, strict=True):
                K, of_slope = basis_and_derivative(component.c, G, slope, delays)
                derivative = np.zeros((len(delays), width))
                derivative[:, at : at + V] = of_slope
                derivatives[j] = derivative
            parts.append(basis_rows(component.c, G, delays) if K is None else K)
            at += V
        return np.hstack(parts), derivatives

    def values(self, theta: Vector, delays: Vector) -> tuple[Vector, dict[int, Vector]]:
        """Return the minors of every term, shape (q + 1,), and their derivatives."""
        K, derivatives = self.columns(theta, delays)
        minors = K[self.rows]
        values = np.linalg.det(minors)[self.of_term]
        slopes = {}
        for j, derivative in derivatives.items():
            total = np.zeros(len(self.rows))
            for v in np.flatnonzero(derivative.any(axis=0)):
                replaced = minors.copy()
                replaced[:, :, v] = derivative[self.rows, v]
                total += np.linalg.det(replaced)
            slopes[j] = total[self.of_term]
        return values, slopes


class Minors:
    """The constants chi as functions of theta and of the delays.

    Parameters
    ----------
    matrices : Generators
        Of all components.
    groups : sequence of AlphaGroup
    terms : sequence of Term
    """

    def __init__(
        self, matrices: Generators, groups: Sequence[AlphaGroup], terms: Sequence[Term]
    ) -> None:
        self._parameters = matrices.parameters
        each = matrices.each
        self._groups = []
        for b, group in enumerate(groups):
            parts = sorted({term.parts[b] for term in terms})
            place = {part: i for i, part in enumerate(parts)}
            of_term = np.array([place[term.parts[b]] for term in terms])
            components = tuple(each[i] for i in group.components)
            self._groups.append(_GroupMinors(components, np.array(parts), of_term))

    def chi(self, theta: Vector, delays: Vector) -> tuple[Vector, Matrix]:
        """Return chi, shape (q + 1,), and its derivatives by theta, shape (P, q + 1)."""
        values = []
        slopes: list[dict[int, Vector]] = []
        for group in self._groups:
            of_group, by_parameter = group.values(theta, delays)
            values.append(of_group)
            slopes.append(by_parameter)
        chi: Vector = np.prod(values, axis=0)
        derivatives = np.zeros((self._parameters, len(chi)))
        for b, own in enumerate(slopes):
            others = np.prod([*values[:b], *values[b + 1 :]], axis=0)
            for j, slope in own.items():
                derivatives[j] = slope * others
        return chi, derivatives


def basis_rows(c: Vector, G: Matrix, delays: Vector) -> Matrix:
    """Return ``c' expm(-G D)`` for every delay, shape (delays, V)."""
    rows: Matrix = np.einsum("a,nab->nb", c, transitions(G, -delays))
    return rows


def basis_and_derivative(
    c: Vector, G: Matrix, slope: Matrix, delays: Vector
) -> tuple[Matrix, Matrix]:
    """Return these rows, and their derivatives by a parameter that G has this slope in."""
    V = len(c)
    augmented = np.zeros((2 * V, 2 * V))
    augmented[:V, :V] = G
    augmented[V:, V:] = G
    augmented[:V, V:] = slope
    beside_zeros = np.zeros(2 * V)
    beside_zeros[:V] = c
    rows = basis_rows(beside_zeros, augmented, delays)
    return rows[:, :V], rows[:, V:]
