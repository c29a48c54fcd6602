"""Fields of messages that other tools wrote: what their own decoders say, as columns."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.decoder import DecoderFactory as RosDecoders
from mcap_ros2.writer import Writer as RosWriter

from cosim.errors import LogError
from cosim.log.foreign.json_format import JsonFormat
from cosim.log.foreign.samples import read_fields
from tests.log.foreign.field_logs import COMPRESSIONS, EPOCH, state_class, write_json

STEP = 10_000_000  # ns
COUNT = 300


def read(path, *fields, **options):
    return read_fields(path, fields, **options)


def decoded(path, factory, topic):
    """Return the messages of a topic as the stock decoder has them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[factory])
        return [item.decoded_message for item in reader.iter_decoded_messages([topic])]


# --- protobuf ---


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
        ("effort[2:2]", "'effort[2:2]' has no elements; needed a slice"),
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


# --- JSON ---


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
        ({"a": []}, "a", "it has no elements; needed numbers"),
        ({"a": 2**53 + 1}, "a", "it is 9007199254740993, which no float64 is"),
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
    with pytest.raises(LogError, match="message 1: the message is no JSON"):
        read(path, "/topic.a")


# --- ROS 2 ---

IMU = """\
std_msgs/Header header
# a comment
string<=40 label "unnamed # 1"
uint8 STATUS_OK=0
float64[9] covariance
int16[] counts
Axis[2] axes
demo_msgs/Axis[<=5] more
bool on
float32 scale 1.5
uint64 ticks
string[] names
builtin_interfaces/Duration lasting
int8 last
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: demo_msgs/Axis
uint8 number
float64 x
Empty nothing
float32[3] y
================================================================================
MSG: demo_msgs/Empty
"""
IMU_FIELDS = (
    "header.stamp.sec",
    "covariance",
    "covariance[3]",
    "covariance[2:5]",
    "counts[1]",
    "axes[1].x",
    "axes[0].y",
    "more[1].y[2]",
    "on",
    "scale",
    "ticks",
    "lasting",
    "last",
)


def axis(rng):
    return {"number": int(rng.integers(256)), "x": rng.normal(), "y": rng.normal(size=3).tolist()}


def imu_rows():
    rng = np.random.default_rng(5)
    for index in range(COUNT):
        yield {
            "header": {
                "stamp": {"sec": 1_700_000_000 + index, "nanosec": index},
                "frame_id": "f" * (index % 9),
            },
            "label": "l" * (index % 4),
            "covariance": rng.normal(size=9).tolist(),
            "counts": rng.integers(-99, 99, size=2 + index % 3).tolist(),
            "axes": [axis(rng), axis(rng)],
            "more": [axis(rng) for _ in range(2 + index % 2)],
            "on": index % 2 == 0,
            "scale": rng.normal(),
            "ticks": 2**40 + index,
            "names": ["n" * (index % 3), ""],
            "lasting": {"sec": 1, "nanosec": 500_000_000},
            "last": -index % 128,
        }


@pytest.fixture(scope="module")
def imu(tmp_path_factory):
    """Write messages of ROS 2; return the file and what the stock decoder reads."""
    path = tmp_path_factory.mktemp("imu") / "imu.mcap"
    with path.open("wb") as stream, RosWriter(stream, chunk_size=8192) as writer:
        schema = writer.register_msgdef("demo_msgs/msg/Imu", IMU)
        for index, row in enumerate(imu_rows()):
            writer.write_message("/imu", schema, row, EPOCH + index * STEP)
    return path, decoded(path, RosDecoders(), "/imu")


def ros_value(message, field):
    """Return what a name says of an object of the stock decoder."""
    if field == "lasting":
        return message.lasting.sec + message.lasting.nanosec / 1e9
    return eval(f"message.{field}", {"message": message})


@pytest.mark.parametrize("field", IMU_FIELDS)
def test_fields_of_ros_are_what_the_stock_decoder_reads(imu, field):
    """One by one, whatever is skipped before them."""
    path, messages = imu
    (samples,) = read(path, f"/imu.{field}")
    expected = np.array([ros_value(message, field) for message in messages], np.float64)
    np.testing.assert_array_equal(samples.values, expected.reshape(COUNT, -1))


