"""All that files of other tools have: every number of every message, or a word of why not."""

from __future__ import annotations

import json
import random
from collections import defaultdict

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter

from cosim.arrays import is_absent
from cosim.errors import LogError
from cosim.log.foreign.recording import read_recording
from tests.log.foreign_files import raw_file, state_class, write_json


def plain(values):
    """Return rows as lists; None is an element that a message does not have."""
    pairs = zip(values, is_absent(values), strict=True)
    return [[None if gone else x for x, gone in zip(*pair, strict=True)] for pair in pairs]


def found_in(path):
    """Return the times of each topic, its fields, and what is left out."""
    topics, left_out = read_recording(path)
    times = {topic: time_ns.tolist() for topic, time_ns, _ in topics}
    fields = {
        f"{topic}.{name}": plain(values) for topic, _, own in topics for name, values, _ in own
    }
    return times, fields, left_out


# --- a file is what comes back ---


def random_message(rng):
    """Return an object of which every part comes and goes."""

    def number():
        return rng.choice([rng.random(), rng.randrange(-9, 9), rng.random() < 0.5])

    def array():
        return [rng.choice([None, number(), number()]) for _ in range(rng.randrange(4))]

    def inner():
        return some({"p": number(), "q": array(), "text": "x"})

    def some(message):
        kept = {name: value for name, value in message.items() if rng.random() < 0.6}
        return {name: value if rng.random() < 0.8 else None for name, value in kept.items()}

    parts = {
        "x": number(),
        "v": array(),
        "text": "y",
        "names": ["n"] * rng.randrange(3),
        "inner": inner(),
        "several": [inner() for _ in range(rng.randrange(3))],
        "table": [array() for _ in range(rng.randrange(3))],
        "dotted.name": number(),
    }
    order = rng.sample(sorted(parts), len(parts))
    return some({name: parts[name] for name in order})


