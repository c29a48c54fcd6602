"""Rows of two runs, paired window by window, are those that pairing them as a whole gives."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import LogError
from cosim.log import signal_comparison
from cosim.log.signal_comparison import windows
from tests.log.recordings import numbered


@st.composite
def runs(draw):
    """Draw instants in order, several rows at some of them, and where their blocks end."""
    times = sorted(draw(st.lists(st.integers(0, 12), max_size=25)))
    cuts = sorted(draw(st.lists(st.integers(0, len(times)), max_size=6)))
    return times, cuts


def blocks(run):
    """Yield the blocks of a run, whose rows have their numbers."""
    times, cuts = run
    bounds = [0, *cuts, len(times)]
    for first, last in pairwise(bounds):
        numbers = np.arange(first, last, dtype=float)[:, np.newaxis]
        yield np.array(times[first:last], dtype=np.int64), numbers


@given(runs(), runs())
def test_windows_pair_what_stands_at_the_same_instant(a, b):
    """Every row comes once, in order; those of one instant pair up in their order."""
    all_a = []
    all_b = []
    pairs = []
    for window in windows(blocks(a), blocks(b)):
        rows_a = window.a[1][:, 0]
        rows_b = window.b[1][:, 0]
        all_a += rows_a.tolist()
        all_b += rows_b.tolist()
        if window.shared is None:
            pairs += zip(rows_a.tolist(), rows_b.tolist(), strict=True)
        else:
            shared_a, shared_b = window.shared
            pairs += zip(rows_a[shared_a].tolist(), rows_b[shared_b].tolist(), strict=True)
    instants_b = {instant: row for row, instant in enumerate(numbered(b[0]))}
    needed = []
    for row, instant in enumerate(numbered(a[0])):
        if instant in instants_b:
            needed.append((row, instants_b[instant]))
    assert all_a == list(range(len(a[0])))
    assert all_b == list(range(len(b[0])))
    assert pairs == needed


def test_rows_of_one_instant_are_bounded(monkeypatch):
    """They must be in memory together."""
    monkeypatch.setattr(signal_comparison, "MOST_ROWS", 10)
    run = ([3] * 40, list(range(2, 40, 2)))
    with pytest.raises(LogError, match=r"more than 10 rows at t = 3e-09 s: too many"):
        list(windows(blocks(run), blocks(run)))
