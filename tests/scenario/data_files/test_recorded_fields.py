"""Fields of an MCAP of another tool as field data, without a scenario."""

from __future__ import annotations

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from tests.log.foreign.field_logs import EPOCH, write_json

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


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "found no field to take; needed a map"),
        ({"columns": {"y": []}}, "columns: found {'y': []}; needed a column for each signal"),
        ({"columns": {"y": "/fast.x"}, "time_unit": "ps"}, "needed a unit of time of whole ns"),
        ({"columns": {"y": "/fast.x"}, "offset": 1e12}, "after the offset; needed less than 2**63"),
    ],
)
def test_what_cannot_be_read_is_refused(recording, options, text):
    """With the way out."""
    with pytest.raises(UsageError) as refused:
        cosim.read_field_data(recording, **options)
    assert text in str(refused.value)


def test_no_more_numbers_are_kept_than_memory_has(recording, monkeypatch):
    """Of all signals at all times, which topics of other rates multiply."""
    monkeypatch.setattr("cosim.scenario.data_files.recorded_fields.MOST_VALUES", 60)
    columns = {"x": "/fast.x", "z": "/slow.z"}
    with pytest.raises(UsageError, match="3 numbers at 25 times; needed at most 60 numbers"):
        cosim.read_field_data(recording, columns=columns)
