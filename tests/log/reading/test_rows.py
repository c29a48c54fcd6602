"""Rows of components are read in few passes, in their order, in little memory."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
from mcap.reader import make_reader

from cosim.errors import LogError
from cosim.log import container as log_container
from cosim.log import open_log
from cosim.log import rows as log_rows
from cosim.log.chunks import AHEAD
from tests.log.crafting import put_together, take_apart
from tests.log.recordings import (
    STEP_NS,
    layout,
    make_chunks_small,
    many,
    record,
    same_bits,
)


@pytest.fixture
def passes(monkeypatch):
    """Return a list with an entry for each pass over a file."""
    passes = []
    read_blocks = log_container.Container.blocks

    def counted(self, *channel_ids, **window):
        passes.append(self)
        return read_blocks(self, *channel_ids, **window)

    monkeypatch.setattr(log_container.Container, "blocks", counted)
    return passes


def test_small_components_need_one_pass(tmp_path, passes):
    """Whichever is asked for first."""
    record(tmp_path / "a.mcap", steps=5, lay=many(300))
    log = open_log(tmp_path / "a.mcap")
    for name in ("c7.y", "c299.y", "c0.y"):
        assert len(log[name]) == 6
    assert len(passes) == 1


def test_many_components_need_few_passes(tmp_path, monkeypatch, passes):
    """The hash needs one; to ask for one component after another needs few."""
    monkeypatch.setattr(log_rows, "_MOST_WHOLE", 100 * 6 * 3 * 8)  # 100 components
    lay = many(300)
    rows = record(tmp_path / "a.mcap", steps=5, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    log.content_hash()
    assert len(passes) == 1
    for i in range(300):
        assert same_bits(log[f"c{i}.y"], rows[:, 2 * i : 2 * i + 2])
    assert len(passes) == 1 + 3
    passes.clear()
    backwards = open_log(tmp_path / "a.mcap")
    for name in reversed(backwards.signals):
        assert len(backwards[name]) == 6
    assert len(passes) <= 4


def test_rows_out_of_order_are_sorted_within_limits(short_log, tmp_path, monkeypatch):
    """As another tool may write them; without a limit a small file could fill the memory."""
    content = take_apart(short_log)
    content.messages.reverse()
    turned = put_together(content, tmp_path / "b.mcap")
    assert open_log(turned).content_hash() == open_log(short_log).content_hash()
    monkeypatch.setattr(log_rows, "_MOST_SORTED", 100)
    with pytest.raises(LogError, match=r"not in order of time, and .* bytes are too many"):
        open_log(turned).content_hash()
    assert open_log(short_log).content_hash() == open_log(short_log).recorded_hash


def test_rows_out_of_order_are_sorted_however_they_are_asked_for(short_log, tmp_path, monkeypatch):
    """Times, a signal, a part in some time; of components with many rows, too."""
    content = take_apart(short_log)
    content.messages.reverse()
    turned = put_together(content, tmp_path / "b.mcap", chunk_size=5000)
    whole = open_log(short_log)
    begin, end = (whole.t[number] for number in (len(whole.t) // 3, len(whole.t) // 2))
    for kept in (log_rows._MOST_KEPT, 0):
        monkeypatch.setattr(log_rows, "_MOST_KEPT", kept)
        log = open_log(turned)
        assert same_bits(log.t, whole.t)
        assert same_bits(log["plant.x_a"], whole["plant.x_a"])
        assert same_bits(np.vstack([rows for _, rows in log.blocks("plant")]), whole.rows("plant"))
        part = open_log(turned).window(begin, end)
        assert same_bits(part["plant.x_a"], whole.window(begin, end)["plant.x_a"])
        assert same_bits(part.t, whole.t[(whole.t >= begin) & (whole.t <= end)])


def test_room_is_made_for_rows_that_can_be_there(short_log, tmp_path):
    """Not for those that a summary counts; a log without a result says no number of steps."""
    content = take_apart(short_log)
    path = tmp_path / "a.mcap"
    content.metadata = [record for record in content.metadata if record[0] != "cosim.result"]
    put_together(content, path)
    with path.open("rb") as stream:
        counts = make_reader(stream).get_summary().statistics.channel_message_counts
    data = bytearray(path.read_bytes())
    found = struct.pack("<HQHQ", 1, counts[1], 2, counts[2])
    assert data.count(found) == 1
    data[data.index(found) + 2 : data.index(found) + 10] = struct.pack("<Q", 2**50)
    data[-12:-8] = bytes(4)  # no CRC of the summary
    path.write_bytes(data)
    log = open_log(path)
    for read in (log.load, log.content_hash):
        with pytest.raises(LogError, match=rf"a\.mcap .*{2**50} rows of 'plant'"):
            read()


@pytest.mark.slow
def test_reading_a_component_takes_little_more_memory_than_it_has(tmp_path, monkeypatch):
    """The file is read chunk by chunk, and the rows go to their place at once.

    Other components are read ahead in the first pass only where all are small.
    """
    make_chunks_small(monkeypatch, 50_000)
    record(tmp_path / "a.mcap", steps=2000, lay=layout(wide=500))
    log = open_log(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    largest = max(index.uncompressed_size for index in summary.chunk_indexes)
    assert len(summary.chunk_indexes) > 2 * AHEAD
    tracemalloc.start()
    rows = log.rows("plant")
    # Of the chunks in hand, each compressed and not, with room for one an eighth larger.
    in_hand = AHEAD * 2 * 9 / 8 * largest
    assert tracemalloc.get_traced_memory()[1] < 4 * rows.nbytes + in_hand
    tracemalloc.stop()


def test_chunks_read_one_behind_the_other_keep_their_rows(tmp_path, monkeypatch, subtests):
    """However they are read: their memory is that of chunks before them."""
    make_chunks_small(monkeypatch, 5_000)
    for compression in ("zstd", "lz4", "none"):
        path = tmp_path / f"{compression}.mcap"
        rows = record(path, steps=1000, compression=compression)
        with path.open("rb") as stream:
            assert len(make_reader(stream).get_summary().chunk_indexes) > 3 * AHEAD
        log = open_log(path)
        log.load()
        with monkeypatch.context() as streaming, subtests.test(case=compression):
            for name, channel in log.channels.items():
                assert same_bits(log.rows(name), rows[:: channel.period, channel.columns])
            streaming.setattr(log_rows, "_MOST_WHOLE", 0)
            streaming.setattr(log_rows, "_MOST_KEPT", 0)
            for name, channel in log.channels.items():
                streamed = [values for _, values in open_log(path).blocks(name)]
                assert same_bits(np.vstack(streamed), rows[:: channel.period, channel.columns])
                times = open_log(path).time_ns(name)
                assert np.array_equal(times, np.arange(len(times)) * channel.period * STEP_NS)
