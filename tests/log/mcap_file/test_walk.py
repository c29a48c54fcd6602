"""A file that lost its end is refused, with how far it goes."""

from __future__ import annotations

import pytest
from mcap.reader import make_reader

from cosim.errors import LogError
from cosim.log import open_log
from tests.log.recordings import (
    make_chunks_small,
    record,
)


def test_truncated_files_are_refused_with_the_byte(long_log, tmp_path, subtests):
    """What a crash leaves is not called damaged."""
    data = long_log[0].path.read_bytes()
    path = tmp_path / "a.mcap"
    for share in (0.0, 0.01, 0.3, 0.9, 0.9999):
        stop = int(len(data) * share)
        path.write_bytes(data[:stop])
        text = rf"a\.mcap is truncated at byte {stop}: .*: run it again"
        with (
            subtests.test(case=share),
            pytest.raises(LogError, match=text if stop else "is empty; expected an MCAP file"),
        ):
            open_log(path)


def test_the_error_of_a_truncated_file_names_the_end_of_its_last_whole_chunk(tmp_path, monkeypatch):
    """Up to there it need not be whole: another component may have its last rows before."""
    make_chunks_small(monkeypatch, 5000)
    path = tmp_path / "a.mcap"
    record(path)
    data = path.read_bytes()
    with path.open("rb") as stream:
        first, second = make_reader(stream).get_summary().chunk_indexes[:2]
    end_of_first = first.chunk_start_offset + first.chunk_length
    end_of_second = second.chunk_start_offset + second.chunk_length
    for stop, last in [(end_of_second, second), (end_of_first, first), (end_of_first - 1, None)]:
        path.write_bytes(data[:stop])
        text = "no complete row" if last is None else rf" {last.message_end_time / 1e9} s.* recover"
        with pytest.raises(LogError, match=f"truncated.*{text}"):
            open_log(path)
