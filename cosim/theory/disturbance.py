"""Families of disturbance components (4)-(5) as autonomous linear systems.

A component is the output of a linear system without input, `beta' = G(theta) beta, f = c' beta`. Then
`f(t - D) = c' expm(-G D) beta(t)`, which is (5) with the row `K(theta, D)' = c' expm(-G D)` and the basis `beta(t)`. Amplitudes
and phases live in `beta(0)` and never enter K. With equally spaced delays a component obeys a linear recurrence whose
characteristic roots are `z = exp(lambda spacing)`, lambda the eigenvalues of G: `theta_from_roots` is the inverse asked for by
Assumption 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Protocol, final

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import AssumptionError, nearest


class Family(Protocol):
    """A kind of disturbance component: all signals `c' expm(G(theta) t) beta(0)`."""

    @property
    def name(self) -> str:
        """The name a scenario uses."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of the entries of theta."""

    @property
    def v(self) -> int:
        """Number of basis functions (5)."""

    @property
    def c(self) -> Vector:
        """Output row, shape ``(v,)``."""

    def G(self, theta: Vector) -> Matrix:
        """System matrix [1/s], shape ``(v, v)``."""

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Theta from the ``v`` roots of the recurrence with delays ``spacing`` [s] apart; NaN where there is none."""


@final
@dataclass(frozen=True)
class Exponential:
    """`f = b exp(theta t)`, theta [1/s]."""

    name: ClassVar[str] = "exponential"
    parameters: ClassVar[tuple[str, ...]] = ("theta",)
    v: ClassVar[int] = 1

    @property
    def c(self) -> Vector:
        """Output row, shape ``(1,)``."""
        return np.ones(1)

    def G(self, theta: Vector) -> Matrix:
        """System matrix [1/s], shape ``(1, 1)``."""
        return np.array([[theta[0]]])

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Theta from `z = exp(theta spacing)`, shape ``(1,)``; NaN where z is not real and positive."""
        root = complex(z[0])
        if root.imag != 0.0 or not 0.0 < root.real < math.inf:
            return np.array([NAN])
        return np.array([math.log(root.real) / spacing])


@final
@dataclass(frozen=True)
class Sine:
    """`f = a sin(w t) + b cos(w t)`, theta = w [rad/s], amplitude and phase unknown."""

    name: ClassVar[str] = "sine"
    parameters: ClassVar[tuple[str, ...]] = ("rate",)
    v: ClassVar[int] = 2

    @property
    def c(self) -> Vector:
        """Output row, shape ``(2,)``."""
        return np.array([1.0, 0.0])

    def G(self, theta: Vector) -> Matrix:
        """System matrix [1/s], shape ``(2, 2)``."""
        return np.array([[0.0, theta[0]], [-theta[0], 0.0]])

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Theta from `z_1 + z_2 = 2 cos(w spacing)`, shape ``(1,)``; NaN where that is not in -2..2.

        Only w < pi / spacing can be told apart: a faster sine gives the same roots as a slower one.
        """
        cosine = complex(z[0] + z[1]).real / 2.0
        return np.array([math.acos(cosine) / spacing if abs(cosine) <= 1.0 else NAN])


@dataclass(frozen=True)
class AlphaGroup:
    """Components that share one alpha: their positions in the disturbance (4) and their families."""

    alpha: str
    components: tuple[int, ...]
    families: tuple[Family, ...]

    @property
    def size(self) -> int:
        """Number of basis functions `V_b`."""
        return sum(family.v for family in self.families)


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {family.name: family for family in (Exponential(), Sine())}
)


def family_named(name: str) -> Family:
    """Look a family up by its name.

    Raises
    ------
    AssumptionError
        If there is no such family.
    """
    if name not in FAMILIES:
        raise AssumptionError(
            f"Assumption 3 (5): no disturbance family {name!r}; {nearest(name, FAMILIES)}"
        )
    return FAMILIES[name]


def K(family: Family, theta: ArrayLike, D: float) -> Vector:
    """Give the row `K(theta, D)' = c' expm(-G D)` of (5), shape ``(v,)``.

    Parameters
    ----------
    family : Family
        The kind of component.
    theta : ArrayLike
        Its parameters, a number or shape ``(len(family.parameters),)``.
    D : float
        Delay [s].

    Raises
    ------
    AssumptionError
        If theta has another number of entries.
    """
    parameters = np.atleast_1d(np.asarray(theta, dtype=np.float64))
    if parameters.shape != (len(family.parameters),):
        raise AssumptionError(
            f"theta of family {family.name!r} has shape {parameters.shape}; needed ({len(family.parameters)},): "
            f"{', '.join(family.parameters)}"
        )
    row: Vector = family.c @ expm(-family.G(parameters) * D)
    return row


def coefficients(
    families: Sequence[Family], thetas: Sequence[ArrayLike], delays: Sequence[float]
) -> Matrix:
    """Stack the rows K of components that share one alpha, shape ``(len(delays), sum of v)``."""
    return np.array(
        [
            np.concatenate(
                [K(kind, theta, D) for kind, theta in zip(families, thetas, strict=True)]
            )
            for D in delays
        ]
    )


def group_by_alpha(alphas: Sequence[str], families: Sequence[Family]) -> tuple[AlphaGroup, ...]:
    """Group the components of (4) by alpha, blocks in the order of their first component.

    Parameters
    ----------
    alphas : sequence of str
        What identifies the alpha of each component; equal text, one block.
    families : sequence of Family
        The family of each component.
    """
    members = {
        alpha: tuple(i for i, other in enumerate(alphas) if other == alpha) for alpha in alphas
    }
    pairs = list(zip(alphas, families, strict=True))
    return tuple(
        AlphaGroup(alpha, of, tuple(pairs[i][1] for i in of)) for alpha, of in members.items()
    )
