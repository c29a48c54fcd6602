"""Terms that no data tell apart, known before any run from families, alphas and bounds.

Terms of one alpha make up one signal. Where two of them have an eigenvalue of their generators in
common whatever theta is, their basis functions are dependent, and only the sum of their constants
is seen.

A sine so slow that it is a straight line over the run, but for what any noise hides, has no value
of its own beside a constant of the same alpha. How slow it may be rests on the noise, which is not
known before the run: at a rate times run of 0.5 rad, 2 000 samples with noise of 1e-3 of the
amplitude still give the rate to 4 % (Cramer-Rao); the error grows with the third power of slowness.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.disturbances.families import DampedSine, Family, Polynomial, Sine

SAME: Final = 1e-6  # difference of two eigenvalues over the larger, or over 1, that is none
TRIALS: Final = 2  # theta at which nothing agrees by chance
EXPONENTS: Final = ("exponential", "damped-sine", "t-exponential")  # families that have one
LARGE: Final = 1e-3  # of its largest value, from which on an alpha is divided by
MANY: Final = 8  # samples that show whether a ratio is an exponential
STRAIGHT: Final = 0.02  # rate times run [rad] of a sine that is a straight line but for 5e-5


def check_distinguishable(
    families: Sequence[Family],
    alphas: Sequence[Hashable],
    names: Sequence[str],
    *,
    bounds: Mapping[int, tuple[float, float]],
    span: float,
) -> None:
    """Check that no two terms of one alpha say the same.

    Parameters
    ----------
    families : sequence of Family
        Of the terms.
    alphas : sequence of hashable
        What each is multiplied by: equal ones are the same.
    names : sequence of str
        Of the alphas, for the message.
    bounds : mapping of index to (lower, upper)
        Of theta; equal ones fix it.
    span : float
        Length of the run [s].

    Raises
    ------
    AssumptionError
        If two terms have an eigenvalue in common whatever theta is, or a sine is bounded to be so
        slow that it is a straight line beside a constant.
    """
    terms = []
    for family, places in zip(families, _places(families), strict=True):
        spectra = [_eigenvalues(family, places, bounds, trial) for trial in range(TRIALS)]
        terms.append(_Term(family, tuple(spectra), _largest_rate(family, places, bounds)))
    for i, k in combinations(range(len(terms)), 2):
        if alphas[i] != alphas[k]:
            continue
        both = (
            f"terms[{i}] ({families[i].name}) and terms[{k}] ({families[k].name}) share alpha "
            f"{names[k]!r}"
        )
        _check_signals(terms[i], terms[k], both)
        _check_rates(terms[i], terms[k], span, both)


@dataclass(frozen=True, eq=False)
class _Term:
    """A term, what its generator has for eigenvalues at each trial, and the largest rate."""

    family: Family
    spectra: tuple[NDArray[np.complex128], ...]
    rate: float

    @property
    def makes_constant(self) -> bool:
        """Whether an eigenvalue is zero."""
        return bool((np.abs(self.spectra[0]) <= SAME).any())

    def is_straight(self, span: float) -> bool:
        """Return whether it is a sine that is a straight line over a time [s]."""
        return self.rate * span < STRAIGHT


def _check_signals(first: _Term, second: _Term, both: str) -> None:
    """Check that two terms have no eigenvalue in common whatever theta is.

    Raises
    ------
    AssumptionError
        If they have.
    """
    pairs = zip(first.spectra, second.spectra, strict=True)
    common = [_common(of_second, of_first) for of_first, of_second in pairs]
    if any(eigenvalue is None for eigenvalue in common):
        return
    raise AssumptionError(
        f"{both}, and whatever theta is both make {_signal_of(common[0])}: no data tell "
        f"their constants apart; {_merged(first.family, second.family)}"
    )


def _check_rates(first: _Term, second: _Term, span: float, both: str) -> None:
    """Check that none of two terms is a sine as slow as a straight line beside a constant.

    Raises
    ------
    AssumptionError
        If one is.
    """
    of_first = first.is_straight(span) and second.makes_constant
    of_second = second.is_straight(span) and first.makes_constant
    if of_first or of_second:
        raise AssumptionError(
            f"{both}, and the rate is bounded by {min(first.rate, second.rate):g} rad/s: such a "
            f"sine is a straight line in the {span:g} s of the run; choose a bound above "
            f"{STRAIGHT / span:.3g} rad/s, a longer run, or one of the two terms"
        )


def check_exchangeable(
    t: Vector, alpha: Matrix, families: Sequence[Sequence[Family]], names: Sequence[str]
) -> None:
    """Check that no alpha makes of a term of another alpha one of its own.

    Where the ratio of two alphas is an exponential, terms with an exponent take it up, and those
    of one family fit the same data with their parameters exchanged.

    Parameters
    ----------
    t : Vector, shape (N,)
        Instants [s].
    alpha : Matrix, shape (N, groups)
        The alphas there.
    families : sequence of sequence of Family
        Of the terms of each alpha.
    names : sequence of str
        Of the alphas.

    Raises
    ------
    AssumptionError
        If two alphas do that.
    """
    exponents = []
    for of_alpha in families:
        exponents.append({family.name for family in of_alpha}.intersection(EXPONENTS))
    for a, b in combinations(range(len(names)), 2):
        shared = sorted(exponents[a] & exponents[b])
        rate = _rate_of_ratio(t, alpha[:, a], alpha[:, b]) if shared else None
        if rate is not None:
            raise AssumptionError(
                f"alpha {names[a]!r} is a multiple of exp({rate:.4g} t) times alpha "
                f"{names[b]!r}, so that the terms of family {shared[0]!r} fit the same data with "
                f"their parameters exchanged; give them one alpha, which shifts the exponent by "
                f"{rate:.4g}"
            )


def _rate_of_ratio(t: Vector, signal: Vector, other: Vector) -> float | None:
    """Return the rate of an exponential that is the ratio of two signals; None: it is none."""
    size = np.abs(other)
    large = size > LARGE * size.max(initial=0.0)
    if large.sum() < MANY or not signal[large].all():
        return None
    ratio = signal[large] / other[large]
    if np.sign(ratio).min() < np.sign(ratio).max():
        return None
    logarithm = np.log(np.abs(ratio))
    instants = t[large] - t[large].mean()
    rate = float(np.mean(instants * logarithm) / np.mean(instants**2))
    residual = logarithm - logarithm.mean() - rate * instants
    is_line = np.abs(residual).max() <= SAME * max(1.0, np.abs(logarithm).max())
    return rate if is_line else None


def _places(families: Sequence[Family]) -> list[range]:
    """Return where the parameters of each term stand in theta."""
    places = []
    first = 0
    for family in families:
        last = first + len(family.parameters)
        places.append(range(first, last))
        first = last
    return places


def _eigenvalues(
    family: Family, places: range, bounds: Mapping[int, tuple[float, float]], trial: int
) -> NDArray[np.complex128]:
    """Compute those of G where parameters that are not fixed have any values."""
    theta = np.zeros(len(places))
    for k, j in enumerate(places):
        lower, upper = bounds.get(j, (-math.inf, math.inf))
        theta[k] = lower
        if lower != upper:  # irrational, so that no two of them agree
            theta[k] = 0.3 + math.sqrt(2.0 + 3.0 * j + 0.7 * trial)
    eigenvalues = np.linalg.eigvals(family.G(theta))
    return eigenvalues.astype(np.complex128)


def _common(values: NDArray[np.complex128], other: NDArray[np.complex128]) -> complex | None:
    """Return a value that stands in both, up to rounding; None: there is none."""
    for value in values:
        distance = np.abs(other - value)
        if (distance <= SAME * max(1.0, abs(value))).any():
            return complex(value)
    return None


def _largest_rate(
    family: Family, places: range, bounds: Mapping[int, tuple[float, float]]
) -> float:
    """Return the largest rate of a sine within its bounds; infinite: it has none."""
    if not isinstance(family, Sine | DampedSine):
        return math.inf
    j = places[family.parameters.index("rate")]
    lower, upper = bounds.get(j, (-math.inf, math.inf))
    return max(abs(lower), abs(upper))


def _signal_of(eigenvalue: complex | None) -> str:
    assert eigenvalue is not None
    if abs(eigenvalue) <= SAME:
        return "a constant"
    if abs(eigenvalue.imag) <= SAME:
        return f"exp({eigenvalue.real:.4g} t)"
    return f"a sine of {abs(eigenvalue.imag):.4g} rad/s"


def _merged(family: Family, other: Family) -> str:
    if isinstance(family, Polynomial) and isinstance(other, Polynomial):
        larger = max((family, other), key=lambda polynomial: polynomial.degree)
        return f"merge them: one term of family {larger.name!r} is the sum of both"
    return "merge them into one term, or leave one out"
