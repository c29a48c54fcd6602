"""Guaranteed intervals of theta as text."""

from __future__ import annotations


def interval_text(lower: float | None, upper: float | None, *, is_explained: bool) -> str:
    """Return an interval as text, whose ends may be missing, or that no theta is in it."""
    if not is_explained:
        return "none"
    below = "-inf" if lower is None else f"{lower:.6g}"
    above = "inf" if upper is None else f"{upper:.6g}"
    return f"{below} to {above}"


def reach_text(first_order: float, *, holds: bool) -> str:
    """Return how far the first order reaches, and whether it holds, as text."""
    text = f"first order {first_order:.2g} to each side"
    return text if holds else f"{text}, which does not hold for so large a bound"
