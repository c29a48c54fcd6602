"""Schemas in ros2idl and both byte orders of CDR, against the encoder and decoder of rosbags."""

from __future__ import annotations

import re

import numpy as np
import pytest
from mcap.writer import Writer

from cosim.errors import LogError
from cosim.log.foreign.samples import read_fields
from tests.log.foreign.field_logs import EPOCH, raw_file

COUNT = 50
HEADER = """\
================================================================================
IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg {
  struct Header { builtin_interfaces::msg::Time stamp; string frame_id; };
}; };
"""
AXIS = """\
================================================================================
IDL: demo_msgs/msg/Axis
module demo_msgs { module msg { struct Axis { octet number; @unit(value="m") double x; }; }; };
"""
DEMO = """\
// generated from rosidl_adapter/resource/msg.idl.em
#include "std_msgs/msg/Header.idl"
module demo_msgs {
  module msg {
    module Demo_Constants {
      const uint8 MODE_ON = 1;
      @verbatim (language="comment", text="a; text }" " in parts")
      const string NAME = "x;}";
    };
    typedef double double__9[9];
    typedef demo_msgs::msg::Axis demo_msgs__msg__Axis__2[2];
    @verbatim (language="comment", text=
      "Of the whole; message { ")
    struct Demo {
      std_msgs::msg::Header header;
      @default (value="s")
      string<40> label;
      double__9 covariance;
      sequence<int16, 6> counts;
      demo_msgs__msg__Axis__2 axes;
      sequence<demo_msgs::msg::Axis> more;
      boolean on; /* a comment; */
      float scale;
      unsigned long long ticks;
      long long far;
      sequence<string> names;
      short a;
      unsigned short b;
      long c;
      unsigned long d;
      uint8 e;
    };
  };
};
"""
FIELDS = (
    "header.stamp.sec",
    "header.stamp.nanosec",
    "covariance",
    "counts[1]",
    "axes[1].x",
    "more[0].number",
    "on",
    "scale",
    "ticks",
    "far",
    "a",
    "b",
    "c",
    "d",
    "e",
)


def store():
    """Return a type store of rosbags with the messages."""
    from rosbags.typesys import Stores, get_types_from_idl, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    text = DEMO + AXIS.split("Axis\n", 1)[1]
    types.register(get_types_from_idl(re.sub(r"^(//|#).*$", "", text, flags=re.MULTILINE)))
    return types


def messages(types):
    """Yield messages with fields of every sort."""
    rng = np.random.default_rng(7)
    demo = types.types["demo_msgs/msg/Demo"]
    axis = types.types["demo_msgs/msg/Axis"]
    header = types.types["std_msgs/msg/Header"]
    time = types.types["builtin_interfaces/msg/Time"]
    for index in range(COUNT):
        axes = [axis(int(rng.integers(128)), rng.normal()) for _ in range(3)]
        yield demo(
            header=header(time(1_700_000_000 + index, index), "f" * (index % 7)),
            label="l" * (index % 5),
            covariance=rng.normal(size=9),
            counts=rng.integers(-99, 99, size=2 + index % 3).astype(np.int16),
            axes=axes[:2],
            more=axes[: 1 + index % 3],
            on=index % 2 == 0,
            scale=float(np.float32(rng.normal())),
            ticks=2**50 + index,
            far=-(2**50) - index,
            names=["n" * (index % 4)] * (index % 3),
            a=-index,
            b=index,
            c=-(2**31) + index,
            d=2**32 - 1 - index,
            e=index,
        )


@pytest.mark.slow
@pytest.mark.parametrize("little_endian", [True, False])
def test_fields_of_an_idl_are_what_rosbags_reads(tmp_path, little_endian):
    """In both byte orders, whatever is skipped before them."""
    types = store()
    path = tmp_path / "log.mcap"
    read = []
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(
            "demo_msgs/msg/Demo", "ros2idl", (DEMO + HEADER + AXIS).encode()
        )
        channel = writer.register_channel("/demo", "cdr", schema)
        for index, message in enumerate(messages(types)):
            data = bytes(
                types.serialize_cdr(message, "demo_msgs/msg/Demo", little_endian=little_endian)
            )
            read.append(types.deserialize_cdr(data, "demo_msgs/msg/Demo"))
            writer.add_message(channel, EPOCH + index, data, EPOCH)
        writer.finish()
    for asked in ([field] for field in FIELDS):
        check(path, read, asked)
    check(path, read, FIELDS)


def check(path, read, fields):
    found = read_fields(path, [f"/demo.{field}" for field in fields])
    for field, samples in zip(fields, found, strict=True):
        expected = [eval(f"message.{field}", {"message": message}) for message in read]
        np.testing.assert_array_equal(samples.values, np.reshape(expected, (COUNT, -1)))


@pytest.mark.slow
@pytest.mark.parametrize("type_name", ["sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"])
def test_messages_of_ros_itself_are_read(tmp_path, type_name):
    """With the definitions that rosbags has of them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = types.generate_msgdef(type_name, ros_version=2)
    assert get_types_from_msg(definition, type_name)
    header = types.types["std_msgs/msg/Header"](
        types.types["builtin_interfaces/msg/Time"](5, 7), "frame"
    )
    if type_name.endswith("JointState"):
        position = np.array([1.5, -2.5])
        message = types.types[type_name](
            header, ["a", "bcd"], position, np.array([]), 2.0 * position
        )
        expected = {"position": [1.5, -2.5], "effort[1]": [-5.0], "header.stamp": [5.000000007]}
    else:
        zeros = np.zeros(36)
        point = types.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
        turn = types.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
        pose = types.types["geometry_msgs/msg/Pose"](point, turn)
        vector = types.types["geometry_msgs/msg/Vector3"]
        twist = types.types["geometry_msgs/msg/Twist"](vector(4.0, 5.0, 6.0), vector(7.0, 8.0, 9.0))
        message = types.types[type_name](
            header,
            "child",
            types.types["geometry_msgs/msg/PoseWithCovariance"](pose, zeros + 3.0),
            types.types["geometry_msgs/msg/TwistWithCovariance"](twist, zeros),
        )
        expected = {
            "pose.pose.orientation.w": [0.8],
            "pose.covariance[35]": [3.0],
            "twist.twist.angular.y": [8.0],
        }
    data = bytes(types.serialize_cdr(message, type_name))
    path = raw_file(tmp_path, "cdr", (type_name, "ros2msg", definition.encode()), [data])
    found = read_fields(path, [f"/topic.{name}" for name in expected])
    assert [samples.values[0].tolist() for samples in found] == list(expected.values())


def test_schemas_that_cannot_be_parsed_are_refused(tmp_path, subtests):
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
            read_fields(path, ["/topic.x"])


def test_enumerations_and_several_names_of_one_type_are_read(tmp_path):
    """An enumeration is a number of 4 bytes."""
    mode = "enum Mode { OFF, @value(3) ON };"
    definition = f"module a {{ {mode} struct Demo {{ octet x, y[2]; a::Mode mode; }}; }};"
    data = b"\0\1\0\0\1\2\3\0\3\0\0\0"
    path = raw_file(tmp_path, "cdr", ("a/Demo", "ros2idl", definition.encode()), [data])
    found = read_fields(path, ["/topic.x", "/topic.y", "/topic.mode"])
    assert [samples.values.tolist() for samples in found] == [[[1.0]], [[2.0, 3.0]], [[3.0]]]
