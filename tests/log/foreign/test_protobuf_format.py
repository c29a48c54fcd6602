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


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position", lambda state: state.position),
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
        ("inner.again.offset.x", lambda state: np.nan),
    ],
)
def test_fields_in_protobuf_are_what_the_stock_decoder_reads(states, field, value):
    """Bit for bit; a field that a message does not have is NaN."""
    path, messages = states
    if field == "inner.again.offset.x":
        with pytest.raises(LogError, match="no message has a value of it"):
            read(path, f"/drive/state.{field}")
        return
    (samples,) = read(path, f"/drive/state.{field}")
    expected = np.array([value(message) for message in messages], np.float64)
    np.testing.assert_array_equal(samples.values, expected.reshape(COUNT, -1))
    np.testing.assert_array_equal(samples.time_ns, EPOCH + STEP * np.arange(COUNT))
    assert samples.is_discrete == (field in ("mode", "on"))


@pytest.mark.parametrize(("time", "shift"), [("log_time", 0), ("publish_time", 5), ("stamp", 3)])
def test_times_come_from_where_is_asked(states, time, shift):
    """Exact in ns: those of the record, or a time in the message."""
    (samples,) = read(states[0], "/drive/state.position", time=time)
    np.testing.assert_array_equal(samples.time_ns, EPOCH + STEP * np.arange(COUNT) + shift)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("positio", "there is no field 'positio'; did you mean 'position'?"),
        ("inner.offset.z", "there is no field 'inner.offset.z'"),
        ("name", "'name' is text; needed a number"),
        ("raw", "'raw' is bytes; needed a number"),
        ("inner", "'inner' is a message; needed a field of it that is a number; there is: inner.p"),
        ("inner.points.x", "'inner.points' is repeated; needed one of its elements: inner.points"),
        ("position[0]", "'position' is a number, so there is no '[0]' in it"),
        ("inner[0].offset", "'inner' is not repeated, so it has no elements"),
        ("effort[4]", "message 1: 'effort' has 4 elements, numbered from 0; needed [4]"),
        ("effort[2:2]", "'effort[2:2]' has no elements"),
        ("effort[", "'effort[' names no field; needed names with dots"),
    ],
)
def test_what_is_no_number_in_protobuf_is_refused(states, field, message):
    """With the field, and what there is instead."""
    with pytest.raises(LogError) as refused:
        read(states[0], f"/drive/state.{field}")
    assert message in str(refused.value)


def test_an_unknown_topic_names_the_nearest(states):
    """A field begins with a topic."""
    with pytest.raises(LogError, match=r"no topic of '/drive/stat.x'; .* did you mean '/drive/st"):
        read(states[0], "/drive/stat.x")


@pytest.mark.parametrize(
    ("name", "data", "text"),
    [("demo.State", b"\xff\xff", "is no FileDescriptorSet"), ("demo.X", b"", "message 'demo.X'")],
)
def test_a_schema_in_protobuf_that_is_none_is_refused(tmp_path, name, data, text):
    """Before any message is read."""
    path = raw_file(tmp_path, "protobuf", (name, "protobuf", data), [b""])
    with pytest.raises(LogError, match=text):
        read(path, "/topic.x")


def test_a_timestamp_is_one_by_what_is_in_it(tmp_path):
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
    with pytest.raises(LogError, match="'stamp' is a message; needed a field of it"):
        read(raw_file(tmp_path, "protobuf", schema, [b""]), "/topic.stamp")
