"""Rows of components are read in few passes, in their order, in little memory, or refused."""

from __future__ import annotations

import json
import struct
import tracemalloc

import numpy as np
import pytest
from mcap.reader import make_reader

from cosim.core.contracts import Block
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError
from cosim.log import McapRecorder, open_log
from cosim.log import container as log_container
from cosim.log import rows as log_rows
from cosim.log.chunks import AHEAD
from cosim.log.diff import diff
from tests.log.crafting import put_together, rows_of_plant, take_apart
from tests.log.recordings import (
    STEP_NS,
    layout,
    make_chunks_small,
    many,
    plan,
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


def test_many_components_need_few_passes(tmp_path, monkeypatch, passes):
    """Small ones one; of more than are kept, one for each part that is; the hash needs one."""
    lay = many(300)
    rows = record(tmp_path / "a.mcap", steps=5, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    for name in ("c7.y", "c299.y", "c0.y"):
        assert len(log[name]) == 6
    assert len(passes) == 1
    monkeypatch.setattr(log_rows, "_MOST_WHOLE", 100 * 6 * 3 * 8)  # 100 components
    log = open_log(tmp_path / "a.mcap")
    log.content_hash()
    assert len(passes) == 1 + 1
    for i in range(300):
        assert same_bits(log[f"c{i}.y"], rows[:, 2 * i : 2 * i + 2])
    assert len(passes) == 1 + 1 + 3
    passes.clear()
    backwards = open_log(tmp_path / "a.mcap")
    for name in reversed(backwards.signals):
        assert len(backwards[name]) == 6
    assert len(passes) <= 4


def test_rows_out_of_order_are_sorted_within_limits(short_log, tmp_path, monkeypatch):
    """As another tool may write them, however they are asked for; within limits of the memory."""
    content = take_apart(short_log)
    content.messages.reverse()
    turned = put_together(content, tmp_path / "b.mcap", chunk_size=5000)
    whole = open_log(short_log)
    begin, end = (whole.t[number] for number in (len(whole.t) // 3, len(whole.t) // 2))
    for kept in (log_rows._MOST_KEPT, 0):
        monkeypatch.setattr(log_rows, "_MOST_KEPT", kept)
        log = open_log(turned)
        assert log.content_hash() == whole.content_hash()
        assert same_bits(log.t, whole.t)
        assert same_bits(log["plant.x_a"], whole["plant.x_a"])
        assert same_bits(np.vstack([rows for _, rows in log.blocks("plant")]), whole.rows("plant"))
        part = open_log(turned).window(begin, end)
        assert same_bits(part["plant.x_a"], whole.window(begin, end)["plant.x_a"])
        assert same_bits(part.t, whole.t[(whole.t >= begin) & (whole.t <= end)])
    monkeypatch.setattr(log_rows, "_MOST_SORTED", 100)
    with pytest.raises(LogError, match=r"not in order of time, and .* bytes are too many"):
        open_log(turned).content_hash()
    assert open_log(short_log).content_hash() == open_log(short_log).recorded_hash


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


def test_a_diff_in_pieces_is_the_diff_as_a_whole(tmp_path, monkeypatch):
    """Chunks of two runs end at other instants, and some instants only one of them has."""
    rows = record(tmp_path / "a.mcap", steps=700)
    changed = rows.copy()
    changed[311:, 2] += 1.0
    record(tmp_path / "b.mcap", rows=changed[:650])
    a = tmp_path / "a.mcap"
    b = tmp_path / "b.mcap"
    tolerances = (0.0, 0.5)
    whole = [diff(open_log(a), open_log(b), rtol=rtol) for rtol in tolerances]
    monkeypatch.setattr(log_rows, "_MOST_WHOLE", 0)
    monkeypatch.setattr("cosim.log.rows._ROWS", 37)
    assert [diff(open_log(a), open_log(b), rtol=rtol) for rtol in tolerances] == whole
    assert json.dumps(whole[0].to_dict())
    assert diff(open_log(a), open_log(a)).equal


def test_a_time_beyond_63_bits_is_damage(short_log, tmp_path):
    """It would be negative; by streaming and by reading."""
    content = take_apart(short_log)
    number, _, sequence, data = content.messages[-1]
    content.messages[-1] = (number, 2**63, sequence, data)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    for read in (log.content_hash, log.load):
        with pytest.raises(LogError, match=rf"a time beyond {2**63 - 1} ns"):
            read()


def test_both_limits_of_a_jump_are_streamed(tmp_path, monkeypatch):
    """Rows of one instant are in order, wherever a piece of the rows ends."""
    times = np.array([0, 1, 1, 1, 2, 3, 3], dtype=np.int64) * STEP_NS
    lay = Layout((Channel("c", Interface((), (Signal("y"),)), 0),))
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan(lay))
        recorder.write(Block(0, times, times / 1e9, STEP_NS / 1e9), np.arange(7.0)[:, np.newaxis])
    whole = diff(open_log(tmp_path / "a.mcap"), open_log(tmp_path / "a.mcap"))
    for size in (1, 2, 3):
        monkeypatch.setattr("cosim.log.rows._ROWS", size)
        monkeypatch.setattr(log_rows, "_MOST_WHOLE", 0)
        log = open_log(tmp_path / "a.mcap")
        assert log.content_hash() == log.recorded_hash
        assert diff(log, open_log(tmp_path / "a.mcap")) == whole
        assert whole.rows[0].rows == (7, 7, 7)


def test_a_row_off_the_grid_is_named(short_log, tmp_path, subtests):
    """Its values may be right, but no run has a row there."""
    for row in (0, 3, -1):
        content = take_apart(short_log)
        index = rows_of_plant(content)[row]
        number, time_ns, sequence, data = content.messages[index]
        content.messages[index] = (number, time_ns + 1, sequence, data)
        moved = open_log(put_together(content, tmp_path / "b.mcap"))
        text = r"b\.mcap is damaged: a row of 'plant' at t = .* 0\.001 s apart"
        for read in (moved.load, moved.content_hash, lambda log=moved: log.rows("plant")):
            with subtests.test(case=(row, read)), pytest.raises(LogError, match=text):
                read()


def test_a_component_of_many_elements_is_split_and_comes_back(tmp_path, monkeypatch):
    """More than 4096 elements are several channels; their rows are joined as they come."""
    lay = layout(wide=9000)
    rows = record(tmp_path / "a.mcap", steps=30, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    assert log.channels["wide"] == lay["wide"]
    assert same_bits(log["wide.y"], rows[:, 10:])
    assert same_bits(log["wide.y[4999]"], rows[:, 10 + 4999])
    with (tmp_path / "a.mcap").open("rb") as stream:
        topics = [channel.topic for channel in make_reader(stream).get_summary().channels.values()]
    assert topics == ["/plant", "/identifier", "/wide", "/wide.2", "/wide.3", "/cosim/log"]
    monkeypatch.setattr(log_rows, "_MOST_WHOLE", 0)
    streamed = [rows for _, rows in open_log(tmp_path / "a.mcap").blocks("wide")]
    assert same_bits(np.concatenate(streamed), log.rows("wide"))


def test_channels_of_a_component_have_rows_at_the_same_times(tmp_path, subtests):
    """A row less or at another time is damage, also where no summary counts the rows."""
    record(tmp_path / "a.mcap", steps=5, lay=layout(wide=5000))
    for text in ("different numbers of rows", "have rows at different times"):
        content = take_apart(tmp_path / "a.mcap")
        (last,) = [n for n, channel in content.channels.items() if channel[0] == "/wide.2"]
        position = max(i for i, message in enumerate(content.messages) if message[0] == last)
        number, time_ns, *rest = content.messages.pop(position)
        if "times" in text:
            content.messages.append((number, time_ns + STEP_NS, *rest))
        log = open_log(put_together(content, tmp_path / "b.mcap", use_statistics=False))
        for read in (log.content_hash, lambda log=log: log.rows("wide")):
            with subtests.test(case=(text, read)), pytest.raises(LogError, match=text):
                read()
