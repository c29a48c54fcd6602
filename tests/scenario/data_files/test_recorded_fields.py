"""Fields of an MCAP of another tool as field data, without a scenario."""

from __future__ import annotations

import re

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from tests.log.foreign.field_logs import EPOCH, write_json
from tests.scenario.refusals import check_refused

COUNT = 20
MS = 1_000_000


@pytest.fixture
def recording(tmp_path):
    """Write two topics of different rates; the second begins 5 ms later."""
    fast = []
    for i in range(COUNT):
        row = {"x": [i, -i], "s": (EPOCH // MS) + 10 * i}
        fast.append((EPOCH + i * 10 * MS, row))
    slow = [(EPOCH + 5 * MS + i * 40 * MS, {"z": i / 3}) for i in range(5)]
    return write_json(tmp_path / "log.mcap", {"/fast": fast, "/slow": slow})


def test_topics_of_different_rates_share_one_table(recording):
    """Each is measured at its own times, and not at those of the other."""
    columns = {"x": "/fast.x", "z": ["/slow.z", "/fast.x[0]"]}
    data = cosim.read_field_data(recording, columns=columns)
    fast = (np.arange(COUNT) * 10 - 5) * MS
    slow = np.arange(5) * 40 * MS
    times = np.sort(np.concatenate([fast, slow]))
    np.testing.assert_array_equal(data.t, times / 1e9)
    of_fast = np.isin(times, fast)
    np.testing.assert_array_equal(data["x"][of_fast], np.outer(np.arange(COUNT), [1, -1]))
    assert np.isnan(data["x"][~of_fast]).all()
    np.testing.assert_array_equal(data["z"][~of_fast, 0], np.arange(5) / 3)
    assert np.isnan(data["z"][~of_fast, 1]).all()
    # the element of /slow is measured from t = 0 on
    assert data.zero_ns == EPOCH + 5 * MS


def test_numbers_are_times_in_their_unit(recording):
    """Here ms since 1970, as the offset is."""
    columns = {"x": "/fast.x"}
    data = cosim.read_field_data(
        recording, columns=columns, time="s", time_unit="ms", offset=EPOCH / MS + 20
    )
    np.testing.assert_array_equal(data.t, (np.arange(COUNT) * 10 - 20) / 1e3)


def test_options_that_select_no_samples_are_refused(recording):
    """With the way out."""
    cases = [
        ({}, r"expected a map, .*columns"),
        ({"columns": {"y": []}}, r"columns: expected a column .*'y': \[\]"),
        ({"columns": {"y": "/fast.x"}, "same_time": "spread"}, r"same_time: .*\"last\" .*'spread'"),
        ({"columns": {"y": "/fast.x"}, "time_unit": "ps"}, r"time_unit: .*'ps'"),
        ({"columns": {"y": "/fast.x"}, "offset": 1e12}, r"within 2\*\*63 ns of the offset"),
    ]
    check_refused(cases, lambda options: cosim.read_field_data(recording, **options))


def test_a_gap_of_more_than_twice_the_median_distance_is_noted(tmp_path):
    """With its beginning, for the topic that has it; a gap of twice the distance is none."""
    notes = {}
    for missing in (1, 2):
        rows = [i for i in range(20) if not 8 < i <= 8 + missing]
        fast = [(EPOCH + i * 10 * MS, {"x": float(i)}) for i in rows]
        slow = [(EPOCH + i * 40 * MS, {"z": float(i)}) for i in range(5)]
        path = write_json(tmp_path / f"{missing}.mcap", {"/fast": fast, "/slow": slow})
        data = cosim.read_field_data(path, columns={"x": "/fast.x", "z": "/slow.z"})
        notes[missing] = data.diagnostics
    assert notes[1] == ()
    (note,) = notes[2]
    assert re.search(r"2\.mcap', topic '/fast': .*0\.03 s.*t = 0\.08 s.*0\.01 s", note)


def test_no_more_numbers_are_kept_than_memory_has(recording, monkeypatch):
    """Of all signals at all times, which topics of other rates multiply."""
    monkeypatch.setattr("cosim.scenario.data_files.field_file.MOST_VALUES", 60)
    columns = {"x": "/fast.x", "z": "/slow.z"}
    with pytest.raises(UsageError, match="at most 60 numbers, got 3 at 25 times"):
        cosim.read_field_data(recording, columns=columns)
