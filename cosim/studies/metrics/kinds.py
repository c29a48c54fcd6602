"""The reductions of metrics: how each is written, and what it makes of the values of a run.

The values of a reduction are those of its expression at the rows where it has one, that is where
it is not NaN, and where the condition of the reduction is true, if it has one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from cosim.arrays import NAN
from cosim.native.numerics.reductions import KeptValues

SETTLING_SHARE: Final = (
    0.02  # of the change from the first to the last value, where no band is given
)


@dataclass(frozen=True)
class ReductionKind:
    """A kind of reduction.

    Parameters
    ----------
    usage : str
        How it is written.
    parts : tuple of str
        What is to be kept of the values (:data:`cosim.native.numerics.reductions.PARTS`).
    value : callable
        Returns its value, NaN where it has none, for values of which there is one at least, and
        the band, None where there is none.
    takes_condition : bool
        Whether a condition may restrict the rows.
    needs_condition : bool
    of_condition : bool
        Whether it is of a condition, not of an expression.
    takes_band : bool
    without_values : float
        Its value where there are no values.
    """

    usage: str
    parts: tuple[str, ...]
    value: Callable[[KeptValues, float | None], float]
    takes_condition: bool = True
    needs_condition: bool = False
    of_condition: bool = False
    takes_band: bool = False
    without_values: float = NAN


def _std(kept: KeptValues) -> float:
    """Return the standard deviation.

    Sums of differences to the first value x lose little: n var >= (x - mean)^2, as x is one of the
    values, so that the sum of squares of the differences is at most (n + 1) times n var.
    """
    mean = kept.shifted_sum / kept.number
    variance = kept.shifted_squares / kept.number - mean * mean
    return 0.0 if variance < 0.0 else math.sqrt(variance)


def _settling(kept: KeptValues, band: float | None) -> float:
    """Return the instant of the first value from which on all are within a band of the last one.

    Parameters
    ----------
    kept : KeptValues
    band : float or None
        None: a share of the change. One that has no value has no such instant.
    """
    if band is None:
        band = SETTLING_SHARE * abs(kept.last - kept.first)
    return kept.settled(band) if band >= 0.0 else NAN


def _overshoot(kept: KeptValues) -> float:
    """Return how far values are beyond the last one, as a share of the change from the first."""
    change = kept.last - kept.first
    if change == 0.0:
        return NAN
    excess = kept.high - kept.last if change > 0.0 else kept.last - kept.low
    return excess / abs(change)


def _simple(
    name: str, parts: tuple[str, ...], value: Callable[[KeptValues], float]
) -> ReductionKind:
    usage = f"{name}(EXPRESSION), or {name}(EXPRESSION, CONDITION)"
    return ReductionKind(usage, parts, lambda kept, _: value(kept))


KINDS: Final[Mapping[str, ReductionKind]] = {
    "last": _simple("last", ("ends",), lambda kept: kept.last),
    "initial": ReductionKind(
        "initial(EXPRESSION), or first(EXPRESSION, CONDITION)",
        ("ends",),
        lambda kept, _: kept.first,
        takes_condition=False,
    ),
    # -0 + 0 is 0: which one of zeros with different signs is found depends on the blocks of a run
    "max": _simple("max", ("high",), lambda kept: kept.high + 0.0),
    "min": _simple("min", ("low",), lambda kept: kept.low + 0.0),
    "mean": _simple("mean", ("sum",), lambda kept: kept.sum / kept.number),
    "rms": _simple("rms", ("squares",), lambda kept: math.sqrt(kept.squares / kept.number)),
    "std": _simple("std", ("shifted", "ends"), _std),
    "integral": _simple("integral", ("integral",), lambda kept: kept.integral),
    "count": ReductionKind(
        "count(EXPRESSION), or count(EXPRESSION, CONDITION)",
        (),
        lambda kept, _: float(kept.number),
        without_values=0.0,
    ),
    "first": ReductionKind(
        "first(EXPRESSION, CONDITION)",
        ("ends",),
        lambda kept, _: kept.first,
        needs_condition=True,
    ),
    "share": ReductionKind(
        "share(CONDITION), or share(CONDITION, CONDITION)",
        ("sum",),
        lambda kept, _: kept.sum / kept.number,
        of_condition=True,
    ),
    "settling": ReductionKind(
        "settling(EXPRESSION), settling(EXPRESSION, BAND), or one of them with a CONDITION behind",
        ("kept", "ends"),
        _settling,
        takes_band=True,
    ),
    "overshoot": _simple("overshoot", ("ends", "low", "high"), _overshoot),
}
