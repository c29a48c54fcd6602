"""Rows that grow are those of one array, whatever memory is taken at a time."""

import numpy as np

from cosim.core import growing_rows
from cosim.core.growing_rows import GrowingRows


def test_rows_stay_as_they_were_written(monkeypatch):
    """Each place begins with the last row that there is, also where its memory is new."""
    monkeypatch.setattr(growing_rows, "MEMORY_BYTES", 100)
    written = np.random.default_rng(1).random((60, 2))
    rows = GrowingRows(2)
    done = 0
    for steps in (3, 1, 8, 20, 2, 25):
        first = min(done, 1)
        place = rows.place(steps, expected=60 - done)
        assert np.array_equal(place[:first], written[done - first : done])
        place[first:] = written[done : done + steps + 1 - first]
        rows.append(place, first)
        done += steps + 1 - first
    assert done == rows.count == 60
    assert np.array_equal(rows.all(), written)