def test_fields_of_ros_are_read_together(imu):
    """All at once, also twice the same and a part of another."""
    path, messages = imu
    found = read(path, *(f"/imu.{field}" for field in IMU_FIELDS), time="header.stamp")
    for field, samples in zip(IMU_FIELDS, found, strict=True):
        expected = np.array([ros_value(message, field) for message in messages], np.float64)
        np.testing.assert_array_equal(samples.values, expected.reshape(COUNT, -1))
        number = np.arange(COUNT)
        np.testing.assert_array_equal(samples.time_ns, EPOCH + (10**9 + 1) * number)


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ("header", "'header' is a message; needed a field of it that is a number; there is: head"),
        ("header.frame_id", "'header.frame_id' is text; needed a number"),
        ("header.stampp", "there is no field 'header.stampp'; did you mean 'header.stamp'?"),
        ("axes.x", "'axes' is an array; needed one of its elements: axes[0]"),
        ("axes[2].x", "'axes' has 2 elements, numbered from 0; needed [2]"),
        ("covariance[9]", "'covariance' has 9 elements, numbered from 0; needed [9]"),
        ("more[2].x", "message 1: 'more' has 2 elements, numbered from 0; needed [2]"),
        ("counts", "message 2: it has 3 elements here and 2 in the first message"),
        ("scale[0]", "'scale' is no array, so it has no elements"),
        ("scale.x", "'scale' is a number, so there are no fields in it"),
        ("label.x", "'label' is text, so there are no fields in it"),
    ],
)
def test_what_is_no_number_of_ros_is_refused(imu, field, text):
    """With the field, and what there is instead."""
    with pytest.raises(LogError) as refused:
        read(imu[0], f"/imu.{field}")
    assert text in str(refused.value)


def ros_file(folder, definition, body, *, name="demo_msgs/msg/Demo", encapsulation=b"\0\1\0\0"):
    schema = (name, "ros2msg", definition.encode())
    return raw_file(folder, "cdr", schema, [encapsulation + body])


def test_both_byte_orders_are_read(tmp_path):
    """Padding counts from the body on: a double behind a byte begins at 8."""
    definition = "uint8 a\nfloat64 b\nint32[] c"
    for number, order in ((0, ">"), (1, "<")):
        body = struct.pack(f"{order}B7xdI2i", 7, -2.5, 2, 4, -5)
        path = ros_file(tmp_path, definition, body, encapsulation=bytes((0, number, 0, 0)))
        found = read(path, "/topic.a", "/topic.b", "/topic.c")
        assert [samples.values.tolist() for samples in found] == [[[7.0]], [[-2.5]], [[4.0, -5.0]]]


@pytest.mark.parametrize(
    ("definition", "body", "options", "text"),
    [
        ("float64 x", b"", {}, "the message of 4 bytes ends within its fields"),
        ("float64[] x", struct.pack("<I", 10**9), {}, "says that 1000000000 elements follow"),
        ("float64[] x", struct.pack("<I12x", 9), {}, "says that 9 numbers follow, and ends"),
        ("float64 x", b"", {"encapsulation": b"\0\7\0\0"}, "serialization 7; needed plain CDR"),
        ("float64 x", b"", {"encapsulation": b"\0"}, "a message of 1 bytes; needed CDR"),
        ("Other x", b"", {}, "its schema does not define demo_msgs/Other"),
        ("Demo x", b"", {}, "its schema has demo_msgs/Demo inside itself"),
        ("float64", b"", {}, "a line in demo_msgs/Demo that is no field: 'float64'"),
        ("float64[0] x", b"", {}, "its schema has an array of 0 elements"),
        ("int8 x\n===\nint8 y", b"", {}, "a definition without a line 'MSG: package/Name'"),
        ("wstring w\nint8 x", b"", {}, "a wstring stands before a field that is wanted"),
    ],
)
def test_damaged_messages_and_schemas_of_ros_are_refused(tmp_path, definition, body, options, text):
    """Whatever a length says, no more is read than is there."""
    with pytest.raises(LogError) as refused:
        read(ros_file(tmp_path, definition, body, **options), "/topic.x")
    assert text in str(refused.value)


