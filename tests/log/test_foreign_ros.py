"""Fields of messages of ROS 2, by schemas in ros2msg and ros2idl; what these may be."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from mcap_ros2.decoder import DecoderFactory as RosDecoders
from mcap_ros2.writer import Writer as RosWriter

from cosim.arrays import is_absent
from cosim.errors import LogError
from cosim.log.foreign.recording import read_recording
from tests.log.foreign_files import COUNT, EPOCH, STEP, decoded, raw_file, read

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


def test_fields_of_ros_are_read_together(imu):
    """As the stock decoder has them; also twice the same and a part of another."""
    path, messages = imu
    found = read(path, *(f"/imu.{field}" for field in IMU_FIELDS), time="header.stamp")
    for field, samples in zip(IMU_FIELDS, found, strict=True):
        expected = np.array([ros_value(message, field) for message in messages], np.float64)
        np.testing.assert_array_equal(samples.values, expected.reshape(COUNT, -1))
        number = np.arange(COUNT)
        np.testing.assert_array_equal(samples.time_ns, EPOCH + (10**9 + 1) * number)


def test_a_recording_of_ros_has_what_the_stock_decoder_reads(imu):
    """Sequences as long as their longest; elements of arrays of messages are fields."""
    path, messages = imu
    (topic,), left_out = read_recording(path)
    assert left_out == {}
    found = {field.name: field.values for field in topic.fields}
    names = [
        "header.stamp", "header.stamp.sec", "header.stamp.nanosec", "covariance", "counts",
        *(f"{axis}.{part}" for axis in ("axes[0]", "axes[1]", "more[0]", "more[1]", "more[2]")
          for part in ("number", "x", "y")),
        "on", "scale", "ticks", "lasting", "lasting.sec", "lasting.nanosec", "last",
    ]  # fmt: skip
    assert list(found) == names
    for index, message in enumerate(messages):
        counts = found["counts"][index]
        assert counts[: len(message.counts)].tolist() == message.counts
        assert is_absent(counts[len(message.counts) :]).all()
        third = message.more[2].y if len(message.more) > 2 else []
        assert found["more[2].y"][index][~is_absent(found["more[2].y"][index])].tolist() == third
        assert found["axes[1].x"][index].tolist() == [message.axes[1].x]
        assert found["covariance"][index].tolist() == message.covariance


def test_fields_of_ros_that_are_no_numbers_are_refused(imu, subtests):
    """With the field, and what there is instead."""
    for field, text in [
        ("header", r"'/imu\.header', .*number, got a message; available: header\.stamp"),
        ("header.frame_id", r"'/imu\.header\.frame_id', .*number, got text"),
        ("header.stampp", r"'header\.stampp'; did you mean 'header\.stamp'\?"),
        ("axes.x", r"'axes' is an array; .*axes\[0\]"),
        ("axes[2].x", "'axes': index 2 .* 2 elements"),
        ("covariance[9]", "'covariance': index 9 .* 9 elements"),
        ("more[2].x", "message 1: 'more': index 2 .* 2 elements"),
        ("counts", "message 2: expected 2 elements, .*got 3"),
        ("scale[0]", "'scale' is not an array"),
        ("scale.x", "'scale' is a number"),
        ("label.x", "'label' is text"),
    ]:
        with subtests.test(case=field), pytest.raises(LogError, match=text):
            read(imu[0], f"/imu.{field}")


def ros_file(folder, definition, body, *, name="demo_msgs/msg/Demo", encapsulation=b"\0\1\0\0"):
    schema = (name, "ros2msg", definition.encode())
    return raw_file(folder, "cdr", schema, [encapsulation + body])


def test_both_byte_orders_are_read(tmp_path):
    """Padding counts from the body on: a double behind a byte begins at 8; char is unsigned."""
    definition = "char a\nfloat64 b\nint32[] c"
    for number, order in ((0, ">"), (1, "<")):
        body = struct.pack(f"{order}B7xdI2i", 200, -2.5, 2, 4, -5)
        path = ros_file(tmp_path, definition, body, encapsulation=bytes((0, number, 0, 0)))
        found = read(path, "/topic.a", "/topic.b", "/topic.c")
        assert [samples.values.tolist() for samples in found] == [
            [[200.0]],
            [[-2.5]],
            [[4.0, -5.0]],
        ]


def test_damaged_messages_and_schemas_of_ros_are_refused(tmp_path, subtests):
    """Whatever a length says, no more is read than is there."""
    for definition, body, options, text in [
        ("float64 x", b"", {}, "message 1: the message of 4 bytes"),
        (
            "float64[] x",
            struct.pack("<I", 10**9),
            {},
            "message 1: the message of 8 bytes ends within its fields",
        ),
        (
            "float64[] x",
            struct.pack("<I12x", 9),
            {},
            "message 1: the message of 20 bytes ends within its fields",
        ),
        ("float64 x", b"", {"encapsulation": b"\0\7\0\0"}, "plain CDR .* got serialization 7"),
        ("float64 x", b"", {"encapsulation": b"\0"}, "expected CDR, got a message of 1 bytes"),
        ("Other x", b"", {}, "its schema does not define demo_msgs/Other"),
        ("Demo x", b"", {}, "in its schema demo_msgs/Demo contains itself"),
        ("float64", b"", {}, "its schema .* cannot be parsed: .* at character"),
        ("float64[0] x", b"", {}, "its schema has an array of 0 elements"),
        ("float64[99999999] x", b"", {}, "its schema has an array of 99999999 elements"),
        ("#" * 2**20 + "\nfloat64 x", b"", {}, "its schema has 1048586 bytes, more than 1048576"),
        ("int8 x\n===\nint8 y", b"", {}, "its schema .* cannot be parsed: .* at character"),
        ("wstring w\nint8 x", b"", {}, "type 'wstring', 'w': not supported"),
    ]:
        path = ros_file(tmp_path, definition, body, **options)
        with subtests.test(case=definition[:20]), pytest.raises(LogError, match=text):
            read(path, "/topic.x")


def test_definitions_that_multiply_are_refused(tmp_path):
    """Ten of a message that has ten of another, and so on: no memory has all of their fields."""
    parts = ["\n".join(f"M1 x{i}" for i in range(10))]
    for level in range(1, 8):
        inner = "int8" if level == 7 else f"M{level + 1}"
        fields = "\n".join(f"{inner} x{i}" for i in range(10))
        parts.append(f"MSG: demo_msgs/M{level}\n{fields}")
    with pytest.raises(LogError, match="its schema has more than 10000 fields"):
        read(ros_file(tmp_path, "\n===\n".join(parts), b""), "/topic.x0")


def test_definitions_inside_each_other_are_bounded(tmp_path):
    """A thousand levels are no error of Python."""
    parts = ["M1 x", *(f"MSG: demo_msgs/M{i}\nM{i + 1} x" for i in range(1, 1000))]
    with pytest.raises(LogError, match="its schema nests messages 50 deep"):
        read(ros_file(tmp_path, "\n===\n".join(parts), b""), "/topic.x")
    schema = ("Demo", "ros2idl", b"struct Demo { " + b"sequence<" * 5000)
    with pytest.raises(LogError, match="a sequence of sequences: not supported"):
        read(raw_file(tmp_path, "cdr", schema, [b""]), "/topic.x")


def test_a_time_message_with_other_fields_is_no_time(tmp_path):
    """A message of that name with other fields is a message."""
    parts = ("builtin_interfaces/Time stamp", "===", "MSG: builtin_interfaces/Time")
    definition = "\n".join([*parts, "int32 sec", "string nanosec"])
    path = ros_file(tmp_path, definition, struct.pack("<iI", 5, 0))
    assert read(path, "/topic.stamp.sec")[0].values.tolist() == [[5.0]]
    with pytest.raises(
        LogError, match=r"'/topic\.stamp', message 1: expected a number, got a message"
    ):
        read(path, "/topic.stamp")


IDL = """\
// generated from rosidl_adapter/resource/msg.idl.em
#include "std_msgs/msg/Header.idl"
module demo_msgs { module msg {
  module Demo_Constants {
    @verbatim (language="comment", text="a; text }" " in parts")
    const string NAME = "x;}";
  };
  typedef double double__2[2];
  enum Mode { OFF, @value(3) ON };
  struct Demo {
    std_msgs::msg::Header header;
    octet x, y[2]; /* a comment; */
    demo_msgs::msg::Mode mode;
    @unit(value="m") double__2 z;
    sequence<int16, 6> counts;
  };
}; };
================================================================================
IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg {
  struct Header { builtin_interfaces::msg::Time stamp; string<40> frame_id; };
}; };
"""


def test_fields_of_an_idl_are_read(tmp_path):
    """Of several files, with types by other names; an enumeration is a number of 4 bytes."""
    body = struct.pack("<iII3s3B2xI2dI2h", 5, 7, 3, b"ab\0", 1, 2, 3, 3, 1.5, -2.5, 2, 4, -5)
    schema = ("demo_msgs/msg/Demo", "ros2idl", IDL.encode())
    path = raw_file(tmp_path, "cdr", schema, [b"\0\1\0\0" + body])
    fields = ("header.stamp", "x", "y", "mode", "z", "counts")
    found = read(path, *(f"/topic.{field}" for field in fields))
    values = [samples.values[0].tolist() for samples in found]
    assert values == [[5.000000007], [1.0], [2.0, 3.0], [3.0], [1.5, -2.5], [4.0, -5.0]]


def test_idls_that_cannot_be_parsed_are_refused(tmp_path, subtests):
    """With what is wrong."""
    for definition, text in [
        ("module a {", "cannot be parsed: .* at character"),
        ("struct Demo { long x }", "cannot be parsed: .* at character"),
        ("union Demo {};", "cannot be parsed: .* at character"),
        ("struct Demo { long x[2][3]; };", "cannot be parsed: Multidimensional arrays"),
        ("struct Demo { sequence<sequence<long>> x; };", "a sequence of sequences: not supported"),
        ("struct Demo { long x[N]; };", "cannot be parsed: .*'N'"),
        ("struct Demo { Other x; };", "its schema does not define unnamed/Other"),
        ("struct Demo { Demo x; };", "in its schema unnamed/Demo contains itself"),
        ("struct Other { long x; };", "its schema does not define unnamed/Demo"),
    ]:
        schema = ("Demo", "ros2idl", definition.encode())
        path = raw_file(tmp_path, "cdr", schema, [b"\0\1\0\0"])
        with subtests.test(case=definition), pytest.raises(LogError, match=text):
            read(path, "/topic.x")
