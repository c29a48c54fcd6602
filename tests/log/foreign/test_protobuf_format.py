"""Fields of messages in protobuf: what the stock decoder says, as columns."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_protobuf.writer import Writer as ProtobufWriter

from cosim.errors import LogError
from tests.log.foreign.field_logs import COUNT, EPOCH, STEP, decoded, raw_file, read, state_class


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
        ("name", "'name': .*number, got text"),
        ("raw", "'raw': .*number, got bytes"),
        ("inner", "'inner': .*number, got a message; available: inner.p"),
        ("inner.points.x", r"'inner\.points' is an array; .*inner\.points\[0\]"),
        ("position[0]", r"'position' is not an array"),
        ("inner[0].offset", "'inner' is not an array"),
        ("effort[4]", "message 1: 'effort': index 4 .* 4 elements"),
        ("effort[2:2]", r"'effort\[2:2\]': expected a slice"),
        ("effort[", r"'effort\[': expected field names"),
    ]:
        with subtests.test(case=field), pytest.raises(LogError, match=text):
            read(states[0], f"/drive/state.{field}")


def test_an_unknown_topic_names_the_nearest(states):
    """A field begins with a topic."""
    with pytest.raises(LogError, match=r"'/drive/stat.x'.* did you mean '/drive/st"):
        read(states[0], "/drive/stat.x")


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
    with pytest.raises(LogError, match="'stamp': expected a number, got a message"):
        read(raw_file(tmp_path, "protobuf", schema, [b"\x0a\x00"]), "/topic.stamp")
