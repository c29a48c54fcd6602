"""Fields of messages in JSON: what Python reads, as columns."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.errors import LogError
from cosim.log.foreign.survey import survey
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


def test_values_in_json_that_are_no_numbers_are_refused(tmp_path, subtests):
    """With the field, the message and the way out."""
    for value, field, text in [
        ({"a": "1"}, "a", "'/t.a', message 1: .*number, got text"),
        ({"a": {"b": 1}}, "a", r"got an object of several fields; available: a\.b"),
        ({"abc": 1}, "abd", "did you mean '/t.abc'"),
        ({"a": [1, 2]}, "a[2]", "'a': index 2 .* 2 elements"),
        ({"a": [[1], [2]]}, "a", "number, got a list"),
        ({"a": 1}, "a[0]", "'a' is not a list"),
        ({"a": 1}, "a.b", "'a' is not an object, so it has no 'b'"),
        ([1, 2], "a", "the message is not an object, so it has no 'a'"),
        ({"a": []}, "a", "numbers, got no elements"),
        ({"a": 2**53 + 1}, "a", "got 9007199254740993"),
        ({"a": float("inf")}, "a", "finite number, got inf"),
    ]:
        path = write_json(tmp_path / "log.mcap", {"/t": [(EPOCH, value), (EPOCH + 1, value)]})
        with subtests.test(case=(value, field)), pytest.raises(LogError, match=text):
            read(path, f"/t.{field}")


def test_an_array_of_varying_length_is_refused(tmp_path):
    """Its elements are not, where every message has them."""
    rows = [(EPOCH + index, {"a": [0.5] * (2 + index % 2)}) for index in range(4)]
    path = write_json(tmp_path / "log.mcap", {"/t": rows})
    match = r"'/t\.a', message 2: expected 2 elements, .*got 3; .*/t\.a\[0\]"
    with pytest.raises(LogError, match=match):
        read(path, "/t.a")
    assert read(path, "/t.a[1]")[0].values.tolist() == [[0.5]] * 4


def test_messages_that_are_no_json_are_refused(tmp_path):
    """The message is named, not quoted."""
    path = raw_file(tmp_path, "json", None, [b"{"])
    with pytest.raises(LogError, match="message 1: the message is not JSON"):
        read(path, "/topic.a")


def test_names_in_json_may_have_dots_and_brackets(tmp_path):
    """They are taken as they are listed, with and without quotes."""
    value = {"motor.speed": 3, "x[0]": {"y.z": [4, 5]}, "": 6, 'a"b': 7, "x": [8]}
    path = write_json(tmp_path / "log.mcap", {"/t": [(EPOCH, value)]})
    (topic,) = survey(path)
    listed = list(topic.fields)
    assert listed[0] == "/t.motor.speed"
    values = [samples.values[0].tolist() for samples in read(path, *listed)]
    assert values == [[3.0], [4.0, 5.0], [6.0], [7.0], [8.0]]
    found = read(path, '/t."motor.speed"', '/t."x[0]"."y.z"[1]', "/t.x[0].y.z[0]")
    assert [samples.values.item() for samples in found] == [3.0, 5.0, 4.0]


def test_two_fields_of_one_written_name_are_refused_with_a_way_to_say_which(tmp_path):
    """Names in quotes; so they are listed."""
    rows = [(EPOCH, {"a.b": 1}), (EPOCH + 1, {"a.b": 2, "a": {"b": -1}})]
    path = write_json(tmp_path / "log.mcap", {"/t": rows})
    with pytest.raises(LogError, match=r'message 2: several fields.* "a"\."b" and "a\.b"'):
        read(path, "/t.a.b")
    whole, inner = read(path, '/t."a.b"', '/t."a"."b"')
    np.testing.assert_array_equal(whole.values[:, 0], [1.0, 2.0])
    np.testing.assert_array_equal(inner.values[:, 0], [np.nan, -1.0])
    path = write_json(tmp_path / "log.mcap", {"/t": rows[1:]})
    assert list(survey(path)[0].fields) == ['/t."a.b"', '/t."a"."b"']


def test_a_message_may_be_a_number_or_an_array(tmp_path):
    """Then its field is the topic, or its elements."""
    rows = {"/n": [(EPOCH, 5), (EPOCH + 1, 6.5)], "/v": [(EPOCH, [1, 2]), (EPOCH + 1, [3, 4])]}
    path = write_json(tmp_path / "log.mcap", rows)
    assert [list(topic.fields) for topic in survey(path)] == [["/n"], ["/v[0:2]"]]
    number, vector, last = read(path, "/n", "/v[0:2]", "/v[1]")
    assert number.values.tolist() == [[5.0], [6.5]]
    assert vector.values.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert last.values.tolist() == [[2.0], [4.0]]
    with pytest.raises(LogError, match=r"'/n\[0\]', message 1: the message is not a list"):
        read(path, "/n[0]")
