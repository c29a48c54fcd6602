"""Rows as the messages of chunks."""

from __future__ import annotations

import pytest
from mcap.reader import make_reader

from tests.log.recordings import many, record


@pytest.mark.slow
def test_many_components_have_no_more_pieces_than_few(tmp_path):
    """A piece is what a chunk has of a component: it costs the same, however few rows it has.

    Of 1000 components a step takes 49 kB: chunks of 1 MiB would have 21 rows of each, in 3 pieces.
    """
    record(tmp_path / "a.mcap", steps=60, size=60, lay=many(1000))
    with (tmp_path / "a.mcap").open("rb") as stream:
        assert make_reader(stream).get_summary().statistics.chunk_count <= 1
