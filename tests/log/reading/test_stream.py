"""Rows read piece by piece are those of the log as a whole."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cosim.core.contracts import Block
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError
from cosim.log import McapRecorder, open_log
from cosim.log import rows as log_rows
from cosim.log.diff import diff
from tests.log.crafting import put_together, rows_of_plant, take_apart
from tests.log.recordings import (
    STEP_NS,
    layout,
    plan,
    record,
    same_bits,
)


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


def test_a_component_of_many_channels_is_streamed(tmp_path, monkeypatch):
    """Its parts are joined as they come."""
    lay = layout(wide=9000)
    record(tmp_path / "a.mcap", steps=30, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    assert log.content_hash() == log.recorded_hash
    monkeypatch.setattr(log_rows, "_MOST_WHOLE", 0)
    streamed = [rows for _, rows in open_log(tmp_path / "a.mcap").blocks("wide")]
    assert same_bits(np.concatenate(streamed), log.rows("wide"))


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


def test_a_channel_with_fewer_rows_than_another_is_damage(tmp_path):
    """Also where no summary counts them, and the rows are read in pieces."""
    record(tmp_path / "a.mcap", steps=5, lay=layout(wide=5000))
    content = take_apart(tmp_path / "a.mcap")
    (last,) = [number for number, channel in content.channels.items() if channel[0] == "/wide.2"]
    position = max(i for i, message in enumerate(content.messages) if message[0] == last)
    del content.messages[position]
    put_together(content, tmp_path / "b.mcap", use_statistics=False)
    log = open_log(tmp_path / "b.mcap")
    for read in (log.content_hash, lambda: log.rows("wide")):
        with pytest.raises(LogError, match="different numbers of rows"):
            read()


def test_channels_with_rows_at_other_times_are_damage(tmp_path):
    """A component has its rows at one time, in all its channels."""
    record(tmp_path / "a.mcap", steps=5, lay=layout(wide=5000))
    content = take_apart(tmp_path / "a.mcap")
    (last,) = [number for number, channel in content.channels.items() if channel[0] == "/wide.2"]
    position = max(i for i, message in enumerate(content.messages) if message[0] == last)
    number, time_ns, sequence, data = content.messages[position]
    content.messages[position] = (number, time_ns + 10**6, sequence, data)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    for read in (log.content_hash, lambda: log.rows("wide")):
        with pytest.raises(LogError, match="have rows at different times"):
            read()


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
