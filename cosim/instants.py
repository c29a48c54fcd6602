"""Times in seconds, on the grid of whole nanoseconds and between.

A time on the grid is ``n / 1e9``, the double next to it. Up to 2**22 s (48 days) these are less
than half a nanosecond from what they stand for, so that each of them stands for one n.
"""

from __future__ import annotations

NANOSECONDS = 1_000_000_000  # in a second


def last_nanosecond(t: float) -> int:
    """Return the number of the last whole nanosecond at or before a time [s]."""
    nearest = round(t * NANOSECONDS)
    return nearest if nearest / NANOSECONDS <= t else nearest - 1


def first_nanosecond(t: float) -> int:
    """Return the number of the first whole nanosecond at or behind a time [s]."""
    return -last_nanosecond(-t)


def whole_duration(begin: float, end: float) -> float | None:
    """Return the time between two times on the grid [s]; None: one of them is not on it."""
    first = last_nanosecond(begin)
    last = last_nanosecond(end)
    is_whole = first / NANOSECONDS == begin and last / NANOSECONDS == end
    return (last - first) / NANOSECONDS if is_whole else None


def duration(begin: float, end: float) -> float:
    """Return the time between two times [s]: between two on the grid it is on the grid, too."""
    whole = whole_duration(begin, end)
    return end - begin if whole is None else whole
