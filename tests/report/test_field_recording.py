"""What is said of a recording of another tool."""

from __future__ import annotations

import pytest
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as RosWriter

from cosim.errors import LogError
from cosim.report import field_recording
from cosim.report.field_recording import describe_recording
from tests.log.foreign.field_logs import EPOCH, state_class, write_json


def fields_of(content):
    return {row["field"]: row["type"] for row in content["fields"]}


def test_topics_are_shown_with_their_messages_in_time(tmp_path):
    """Counts, rate at the median distance, order, the largest gap and where it is."""
    times = [0, 10, 20, 20, 30, 70, 60, 80]
    rows = [(EPOCH + 10**6 * time, {"x": 1, "name": "n"}) for time in times]
    options = {"schema": {"type": "object"}}
    path = write_json(tmp_path / "log.mcap", {"/b": rows, "/a": [(EPOCH - 5, {})]}, **options)
    content = describe_recording(str(path))
    assert content["recording"] == {
        "topics": 2,
        "messages": 9,
        "log times": "1699999999.999999995 s to 1700000000.08 s",
        "duration": "0.080000005 s",
    }
    one, several = content["topics"]
    assert (one["topic"], one["messages"], one["rate"]) == ("/a", 1, None)
    assert several == {
        "topic": "/b",
        "encoding": "json",
        "schema": "/b (jsonschema)",
        "messages": 8,
        "rate": "100 Hz",
        "out of order": 1,
        "same instant": 1,
        "largest gap": "0.03 s",
        "at": "1700000000.03 s",
    }
    assert fields_of(content) == {"/b.x": "number"}


def test_fields_are_those_of_the_schemas(tmp_path):
    """Of protobuf and ROS without a message, those of any length with brackets."""
    path = tmp_path / "state.mcap"
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        writer.write_message("/state", state_class()(), EPOCH, EPOCH)
    fields = fields_of(describe_recording(str(path)))
    assert fields["/state.position"] == "double"
    assert fields["/state.effort[]"] == "double"
    assert fields["/state.mode"] == "enum"
    assert fields["/state.inner.points[].y"] == "float"
    assert fields["/state.stamp"] == "time"
    assert fields["/state.stamp.seconds"] == "int64"
    assert not {"/state.name", "/state.raw", "/state.inner"} & fields.keys()
    definition = (
        "builtin_interfaces/Time stamp\nfloat64[3] x\nint8[] n\nP[2] p\nstring s\nbool on\n"
        "===\nMSG: demo_msgs/P\nfloat32 y"
    )
    path = tmp_path / "ros.mcap"
    with path.open("wb") as stream, RosWriter(stream) as writer:
        schema = writer.register_msgdef("demo_msgs/msg/Demo", definition)
        writer.write_message("/demo", schema, {}, EPOCH)
    assert fields_of(describe_recording(str(path))) == {
        "/demo.stamp": "time",
        "/demo.stamp.sec": "int32",
        "/demo.stamp.nanosec": "uint32",
        "/demo.x[0:3]": "float64",
        "/demo.n[]": "int8",
        "/demo.p[].y": "float32",
        "/demo.on": "bool",
    }


def test_fields_of_json_are_those_of_its_first_message(tmp_path):
    """Lists of numbers as a whole, objects and lists of objects by their elements."""
    value = {"a": [1, 2.5], "b": [{"c": 1}, {"d": True}], "t": {"sec": 1, "nsec": 2}, "e": []}
    path = write_json(tmp_path / "log.mcap", {"/t": [(EPOCH, value), (EPOCH + 1, {"z": 1})]})
    assert fields_of(describe_recording(str(path))) == {
        "/t.a[0:2]": "number",
        "/t.b[0].c": "number",
        "/t.b[1].d": "bool",
        "/t.t": "time",
        "/t.t.sec": "number",
        "/t.t.nsec": "number",
    }


def test_unread_topics_are_listed_with_the_problem(tmp_path, monkeypatch):
    """By topic, and it is no error; of very many fields the first are shown."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("many", "ros2msg", b"float64 a\nfloat64 b\nfloat64 c")
        writer.register_channel("/none", "cdr", schema)
        for topic, encoding, data in (("/odd", "cbor", b"\xff"), ("/bad", "json", b"{")):
            channel = writer.register_channel(topic, encoding, 0)
            writer.add_message(channel, EPOCH, data, EPOCH)
        writer.finish()
    monkeypatch.setattr(field_recording, "MOST_FIELDS", 2)
    content = describe_recording(str(path))
    assert list(fields_of(content)) == ["/none.a", "/none.b"]
    assert content["more fields"] == {"not shown": 1}
    assert content["topics"][1]["messages"] == 0
    problems = {row["topic"]: row["problem"] for row in content["not read"]}
    assert "'cbor'" in problems["/odd"]
    assert "protobuf" in problems["/odd"]
    assert problems["/bad"].startswith("the message is not JSON")


def test_times_beyond_63_bits_are_refused(tmp_path):
    """Nothing can be said of distances between them."""
    path = write_json(tmp_path / "log.mcap", {"/t": [(2**63, {"x": 1})]})
    with pytest.raises(LogError, match=r"'/t'.* 9223372036854775808 ns"):
        describe_recording(str(path))


def test_a_file_without_topics_is_shown(tmp_path):
    """There is nothing in it, and that is what is said."""
    path = write_json(tmp_path / "log.mcap", {})
    assert describe_recording(str(path)) == {
        "recording": {"topics": 0, "messages": 0},
        "topics": [],
        "fields": [],
    }