def rows_of(value, name=""):
    """Yield names and rows of numbers: what the fields of a message are, in a few lines."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from rows_of(item, f"{name}.{key}")
    elif isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        for index, item in enumerate(value):
            yield from rows_of(item, f"{name}[{index}]")
    elif isinstance(value, list) and any(isinstance(item, int | float) for item in value):
        yield name[1:], value
    elif isinstance(value, int | float):
        yield name[1:], [value]


@pytest.mark.parametrize("seed", range(20))
def test_all_numbers_of_all_messages_come_back(tmp_path, seed):
    """Whatever the first message has; every message is a row, by time and then by the file."""
    rng = random.Random(seed)
    messages = [(rng.randrange(30), random_message(rng)) for _ in range(60)]
    path = write_json(tmp_path / "a.mcap", {"/t": messages})
    in_order = sorted(messages, key=lambda message: message[0])
    expected = defaultdict(lambda: [[] for _ in in_order])
    for row, (_, message) in enumerate(json.loads(json.dumps(in_order))):
        for name, numbers in rows_of(message):
            expected[f"/t.{name}"][row] = numbers
    for rows in expected.values():
        size = max(map(len, rows))
        rows[:] = [[*row, *[None] * (size - len(row))] for row in rows]
    times, fields, left_out = found_in(path)
    assert left_out == {}
    assert times == {"/t": [time_ns for time_ns, _ in in_order]}
    assert fields == expected


def test_arrays_in_protobuf_have_any_length_and_what_is_not_set_is_absent(tmp_path):
    """Elements of an array of messages are fields of their own."""
    make = state_class()
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for index in range(4):
            state = make(effort=[0.5] * index, mode=3, position=index)
            for place in range(index % 3):
                state.inner.points.add(x=place)
            if index == 2:
                state.maybe = 7
            writer.write_message("/t", state, index, index)
    _, fields, left_out = found_in(path)
    assert left_out == {}
    assert fields["/t.effort"] == [
        [None, None, None],
        [0.5, None, None],
        [0.5, 0.5, None],
        [0.5, 0.5, 0.5],
    ]
    assert fields["/t.maybe"] == [[None], [None], [7.0], [None]]
    assert fields["/t.inner.points[1].x"] == [[None], [None], [1.0], [None]]
    assert fields["/t.position"] == [[0.0], [1.0], [2.0], [3.0]]
    (topic,), _ = read_recording(path)
    assert {field.name for field in topic.fields if field.is_discrete} == {"mode", "on"}


def test_a_nan_is_a_value_and_a_time_a_number_of_seconds(tmp_path):
    """As they are written; both parts of the time are there, too."""
    message = {"x": float("nan"), "v": [float("nan"), None], "at": {"sec": 2, "nsec": 500_000_000}}
    _, fields, _ = found_in(write_json(tmp_path / "a.mcap", {"/t": [(0, message)]}))
    assert np.isnan(fields["/t.x"][0][0])
    first, second = fields["/t.v"][0]
    assert np.isnan(first)
    assert second is None
    assert (fields["/t.at"], fields["/t.at.sec"]) == ([[2.5]], [[2.0]])


def test_names_are_in_quotes_where_another_field_in_any_message_is_written_so(tmp_path):
    """An element of an array is such a field."""
    rows = [
        {"a.b": 1, "c.d": 2, "v[0]": 3, "": 4},
        {"a": {"b": 5}, "v": [6, 7]},
    ]
    path = write_json(tmp_path / "a.mcap", {"/t": list(enumerate(rows)), "/n": [(0, 8), (1, 9)]})
    _, fields, _ = found_in(path)
    assert list(fields) == [
        "/n.value",
        '/t."a.b"',
        "/t.c.d",
        '/t."v[0]"',
        '/t.""',
        '/t."a"."b"',
        "/t.v",
    ]


def test_a_topic_of_two_encodings_has_the_fields_of_both(tmp_path):
    """Each message by its own."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for index, (schema, data) in enumerate(
            [(None, b'{"x": 1.5}'), (("A", "ros2msg", b"int8 x\nint8 y"), b"\0\1\0\0\5\6")]
        ):
            number = 0 if schema is None else writer.register_schema(*schema)
            channel = writer.register_channel("/t", "cdr" if schema else "json", number)
            writer.add_message(channel, index, data, index)
        writer.finish()
    assert found_in(path)[1:] == ({"/t.x": [[1.5], [5.0]], "/t.y": [[None], [6.0]]}, {})


# --- what cannot be read costs itself alone, and is named ---


@pytest.mark.parametrize(
    ("first", "second", "reasons"),
    [
        (1, "x", ("a number in message 1", "text in message 2")),
        ("x", 1, ("a number in message 2", "text in message 1")),
        (1, {"b": 2}, ("a number in message 1", "an object in message 2")),
        ([1], 1, ("an array of numbers in message 1", "a number in message 2")),
        ([1], [{"b": 1}], ("an array of objects in message 2",)),
        ({"sec": 1, "nsec": 2}, 1, ("a time in message 1", "a number in message 2")),
        (1, 2**53 + 1, ("message 2", "got 9007199254740993")),
        (1, 10**400, ("message 2",)),
        ({"sec": 10**400, "nsec": 2}, None, ("message 1",)),
        (1, float("inf"), ("message 2", "got inf")),
        ([1.5], [0.5, float("-inf")], ("message 2", "got -inf")),
        ([1], [2, "x"], ("message 2", "text")),
        ([1], [0] * 1001, ("message 2", "1001 elements")),
        ([{"b": 1}], [{"b": 1}] * 101, ("message 2", "101 of them")),
        ({"k": 1}, {f"k{i}": i for i in range(10_001)}, ("message 2", "10000 fields")),
        (json.loads('{"b": ' * 60 + "1" + "}" * 60), None, ("message 1", "more than 50")),
    ],
)
def test_a_field_that_is_not_always_a_number_is_left_out_alone(tmp_path, first, second, reasons):
    """With all inside it, and the messages that are why; its neighbours are not."""
    rows = [{"a": first, "x": 1}, {"x": 2, "a": second}, {"x": 3}]
    times, fields, left_out = found_in(
        write_json(tmp_path / "a.mcap", {"/t": list(enumerate(rows))})
    )
    assert fields == {"/t.x": [[1.0], [2.0], [3.0]]}
    assert times == {"/t": [0, 1, 2]}
    ((name, reason),) = left_out.items()
    assert name.startswith("/t.a")
    assert all(text in reason for text in reasons)