def test_definitions_that_multiply_are_refused(tmp_path):
    """Ten of a message that has ten of another, and so on: no memory has all of their fields."""
    parts = ["\n".join(f"M1 x{i}" for i in range(10))]
    for level in range(1, 8):
        inner = "int8" if level == 7 else f"M{level + 1}"
        fields = "\n".join(f"{inner} x{i}" for i in range(10))
        parts.append(f"MSG: demo_msgs/M{level}\n{fields}")
    with pytest.raises(LogError, match="its schema has more than 10000 fields"):
        read(ros_file(tmp_path, "\n===\n".join(parts), b""), "/topic.x0")


def test_definitions_and_values_inside_each_other_are_bounded(tmp_path):
    """A thousand levels are no error of Python."""
    parts = ["M1 x", *(f"MSG: demo_msgs/M{i}\nM{i + 1} x" for i in range(1, 1000))]
    with pytest.raises(LogError, match="its schema has messages inside each other, 50 deep"):
        read(ros_file(tmp_path, "\n===\n".join(parts), b""), "/topic.x")
    schema = ("Demo", "ros2idl", b"struct Demo { " + b"sequence<" * 5000)
    with pytest.raises(LogError, match="its schema has a sequence of arrays or sequences"):
        read(raw_file(tmp_path, "cdr", schema, [b""]), "/topic.x")
    deep = b'{"x": 1, "a": ' + b'{"a": ' * 400 + b"1" + b"}" * 401
    assert JsonFormat().fields(deep) == {"x": "number"}
    with pytest.raises(LogError, match="message 1: the message is no JSON"):
        read(raw_file(tmp_path, "json", None, [b"[" * 100_000]), "/topic.x")


# --- files ---


def raw_file(folder, encoding, schema, messages, **options):
    """Write messages of one topic as they are."""
    path = folder / "raw.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        number = 0 if schema is None else writer.register_schema(*schema)
        channel = writer.register_channel("/topic", encoding, number)
        for index, data in enumerate(messages):
            writer.add_message(channel, EPOCH + index, data, EPOCH + index)
        writer.finish()
    return path


FORMS = [
    *({"compression": compression} for compression in COMPRESSIONS.values()),
    {"use_chunking": False},
    {"use_chunking": False, "enable_data_crcs": True},
    {"enable_crcs": False},
    {"use_summary_offsets": False, "use_statistics": False, "index_types": IndexType.NONE},
    {"repeat_channels": False, "repeat_schemas": False},
    {
        "use_chunking": False,
        "use_summary_offsets": False,
        "use_statistics": False,
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
    },
]


@pytest.mark.parametrize("options", FORMS, ids=str)
def test_files_of_every_form_have_the_same_samples(tmp_path, options):
    """Compressed or not, in chunks or not, with a summary, a part of one or none."""
    topics = {
        "/a": [(EPOCH + 2 * i, {"x": i / 3}) for i in range(COUNT)],
        "/b": [(EPOCH + 2 * i + 1, {"x": -i}) for i in range(COUNT)],
    }
    path = write_json(tmp_path / "log.mcap", topics, schema={}, chunk_size=2048, **options)
    for name, samples in zip(topics, read(path, "/a.x", "/b.x"), strict=True):
        expected = [[row["x"]] for _, row in topics[name]]
        assert samples.values.tolist() == expected
        assert samples.time_ns.tolist() == [time_ns for time_ns, _ in topics[name]]
        assert (samples.spacing.late, samples.spacing.repeated) == (0, 0)


def test_messages_out_of_order_are_sorted_and_counted(tmp_path):
    """Of several of one instant the last one in the file counts."""
    times = [5, 1, 9, 9, 3, 9, 12]
    rows = [(EPOCH + time, {"x": place}) for place, time in enumerate(times)]
    path = write_json(tmp_path / "log.mcap", {"/t": rows})
    (samples,) = read(path, "/t.x")
    assert (samples.time_ns - EPOCH).tolist() == [1, 3, 5, 9, 12]
    assert samples.values[:, 0].tolist() == [1, 4, 0, 5, 6]
    spacing = samples.spacing
    assert (spacing.count, spacing.late, spacing.repeated) == (7, 2, 2)
    assert (spacing.first_ns - EPOCH, spacing.last_ns - EPOCH) == (1, 12)
    assert (spacing.median_ns, spacing.largest_ns, spacing.largest_at_ns - EPOCH) == (2, 4, 5)


