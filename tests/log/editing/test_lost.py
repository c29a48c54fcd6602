"""Rows that are missing, as intervals."""

from __future__ import annotations

import numpy as np

from cosim.instants import Grid
from cosim.log.recovering import Interval, missing_rows


def test_missing_rows_are_named_by_their_instants():
    """The closed form of a few cases."""
    times = np.array([0, 10, 40, 50])
    assert missing_rows(times, Grid(0, 1), 10, 50).lost == (Interval(20, 30, 2),)
    assert missing_rows(times, Grid(0, 5), 2, 75).lost == (Interval(20, 30, 2), Interval(60, 70, 2))
    assert missing_rows(np.array([20]), Grid(0, 10), 1, 29).lost == (Interval(0, 10, 2),)
    none = missing_rows(np.empty(0, np.int64), Grid(5, 10), 1, 25)
    assert (none.count, none.lost) == (0, (Interval(5, 25, 3),))