@pytest.mark.parametrize("value", ["x", None, [], [None], ["x"], {}, {"b": "x"}, ["x"] * 2000])
def test_what_has_no_numbers_is_not_named(tmp_path, value):
    """Nothing of a recording is lost with it; it may be a number later where it is nothing."""
    path = write_json(tmp_path / "a.mcap", {"/t": [(0, {"x": 1, "a": value})]})
    assert found_in(path)[1:] == ({"/t.x": [[1.0]]}, {})


def test_a_map_in_protobuf_is_named(tmp_path):
    """Its keys are no fields."""
    from google.protobuf import struct_pb2

    path = tmp_path / "a.mcap"
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        message = struct_pb2.Struct()
        message.update({"x": 1})
        writer.write_message("/t", message, 0, 0)
    _, fields, left_out = found_in(path)
    assert (fields, list(left_out)) == ({}, ["/t.fields"])
    assert "map" in left_out["/t.fields"]


def test_topics_that_cannot_be_decoded_are_named(tmp_path):
    """By their encoding or one broken message; one without messages has nothing to lose."""
    path = tmp_path / "a.mcap"
    topics = {
        "/good": ("json", [b'{"x": 1}', b'{"x": 2}']),
        "/broken": ("json", [b'{"x": 1}', b'{"x": ', b'{"x": 3}']),
        "/other": ("cbor", [b"\xff"]),
        "/empty": ("cbor", []),
        "/late": ("json", [b'{"x": 1}']),
        "/many": ("json", [json.dumps({f"k{i}": "x" for i in range(10_001)}).encode()]),
        "/number": ("json", [b'{"x": 1}', b"2"]),
    }
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, (encoding, messages) in topics.items():
            channel = writer.register_channel(topic, encoding, 0)
            for index, data in enumerate(messages):
                time_ns = 2**63 if topic == "/late" else index
                writer.add_message(channel, time_ns, data, index)
        writer.finish()
    _, fields, left_out = found_in(path)
    assert fields == {"/good.x": [[1.0], [2.0]]}
    expected = {
        "/broken": "message 2: the message is not JSON",
        "/late": "message 1: expected a time below 2**63 ns",
        "/many": "message 1: more than 10000 fields",
        "/number": "a number in message 2",
        "/other": "got 'cbor' with no schema",
    }
    assert list(left_out) == list(expected)
    assert all(text in left_out[name] for name, text in expected.items())


def test_no_more_numbers_are_kept_than_memory_has(tmp_path, monkeypatch):
    """Also where only the longest array, or a field that few messages have, has so many."""
    monkeypatch.setattr("cosim.log.foreign.recording.MOST_NUMBERS", 30)
    for values in ([[1] * 5] * 7, [[1] * 11, [1], [1]], [{f"k{i}": 1} for i in range(6)]):
        path = write_json(tmp_path / "a.mcap", {"/t": [(0, {"a": value}) for value in values]})
        with pytest.raises(LogError, match="more than 30 numbers"):
            read_recording(path)
    path = write_json(tmp_path / "a.mcap", {"/t": [(0, {"a": [1] * 2000})] * 9})
    assert found_in(path)[1] == {}


def test_a_message_of_ros_that_ends_too_early_says_so(tmp_path):
    """With its size."""
    path = raw_file(tmp_path, "cdr", ("A", "ros2msg", b"float64 x"), [b"\0\1\0\0\0\0"])
    assert "message of 6 bytes ends within its fields" in found_in(path)[2]["/topic"]