def test_a_topic_of_two_schemas_is_refused(tmp_path):
    """Two channels of one schema are read as one."""
    path = tmp_path / "log.mcap"
    for names, text in (
        (("one", "two"), "several schemas: 'one' in 'json', 'two'"),
        (("one",), ""),
    ):
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schemas = [writer.register_schema(name, "jsonschema", b"{}") for name in names]
            for index, schema in enumerate([*schemas, schemas[0]]):
                channel = writer.register_channel("/t", "json", schema, {"n": str(index)})
                writer.add_message(channel, EPOCH + index, b'{"x": 1}', EPOCH)
            writer.finish()
        if text:
            with pytest.raises(LogError, match=text):
                read(path, "/t.x")
        else:
            assert len(read(path, "/t.x")[0].values) == 2


@pytest.mark.parametrize(
    ("encoding", "schema", "text"),
    [
        ("cbor", None, "messages are in 'cbor' with no schema; needed protobuf, json, and cdr"),
        ("cdr", ("x", "omgidl", b""), "in 'cdr' with a schema in 'omgidl'; needed protobuf"),
        ("protobuf", None, "in 'protobuf' with no schema"),
        ("cdr", ("x", "ros2msg", b"\xff"), "its schema 'x' is no text in UTF-8"),
    ],
)
def test_unknown_encodings_are_refused(tmp_path, encoding, schema, text):
    """With what can be read."""
    with pytest.raises(LogError) as refused:
        read(raw_file(tmp_path, encoding, schema, [b""]), "/topic.x")
    assert text in str(refused.value)


def test_times_beyond_63_bits_are_refused(tmp_path):
    """In the record, which has 64 bits, and in a message."""
    path = write_json(tmp_path / "log.mcap", {"/t": [(2**63, {"x": 1, "s": 1e30})]})
    with pytest.raises(LogError, match=r"message 1: a time of 9223372036854775808 ns; needed one"):
        read(path, "/t.x")
    with pytest.raises(LogError, match=r"'/t.s', message 1: it is not finite, or too large"):
        read(path, "/t.x", time="s")
    with pytest.raises(LogError, match=r"'/t.z', message 1: it is missing; needed a time"):
        read(path, "/t.x", time="z")


def test_a_topic_without_messages_is_refused(tmp_path):
    """There is nothing to take."""
    path = raw_file(tmp_path, "json", None, [])
    with pytest.raises(LogError, match="topic '/topic' has no messages; needed samples"):
        read(path, "/topic.x")


def test_no_more_numbers_are_kept_than_memory_has(tmp_path, monkeypatch):
    """A limit on what is kept, whatever the size of the file."""
    monkeypatch.setattr("cosim.log.foreign.samples.MOST_NUMBERS", 20)
    path = write_json(tmp_path / "log.mcap", {"/t": [(i, {"x": [1] * 5}) for i in range(9)]})
    with pytest.raises(LogError, match="more than 20 numbers in 1 topics; needed fewer fields"):
        read(path, "/t.x")


# --- damage ---


def damaged(path, change):
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)
    return path


def chunk_start(data):
    """Return where the content of the first chunk begins."""
    position = 8
    while data[position] != 6:
        position += 9 + int.from_bytes(data[position + 1 : position + 9], "little")
    return position + 9


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "is empty; needed an MCAP file"),
        (b"t,y\n0,1\n", "is no MCAP file: it begins with b't,y"),
        (b"\x89MCAP0\r\n", "is truncated: no whole record begins at byte 8 of 8"),
    ],
)
def test_what_is_no_mcap_is_refused(tmp_path, content, text):
    """With what it is."""
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError) as refused:
        read(path, "/t.x")
    assert text in str(refused.value)


@pytest.fixture
def plain(tmp_path):
    rows = [(EPOCH + index, {"x": index}) for index in range(COUNT)]
    return write_json(tmp_path / "log.mcap", {"/t": rows})


def test_a_bomb_is_refused_before_it_is_decompressed(plain):
    """A chunk of few bytes that declares 2**40."""

    def declare(data):
        begin = chunk_start(data) + 16
        data[begin : begin + 8] = (2**40).to_bytes(8, "little")

    with pytest.raises(LogError, match="a chunk of 1099511627776 bytes, at most 67108864 are read"):
        read(damaged(plain, declare), "/t.x")


