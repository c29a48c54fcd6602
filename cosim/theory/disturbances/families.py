"""Families of disturbance components (4)-(5) as autonomous linear systems.

A component is the output of a linear system without input, `beta' = G(theta) beta, f = c' beta`.
Then `f(t - D) = c' expm(-G D) beta(t)`, which is (5) with the row `K(theta, D)' = c' expm(-G D)`
and the basis `beta(t)`. Amplitudes and phases live in `beta(0)` and never enter K.

With equally spaced delays a component obeys a linear recurrence whose characteristic roots are
`z = exp(lambda spacing)`, lambda the eigenvalues of G: `theta_from_roots` is the inverse asked for
by Assumption 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from types import MappingProxyType
from typing import ClassVar, Protocol, final

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import AssumptionError, nearest
from cosim.native.estimation.output_error import Generators


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
        """The number of basis functions (5)."""

    @property
    def c(self) -> Vector:
        """Output row, shape ``(v,)``."""

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(v, v)``."""

    @property
    def constants(self) -> tuple[str, ...]:
        """The names of what `beta(0)` says, such as an amplitude and a phase [rad]; v of them."""

    @property
    def formula(self) -> str:
        """The component by the names of its parameters and constants in braces."""

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Compute the constants from `beta(0)`, shape ``(v,)``, and their derivatives, ``(v, v)``.

        Constants that have none, such as the phase of a sine that is zero, are NaN.
        """

    @property
    def even(self) -> tuple[bool, ...]:
        """For each parameter, whether its negative makes the same signals."""

    @property
    def graded(self) -> tuple[bool, ...]:
        """For each parameter, whether a start is searched in steps that grow with it.

        So of exponents, whose effect is that of their logarithm, but not of rates.
        """

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return for each parameter the range in which a start is searched.

        Parameters
        ----------
        span : float
            Length of the record [s].
        shortest : float
            Shortest time in which the component may change [s].
        """

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Compute theta from the ``v`` roots of the recurrence with delays ``spacing`` [s] apart.

        The shape is ``(len(parameters),)``; NaN where the roots belong to no theta.
        """


@final
@dataclass(frozen=True)
class Exponential:
    """`f = b exp(theta t)`, theta [1/s]."""

    name: ClassVar[str] = "exponential"
    parameters: ClassVar[tuple[str, ...]] = ("theta",)
    even: ClassVar[tuple[bool, ...]] = (False,)
    graded: ClassVar[tuple[bool, ...]] = (True,)
    constants: ClassVar[tuple[str, ...]] = ("amplitude",)
    formula: ClassVar[str] = "{amplitude} exp({theta} t)"
    v: ClassVar[int] = 1

    @property
    def c(self) -> Vector:
        """Output row, shape ``(1,)``."""
        return np.ones(1)

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(1, 1)``."""
        return np.array([[theta[0]]])

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Return the amplitude, which is beta."""
        return beta.copy(), np.eye(1)

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return the range from a decay within ``shortest`` to a tenfold growth over ``span``."""
        return (_exponents(span, shortest),)

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Compute theta from `z = exp(theta spacing)`; NaN where z is not real and positive."""
        return np.array([_exponent(complex(z[0]), spacing)])


@final
@dataclass(frozen=True)
class Sine:
    """`f = a sin(w t) + b cos(w t)`, theta = w [rad/s], amplitude and phase unknown."""

    name: ClassVar[str] = "sine"
    parameters: ClassVar[tuple[str, ...]] = ("rate",)
    even: ClassVar[tuple[bool, ...]] = (True,)
    graded: ClassVar[tuple[bool, ...]] = (False,)
    constants: ClassVar[tuple[str, ...]] = ("amplitude", "phase")
    formula: ClassVar[str] = "{amplitude} sin({rate} t + {phase})"
    v: ClassVar[int] = 2

    @property
    def c(self) -> Vector:
        """Output row, shape ``(2,)``."""
        return np.array([1.0, 0.0])

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(2, 2)``."""
        rate = theta[0]
        return np.array([[0.0, rate], [-rate, 0.0]])

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Compute amplitude and phase."""
        return _amplitude_and_phase(beta)

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return the range from a quarter of a period over ``span`` to half of one."""
        return (_rates(span, shortest),)

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Compute theta from `z_1 + z_2 = 2 cos(w spacing)`; NaN where that is not in [-2, 2].

        Only w < pi / spacing is unique: a faster sine has the same roots as a slower one.
        """
        first, second = z
        cosine = complex(first + second).real / 2.0
        return np.array([_rate(cosine, spacing)])


@final
@dataclass(frozen=True)
class DampedSine:
    """`f = exp(-d t) (a sin(w t) + b cos(w t))`, theta = (d [1/s], w [rad/s]); d < 0 grows."""

    name: ClassVar[str] = "damped-sine"
    parameters: ClassVar[tuple[str, ...]] = ("decay", "rate")
    even: ClassVar[tuple[bool, ...]] = (False, True)
    graded: ClassVar[tuple[bool, ...]] = (True, False)
    constants: ClassVar[tuple[str, ...]] = ("amplitude", "phase")
    formula: ClassVar[str] = "{amplitude} exp(-{decay} t) sin({rate} t + {phase})"
    v: ClassVar[int] = 2

    @property
    def c(self) -> Vector:
        """Output row, shape ``(2,)``."""
        return np.array([1.0, 0.0])

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(2, 2)``."""
        decay, rate = theta
        return np.array([[-decay, rate], [-rate, -decay]])

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Compute amplitude and phase."""
        return _amplitude_and_phase(beta)

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return the ranges of an exponential and of a sine."""
        slowest, fastest = _exponents(span, shortest)
        return ((-fastest, -slowest), _rates(span, shortest))

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Compute theta from `z = exp((-d +- j w) spacing)`; NaN where z is no such pair."""
        first, second = z
        decay = -_exponent(complex(first * second), 2.0 * spacing)
        size = math.exp(-decay * spacing) if math.isfinite(decay) else NAN
        cosine = complex(first + second).real / 2.0 / size
        rate = _rate(cosine, spacing)
        return np.array([decay, rate]) if math.isfinite(rate) else np.full(2, NAN)


@final
@dataclass(frozen=True)
class Polynomial:
    """`f = b_0 + b_1 t + ... + b_n t^n`, without parameters: a constant, a ramp, and so on.

    Parameters
    ----------
    degree : int
        n.
    name : str
        "constant" of degree 0, "ramp" of degree 1, or "polynomial".
    """

    degree: int
    name: str = "polynomial"
    parameters: ClassVar[tuple[str, ...]] = ()
    even: ClassVar[tuple[bool, ...]] = ()
    graded: ClassVar[tuple[bool, ...]] = ()

    @property
    def v(self) -> int:
        """The number of basis functions (5)."""
        return self.degree + 1

    @property
    def c(self) -> Vector:
        """Output row, shape ``(v,)``."""
        row = np.zeros(self.v)
        row[0] = 1.0
        return row

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(v, v)``: `beta_k' = (k + 1) beta_(k+1)`."""
        powers = np.arange(1.0, self.v)
        return np.diag(powers, 1)

    @property
    def constants(self) -> tuple[str, ...]:
        """The names of the coefficients, by power."""
        higher = [f"coefficient_{power}" for power in range(2, self.v)]
        return ("level", "slope", *higher)[: self.v]

    @property
    def formula(self) -> str:
        """The sum of powers of t, by the names of their coefficients in braces."""
        terms = [f"{{{name}}}{_power(k)}" for k, name in enumerate(self.constants)]
        return " + ".join(terms)

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Return the coefficients, which are beta."""
        return beta.copy(), np.eye(self.v)

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return no range: there is no parameter."""
        return ()

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Return theta, which is empty."""
        return np.zeros(0)


@final
@dataclass(frozen=True)
class TExponential:
    """`f = (b_0 + b_1 t) exp(theta t)`, theta [1/s]."""

    name: ClassVar[str] = "t-exponential"
    parameters: ClassVar[tuple[str, ...]] = ("theta",)
    even: ClassVar[tuple[bool, ...]] = (False,)
    graded: ClassVar[tuple[bool, ...]] = (True,)
    constants: ClassVar[tuple[str, ...]] = ("level", "slope")
    formula: ClassVar[str] = "({level} + {slope} t) exp({theta} t)"
    v: ClassVar[int] = 2

    @property
    def c(self) -> Vector:
        """Output row, shape ``(2,)``."""
        return np.array([1.0, 0.0])

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(2, 2)``."""
        return np.array([[theta[0], 1.0], [0.0, theta[0]]])

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Return level and slope, which are beta."""
        return beta.copy(), np.eye(2)

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return the range of an exponential."""
        return (_exponents(span, shortest),)

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Compute theta from the double root `z = exp(theta spacing)`, the mean of both."""
        mean = complex(sum(z)) / 2.0
        return np.array([_exponent(complex(mean.real), spacing)])


def _amplitude_and_phase(beta: Vector) -> tuple[Vector, Matrix]:
    """Compute them from `beta = amplitude (sin phase, cos phase)`, and their derivatives."""
    sine, cosine = beta
    amplitude = math.hypot(sine, cosine)
    if not 0.0 < amplitude < math.inf:
        return np.array([amplitude, NAN]), np.full((2, 2), NAN)
    direction = beta / amplitude
    across = np.array([direction[1], -direction[0]]) / amplitude
    return np.array([amplitude, math.atan2(sine, cosine)]), np.array([direction, across])


def _exponents(span: float, shortest: float) -> tuple[float, float]:
    return -3.0 / shortest, math.log(10.0) / span


def _rates(span: float, shortest: float) -> tuple[float, float]:
    return 0.5 * math.pi / span, math.pi / shortest


def _exponent(root: complex, spacing: float) -> float:
    """Compute theta from `root = exp(theta spacing)`; NaN where it is not real and positive."""
    positive = 0.0 < root.real < math.inf
    if root.imag != 0.0 or not positive:
        return NAN
    return math.log(root.real) / spacing


def _rate(cosine: float, spacing: float) -> float:
    """Compute w from `cos(w spacing)`; NaN where that is not in [-1, 1]."""
    return math.acos(cosine) / spacing if abs(cosine) <= 1.0 else NAN


def _power(k: int) -> str:
    return ("", " t")[k] if k < 2 else f" t^{k}"


def generators(families: Sequence[Family]) -> Generators:
    """Return the matrices of components for the kernels: G is affine in theta.

    Raises
    ------
    AssumptionError
        If there is no component.
    """
    if not families:
        raise AssumptionError("disturbance: expected at least one component, got none")
    constant_parts = []
    slopes = []
    for family in families:
        zero = np.zeros(len(family.parameters))
        G0 = family.G(zero)
        constant_parts.append(G0.ravel())
        for j in range(len(zero)):
            unit = zero.copy()
            unit[j] = 1.0
            slopes.append((family.G(unit) - G0).ravel())
    return Generators(
        size=tuple(family.v for family in families),
        count=tuple(len(family.parameters) for family in families),
        c=np.concatenate([family.c for family in families]),
        G0=np.concatenate(constant_parts),
        G1=np.concatenate(slopes or [np.zeros(0)]),
    )


@dataclass(frozen=True)
class SearchBox:
    """The theta among which a start is searched, and the longest step of an iteration.

    Shapes: ``lower``, ``upper`` and ``step`` ``(n_theta,)``; ``graded`` and ``even`` are those of
    the families, one behind the other, by default of none.
    """

    lower: Vector
    upper: Vector
    graded: tuple[bool, ...] = ()
    even: tuple[bool, ...] = ()

    @property
    def step(self) -> Vector:
        """A tenth of the box."""
        return (self.upper - self.lower) / 10.0


def search_box(families: Sequence[Family], *, span: float, shortest: float) -> SearchBox:
    """Return where theta is searched, from the time scales of the data.

    Parameters
    ----------
    families : sequence of Family
    span : float
        Length of the record [s].
    shortest : float
        Shortest time in which a component may change [s].
    """
    lower: list[float] = []
    upper: list[float] = []
    for family in families:
        for low, high in family.search(span, shortest):
            lower.append(low)
            upper.append(high)
    graded = tuple(chain.from_iterable(family.graded for family in families))
    return SearchBox(np.array(lower), np.array(upper), graded, even_parameters(families))


def even_parameters(families: Sequence[Family]) -> tuple[bool, ...]:
    """Return for each parameter of components whether its negative makes the same signals."""
    return tuple(chain.from_iterable(family.even for family in families))


@dataclass(frozen=True)
class AlphaGroup:
    """The group b of the components of (4) that share one alpha.

    ``components`` are their positions in (4), ``families`` their families.
    """

    alpha: str
    components: tuple[int, ...]
    families: tuple[Family, ...]

    @property
    def size(self) -> int:
        """The number of basis functions `V_b`."""
        return sum(family.v for family in self.families)


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        family.name: family
        for family in (
            Exponential(),
            Sine(),
            DampedSine(),
            Polynomial(0, "constant"),
            Polynomial(1, "ramp"),
            TExponential(),
        )
    }
)
SETTINGS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"polynomial": ("degree",), "linear": ("G0", "G", "c", "parameters", "search")}
)
OUTSIDE: Mapping[str, str] = MappingProxyType(
    {
        "chirp": "a sine of unknown, growing rate is outside the class: its values a delay ago are "
        "no combination of finitely many functions of t with constant coefficients. Where the "
        "growth k [rad/s^2] is known, give two terms of family 'sine' with the alphas "
        "sin(k*t**2/2) and cos(k*t**2/2); where the rate is known too, two of family 'constant' "
        "with the sine and the cosine of the whole angle as alphas",
    }
)


def family_named(name: str) -> Family:
    """Return the family of this name, which needs no more than that.

    Raises
    ------
    AssumptionError
        If there is no such family, or it has settings.
    """
    if name in FAMILIES:
        return FAMILIES[name]
    if name in OUTSIDE:
        raise AssumptionError(f"family {name!r}: {OUTSIDE[name]}")
    if name in SETTINGS:
        listed = ", ".join(SETTINGS[name])
        raise AssumptionError(f"family {name!r}: expected its settings too: {listed}")
    nearest_name = nearest(name, [*FAMILIES, *SETTINGS])
    raise AssumptionError(f"no disturbance family {name!r} in this package; {nearest_name}")


def K(family: Family, theta: ArrayLike, D: float) -> Vector:
    """Compute the row `K(theta, D)' = c' expm(-G D)` of (5), shape ``(v,)``.

    Parameters
    ----------
    family : Family
        The family of the component.
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
    shape = parameters.shape
    expected = (len(family.parameters),)
    if shape != expected:
        names = ", ".join(family.parameters)
        raise AssumptionError(
            f"theta of family {family.name!r}: expected shape {expected}: {names}; got {shape}"
        )
    exponent = -family.G(parameters) * D
    from scipy.linalg import expm  # takes long to import, and is rarely needed

    row: Vector = family.c @ expm(exponent)
    return row


