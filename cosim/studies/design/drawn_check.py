"""Which draws of a distribution the scenario does not take, from a few that are tried.

A distribution may have a tail of values that a component refuses, such as rates below 0. Members
with these fail, each with its reason, as members with a value at which an FMU fails: which part of
its values can run is often what a study is to show. Only where none of the values that are tried
is taken, the study is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError, quoted
from cosim.studies.document.variations import SampledVariation

PROBES: Final = 9  # values, from the smallest to the largest, once one is refused

Attempt = Callable[[float], str]  # returns why a value is refused; empty: it is not


@dataclass(frozen=True, slots=True)
class RefusedDraws:
    """Draws of a key that are refused.

    Parameters
    ----------
    variation : SampledVariation
    count, total : int
        How many of how many; between the values that were tried it is taken that one interval of
        them is refused.
    number : int
        Of a member with one of them.
    value : float
        That it has.
    reason : str
    accepted : float
        A draw that is not refused.
    """

    variation: SampledVariation
    count: int
    total: int
    number: int
    value: float
    reason: str
    accepted: float

    def __str__(self) -> str:
        of = f"{self.total} draws of {self.variation}"
        which = f"about {self.count} of {of} are invalid, and members that draw them will fail"
        return (
            f"{self.variation.key}: {which}: {self.value!r} of member {self.number}: {self.reason}"
            f"; {_way_out(self.variation)}"
        )


def check_draws(
    variation: SampledVariation,
    values: np.ndarray[Any, Any],
    attempt: Attempt,
    *,
    members_each: int,
) -> RefusedDraws | None:
    """Try the first, the smallest and the largest draw, and more where one of them is refused.

    Parameters
    ----------
    variation : SampledVariation
    values : array, shape (N,)
        Of all samples.
    attempt : callable
    members_each : int
        Of each sample.

    Returns
    -------
    RefusedDraws or None
        None: none of them is.

    Raises
    ------
    UsageError
        If all that are tried are refused.
    """
    distinct, counts = np.unique(values, return_counts=True)
    reasons: dict[int, str] = {}

    def reason(index: int) -> str:
        if index not in reasons:
            reasons[index] = attempt(float(distinct[index]))
        return reasons[index]

    last = len(distinct) - 1
    first = int(np.searchsorted(distinct, values[0]))
    if not (reason(first) or reason(0) or reason(last)):
        return None
    probes = np.linspace(0, last, min(len(distinct), PROBES)).astype(int).tolist()
    probes = sorted({first, *probes})
    wrong = [index for index in probes if reason(index)]
    example = first if reason(first) else wrong[0]
    value = float(distinct[example])
    number = int(np.flatnonzero(values == distinct[example])[0]) * members_each
    if len(wrong) == len(probes):
        raise UsageError(
            f"{variation.key} = {quoted(value)}, drawn from {variation} for member {number}: "
            f"{reasons[example]}; {_all_of(len(probes))}"
        )
    is_wrong = np.zeros(len(distinct), bool)
    for low, high in pairwise(probes):
        change = _change(low, high, reason)
        is_wrong[low:change] = bool(reason(low))
        is_wrong[change : high + 1] = bool(reason(high))
    accepted = next(index for index in probes if not reason(index))
    return RefusedDraws(
        variation,
        int(counts[is_wrong].sum()),
        len(values),
        number,
        value,
        reasons[example],
        float(distinct[accepted]),
    )


def _change(low: int, high: int, reason: Callable[[int], str]) -> int:
    """Return the first index behind ``low`` that is taken or refused as ``high`` is."""
    is_wrong = bool(reason(low))
    if bool(reason(high)) == is_wrong:
        return high
    while high - low > 1:
        middle = (low + high) // 2
        if bool(reason(middle)) == is_wrong:
            low = middle
        else:
            high = middle
    return high


def _all_of(count: int) -> str:
    tried = "the only draw is" if count == 1 else f"so are all {count} draws that were tried"
    return f"{tried}; choose another distribution"


def _way_out(variation: SampledVariation) -> str:
    if variation.distribution == "normal":
        return "truncate the distribution with 'lower' and 'upper'"
    return "use a bounded distribution, such as uniform"