def test_a_chunk_that_holds_more_than_it_declares_is_refused(plain):
    """No byte more than that is decompressed."""

    def declare(data):
        begin = chunk_start(data) + 16
        data[begin : begin + 8] = (100).to_bytes(8, "little")

    with pytest.raises(LogError, match=r"is damaged at byte \d+: a chunk of \d+ bytes, 100 decl"):
        read(damaged(plain, declare), "/t.x")


def test_unknown_compression_is_refused(plain):
    """With the name, and those that are known."""

    def rename(data):
        begin = chunk_start(data) + 32
        assert data[begin : begin + 4] == b"zstd"
        data[begin : begin + 4] = b"brot"

    with pytest.raises(LogError, match="compression 'brot', needed zstd, lz4 or none"):
        read(damaged(plain, rename), "/t.x")


@pytest.mark.parametrize("compression", COMPRESSIONS.values())
def test_damaged_chunks_are_refused(tmp_path, compression):
    """One bit in the data of a chunk, which its CRC covers."""
    rows = [(EPOCH + index, {"x": index}) for index in range(COUNT)]
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, compression=compression)

    def flip(data):
        data[chunk_start(data) + 300] ^= 1

    with pytest.raises(LogError, match=r"is damaged at byte \d+"):
        read(damaged(path, flip), "/t.x")


def test_damaged_messages_outside_chunks_are_refused(tmp_path):
    """Where the writer gave a CRC of the data."""
    rows = [(EPOCH + index, {"x": 1000 + index}) for index in range(COUNT)]
    options = {"use_chunking": False, "enable_data_crcs": True}
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, **options)

    def change(data):
        data[data.index(b'"x": 1') + 5] = ord("2")

    with pytest.raises(LogError, match="the CRC of the data does not fit"):
        read(damaged(path, change), "/t.x")


def test_a_truncated_file_is_refused(plain):
    """With the way out."""

    def cut(data):
        del data[chunk_start(data) + 300 :]

    with pytest.raises(LogError, match=r"is truncated.*save what is whole with 'mcap recover'"):
        read(damaged(plain, cut), "/t.x")


def test_a_damaged_summary_does_not_matter(plain):
    """The data say it all."""

    def change(data):
        data[-60] ^= 1

    assert len(read(damaged(plain, change), "/t.x")[0].values) == COUNT


def test_a_large_message_is_refused(tmp_path, monkeypatch):
    """Outside of chunks, where a length may say anything."""
    monkeypatch.setattr("cosim.log.foreign.record_stream.MOST_BYTES", 1000)
    rows = [(EPOCH, {"x": 1, "text": "x" * 2000})]
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, use_chunking=False)
    with pytest.raises(LogError, match=r"a record of \d+ bytes, at most 1000 are read"):
        read(path, "/t.x")


def test_only_the_asked_topics_are_decoded(tmp_path):
    """What stands in the others does not matter."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start()
        for topic, encoding, data in (("/a", "json", b'{"x": 1}'), ("/a.b", "cbor", b"\xff")):
            channel = writer.register_channel(topic, encoding, 0)
            writer.add_message(channel, EPOCH, data, EPOCH)
        writer.finish()
    assert read(path, "/a.x")[0].values.tolist() == [[1.0]]


# --- schemas that say something else than their names ---


def test_a_time_is_one_by_what_is_in_it(tmp_path):
    """A message of that name with other fields is a message."""
    parts = ("builtin_interfaces/Time stamp", "===", "MSG: builtin_interfaces/Time")
    definition = "\n".join([*parts, "int32 sec", "string nanosec"])
    path = ros_file(tmp_path, definition, struct.pack("<iI", 5, 0))
    assert read(path, "/topic.stamp.sec")[0].values.tolist() == [[5.0]]
    with pytest.raises(LogError, match="'stamp' is a message; needed a field of it"):
        read(path, "/topic.stamp")
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


def test_a_summary_that_lists_another_schema_is_refused(tmp_path):
    """What the data say counts: the messages are not what the summary says."""
    path = raw_file(tmp_path, "json", ("one", "jsonschema", b"{}"), [b'{"x": 1}'])
    data = path.read_bytes()
    place = data.rindex(b"one")
    changed = data[:place] + b"two" + data[place + 3 :]
    footer = len(changed) - 8 - 4
    path.write_bytes(changed[:footer] + bytes(4) + changed[footer + 4 :])  # without a CRC
    with pytest.raises(LogError, match="several schemas: 'one' in 'json', 'two' in 'json'"):
        read(path, "/topic.x")
