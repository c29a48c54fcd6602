"""Fields of messages in JSON and protobuf: what their decoders say, as columns."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_protobuf.writer import Writer as ProtobufWriter

from cosim.errors import LogError
from cosim.log.foreign.formats import JsonFormat
from cosim.log.foreign.samples import survey
from tests.log.foreign_files import (
    COUNT,
    EPOCH,
    STEP,
    decoded,
    raw_file,
    read,
    state_class,
    write_json,
)


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """Write messages with fields of every sort; return the file and what its decoder reads."""
    path = tmp_path_factory.mktemp("states") / "states.mcap"
    rng = np.random.default_rng(3)
    make = state_class()
    with path.open("wb") as stream, ProtobufWriter(stream, chunk_size=4096) as writer:
        for index in range(COUNT):
            state = make(position=rng.normal(), mode=3 * (index % 2), on=index % 3 == 0)
            state.effort.extend(rng.normal(size=4))
            for _ in range(3):
                state.inner.points.add(x=rng.normal(), y=rng.normal())
            state.inner.offset.x = rng.normal()
            state.stamp.FromNanoseconds(EPOCH + index * STEP + 3)
            state.count = -(2**53) + index
            state.name = "x" * (index % 5)
            if index % 4 == 0:
                state.maybe = index
            time_ns = EPOCH + index * STEP
            writer.write_message("/drive/state", state, time_ns, time_ns + 5)
    return path, decoded(path, ProtobufDecoders(), "/drive/state")


def test_fields_in_protobuf_are_what_the_stock_decoder_reads(states, subtests):
    """Bit for bit; a field that a message does not have is NaN."""
    path, messages = states
    for field, value in [
        ("position", lambda state: state.position),
        ('"position"', lambda state: state.position),
        ("effort", lambda state: list(state.effort)),
        ("effort[2]", lambda state: state.effort[2]),
        ("effort[1:3]", lambda state: list(state.effort[1:3])),
        ("mode", lambda state: state.mode),
        ("on", lambda state: state.on),
        ("inner.points[1].y", lambda state: state.inner.points[1].y),
        ("inner.offset.x", lambda state: state.inner.offset.x),
        ("stamp", lambda state: state.stamp.ToNanoseconds() / 10**9),
        ("stamp.nanos", lambda state: state.stamp.nanos),
        ("count", lambda state: state.count),
        ("maybe", lambda state: state.maybe if state.HasField("maybe") else np.nan),
    ]:
        (samples,) = read(path, f"/drive/state.{field}")
        expected = np.array([value(message) for message in messages], np.float64)
        with subtests.test(case=field):
            np.testing.assert_array_equal(samples.values, expected.reshape(COUNT, -1))
            np.testing.assert_array_equal(samples.time_ns, EPOCH + STEP * np.arange(COUNT))
            assert samples.is_discrete == (field in ("mode", "on"))
    with pytest.raises(LogError, match=r"'/drive/state\.inner\.again\.offset\.x': no message has"):
        read(path, "/drive/state.inner.again.offset.x")


def test_times_come_from_where_is_asked(states):
    """Exact in ns: those of the record, or a time in the message."""
    for time, shift in [("log_time", 0), ("publish_time", 5), ("stamp", 3)]:
        (samples,) = read(states[0], "/drive/state.position", time=time)
        np.testing.assert_array_equal(samples.time_ns, EPOCH + STEP * np.arange(COUNT) + shift)


def test_fields_in_protobuf_that_are_no_numbers_are_refused(states, subtests):
    """With the field, and what there is instead."""
    for field, text in [
        ("positio", r"'positio'; did you mean 'position'\?"),
        ("inner.offset.z", "'inner.offset.z'"),
        ("name", r"'/drive/state\.name', .*number, got text"),
        ("raw", r"'/drive/state\.raw', .*number, got bytes"),
        ("inner", r"number, got a message; available: inner\.points"),
        ("inner.points.x", r"'inner\.points' is an array; .*inner\.points\[0\]"),
        ("position[0]", r"'position' is not an array"),
        ("inner[0].offset", "'inner' is not an array"),
        ("effort[4]", "message 1: 'effort': index 4 .* 4 elements"),
        ("effort[2:2]", r"'effort\[2:2\]': expected a slice"),
        ("effort[", r"'effort\[': expected field names"),
    ]:
        with subtests.test(case=field), pytest.raises(LogError, match=text):
            read(states[0], f"/drive/state.{field}")
    with pytest.raises(LogError, match=r"'/drive/stat.x'.* did you mean '/drive/st"):
        read(states[0], "/drive/stat.x")
    with pytest.raises(LogError, match=r"'/drive/state': expected /drive/state\.FIELD"):
        read(states[0], "/drive/state")


def test_a_schema_in_protobuf_that_is_none_is_refused(tmp_path):
    """Before any message is read."""
    for name, data in [("demo.State", b"\xff\xff"), ("demo.X", b"")]:
        path = raw_file(tmp_path, "protobuf", (name, "protobuf", data), [b""])
        with pytest.raises(LogError, match=f"FileDescriptorSet with the message '{name}'"):
            read(path, "/topic.x")


def test_a_time_message_with_other_fields_is_no_time(tmp_path):
    """A message of that name with other fields is a message."""
    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name="t.proto", package="google.protobuf", syntax="proto3")
    stamp = file.message_type.add(name="Timestamp")
    stamp.field.add(name="seconds", number=1, type=9, label=1)  # a string
    state = file.message_type.add(name="State")
    state.field.add(
        name="stamp", number=1, type=11, label=1, type_name=".google.protobuf.Timestamp"
    )
    schema = ("google.protobuf.State", "protobuf", files.SerializeToString())
    with pytest.raises(LogError, match=r"stamp', message 1: expected a number, got a message"):
        read(raw_file(tmp_path, "protobuf", schema, [b"\x0a\x00"]), "/topic.stamp")


def test_fields_in_json_are_what_json_says(tmp_path):
    """Numbers, truth values, elements of lists, times as objects; null and no key are NaN."""
    rows = []
    for index in range(COUNT):
        value = {
            "a": {"b": [{"c": index / 7}, {"c": [1, 2, index]}]},
            "on": index % 2 == 0,
            "stamp": {"nsec": 25, "sec": 1_700_000_000 + index},
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
        ({"a": {"b": 1}}, "a", r"got a message; available: a\.b"),
        ({"a": {"sec": 1, "nsec": 0.5}}, "a", r"got a message; available: a\.sec, a\.nsec"),
        ({"abc": 1}, "abd", "did you mean '/t.abc'"),
        ({"a": [1, 2]}, "a[2]", "'a': index 2 .* 2 elements"),
        ({"a": [[1], [2]]}, "a", "number, got a list"),
        ({"a": 1}, "a[0]", "'a' is not an array"),
        ({"a": 1}, "a.b", "'a' is a number, so it has no 'b'"),
        ([1, 2], "a", "the message is an array; .*so it has no 'a'"),
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


def test_messages_that_are_no_json_or_too_deep_are_refused(tmp_path):
    """The message is named, not quoted; fields are listed to a depth."""
    for data in (b"{", b"[" * 100_000):
        with pytest.raises(LogError, match="message 1: the message is not JSON"):
            read(raw_file(tmp_path, "json", None, [data]), "/topic.x")
    deep = b'{"x": 1, "a": ' + b'{"a": ' * 400 + b"1" + b"}" * 401
    assert dict(JsonFormat().fields(deep)) == {"x": "number"}


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
    with pytest.raises(LogError, match=r"'/n\[0\]', message 1: the message is not an array"):
        read(path, "/n[0]")
