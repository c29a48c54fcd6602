"""Fields of messages in JSON: what Python reads, as columns."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.errors import LogError
from tests.log.foreign.field_logs import COUNT, EPOCH, STEP, raw_file, read, write_json


def test_fields_in_json_are_what_json_says(tmp_path):
    """Numbers, truth values, elements of lists, times as objects; null and no key are NaN."""
    rows = []
    for index in range(COUNT):
        value = {
            "a": {"b": [{"c": index / 7}, {"c": [1, 2, index]}]},
            "on": index % 2 == 0,
            "stamp": {"sec": 1_700_000_000 + index, "nsec": 25},
            "name": "x",
        }
        if index % 3:
            value["gap"] = None if index % 2 else index
        rows.append((EPOCH + index * STEP, value))
    path = write_json(tmp_path / "log.mcap", {"topic": rows}, schema={"type": "object"})
    number = np.arange(COUNT)
    fields = ("a.b[0].c", "a.b[1].c", "a.b[1].c[2]", "on", "gap", "stamp")
    first, whole, last, on, gap, stamp = read(path, *(f"topic.{field}" for field in fields))
    np.testing.assert_array_equal(first.values[:, 0], number / 7)
    np.testing.assert_array_equal(
        whole.values, np.stack([0 * number + 1, 0 * number + 2, number]).T
    )
    np.testing.assert_array_equal(last.values[:, 0], number)
    np.testing.assert_array_equal(on.values[:, 0], number % 2 == 0)
    expected = np.where((number % 3 > 0) & (number % 2 == 0), number, np.nan)
    np.testing.assert_array_equal(gap.values[:, 0], expected)
    np.testing.assert_array_equal(stamp.values[:, 0], 1_700_000_000 + number + 25e-9)
    (by_stamp,) = read(path, "topic.on", time="stamp")
    np.testing.assert_array_equal(by_stamp.time_ns, EPOCH + 10**9 * number + 25)


@pytest.mark.parametrize(
    ("value", "field", "text"),
    [
        ({"a": "1"}, "a", "'/t.a', message 1: it is text; needed a number"),
        ({"a": {"b": 1}}, "a", "it is an object of several fields; needed a number: there is: a.b"),
        ({"abc": 1}, "abd", "no message has a value of it; did you mean '/t.abc'"),
        ({"a": [1, 2]}, "a[2]", "'a' has 2 elements, numbered from 0; needed [2]"),
        ({"a": [[1], [2]]}, "a", "it is a list; needed a number"),
        ({"a": 1}, "a[0]", "'a' is no list, so it has no elements"),
        ({"a": 1}, "a.b", "'a' is no object, so it has no 'b'"),
        ([1, 2], "a", "the message is no object, so it has no 'a'"),
        ({"a": []}, "a", "it has no elements; needed numbers"),
        ({"a": 2**53 + 1}, "a", "it is 9007199254740993, which no float64 represents"),
        ({"a": float("inf")}, "a", "it is not finite; needed a finite number"),
    ],
)
def test_what_is_no_number_in_json_is_refused(tmp_path, value, field, text):
    """With the field, the message and the way out."""
    path = write_json(tmp_path / "log.mcap", {"/t": [(EPOCH, value), (EPOCH + 1, value)]})
    with pytest.raises(LogError) as refused:
        read(path, f"/t.{field}")
    assert text in str(refused.value)


def test_an_array_of_varying_length_is_refused(tmp_path):
    """Its elements are not, where every message has them."""
    rows = [(EPOCH + index, {"a": [0.5] * (2 + index % 2)}) for index in range(4)]
    path = write_json(tmp_path / "log.mcap", {"/t": rows})
    with pytest.raises(LogError) as refused:
        read(path, "/t.a")
    assert "'/t.a', message 2: it has 3 elements here and 2 in the first message" in str(
        refused.value
    )
    assert "such as /t.a[0]" in str(refused.value)
    assert read(path, "/t.a[1]")[0].values.tolist() == [[0.5]] * 4


def test_messages_that_are_no_json_are_refused(tmp_path):
    """The message is named, not quoted."""
    path = raw_file(tmp_path, "json", None, [b"{"])
    with pytest.raises(LogError, match="message 1: the message is not JSON"):
        read(path, "/topic.a")
