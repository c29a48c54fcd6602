"""Figures with their intervals, as texts."""

from __future__ import annotations

import math
from typing import Final

from cosim.studies.analysis.columns import NumberColumn
from cosim.studies.analysis.confidence import ConfidenceInterval

_MOST_MEMBERS: Final = 5  # that a line names
_MOST_DECIMALS: Final = 8
_MOST_ROUNDED: Final = 3  # digits before the point that are more than the two that are known
_LARGEST: Final = 1e8  # that is written without an exponent


def number_text(value: float | None, digits: int = 6) -> str:
    """Return a number in so many digits; empty: there is none."""
    return "" if value is None else f"{value:.{digits}g}"


def text_with_half_width(value: float | None, interval: ConfidenceInterval) -> str:
    """Return a number with half of its interval, in two digits of that: ``0.1234 ± 0.0010``.

    Large and small ones have one exponent: ``(2.35 ± 0.16)e+10``.
    """
    if value is None or interval.lower is None or interval.upper is None:
        return number_text(value)
    half_width = 0.5 * (interval.upper - interval.lower)
    if not half_width > 0.0 or not math.isfinite(half_width):
        return number_text(value)
    exponent = int(f"{half_width:.1e}".partition("e")[2])
    decimals = 1 - exponent
    if 0 <= decimals <= _MOST_DECIMALS and abs(value) < _LARGEST:
        return f"{value:.{decimals}f} ± {half_width:.{decimals}f}"
    if -_MOST_ROUNDED <= decimals < 0 and abs(value) < _LARGEST:
        return f"{value:.0f} ± {half_width:.0f}"
    common = max(exponent, math.floor(math.log10(abs(value))) if value else exponent)
    decimals += common
    unit = 10.0**common
    return f"({value / unit:.{decimals}f} ± {half_width / unit:.{decimals}f})e{common:+03d}"


def interval_text(interval: ConfidenceInterval) -> str:
    """Return an interval: ``0.12 to 0.34``; an end that is not known is named."""
    lower, upper = interval.lower, interval.upper
    if lower is None and upper is None:
        return ""
    if lower is None:
        return f"to {upper:.4g}; too few members for the lower end"
    if upper is None:
        return f"from {lower:.4g}; too few members for the upper end"
    return f"{lower:.4g} to {upper:.4g}"


def percent_interval_text(interval: ConfidenceInterval) -> str:
    """Return the interval of a share in percent: ``12.3 % to 34.5 %``."""
    if interval.lower is None or interval.upper is None:
        return ""
    return f"{100.0 * interval.lower:.3g} % to {100.0 * interval.upper:.3g} %"


def percent_text(probability: float) -> str:
    """Return a probability in percent, the half as ``median``."""
    return "median" if probability == 0.5 else f"{100.0 * probability:g} %"


def members_text(numbers: NumberColumn) -> str:
    """Return the first of some members: ``3, 8, and 12 more``."""
    shown = ", ".join(map(str, numbers[:_MOST_MEMBERS].tolist()))
    more = len(numbers) - _MOST_MEMBERS
    return f"{shown}, and {more} more" if more > 0 else shown