def coefficients(
    families: Sequence[Family], thetas: Sequence[ArrayLike], delays: Sequence[float]
) -> Matrix:
    """Stack the rows K (5) of components that share one alpha.

    Parameters
    ----------
    families : sequence of Family
        The families of the components.
    thetas : sequence of ArrayLike
        The parameters of each.
    delays : sequence of float
        `D_j` [s].

    Returns
    -------
    Matrix
        Shape ``(len(delays), V_b)``, `V_b` the sum of the basis functions.
    """
    stacked = []
    for D in delays:
        rows = []
        for family, theta in zip(families, thetas, strict=True):
            rows.append(K(family, theta, D))
        stacked.append(np.concatenate(rows))
    return np.array(stacked)


def group_by_alpha(alphas: Sequence[str], families: Sequence[Family]) -> tuple[AlphaGroup, ...]:
    """Group the components of (4) by alpha, the groups in the order of their first component.

    Parameters
    ----------
    alphas : sequence of str
        The alpha of each component as text; equal text, one group.
    families : sequence of Family
        The family of each component.
    """
    members: dict[str, list[int]] = {}
    families_of: dict[str, list[Family]] = {}
    components = zip(alphas, families, strict=True)
    for position, (alpha, family) in enumerate(components):
        members.setdefault(alpha, []).append(position)
        families_of.setdefault(alpha, []).append(family)
    groups = []
    for alpha, positions in members.items():
        group = AlphaGroup(alpha, tuple(positions), tuple(families_of[alpha]))
        groups.append(group)
    return tuple(groups)
