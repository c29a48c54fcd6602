"""Times [s], on the grid of whole nanoseconds and between."""

from __future__ import annotations

NANOSECONDS = 1_000_000_000  # in a second


def last_nanosecond(t: float) -> int:
    """Return the last whole nanosecond at or before a time [s].

    That of a time on the grid, ``n / 1e9``, is n itself.
    """
    nearest = round(t * NANOSECONDS)
    return nearest if nearest / NANOSECONDS <= t else nearest - 1


def whole_duration(begin: float, end: float) -> float | None:
    """Return the time between two times of whole nanoseconds [s]; None: one of them is none."""
    first = last_nanosecond(begin)
    last = last_nanosecond(end)
    is_whole = first / NANOSECONDS == begin and last / NANOSECONDS == end
    return (last - first) / NANOSECONDS if is_whole else None


def duration(begin: float, end: float) -> float:
    """Return the time between two times [s]; that of whole nanoseconds is a whole number, too."""
    whole = whole_duration(begin, end)
    return end - begin if whole is None else whole
