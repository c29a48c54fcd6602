"""What info shows of a scenario, of a log, and of a recording of another tool."""

import platform
from datetime import UTC, datetime, timedelta

import pytest
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as RosWriter

import cosim
from cosim.errors import LogError
from cosim.report.inspection import describe_log, describe_recording, describe_scenario
from cosim.scenario.exporting import export_component
from tests.log.foreign_files import EPOCH, state_class, write_json
from tests.log.recordings import record
from tests.scenario.user_modules import RELAY

SCENARIO = """
scenario = { name = "x", stop = 0.2, step = 0.1 }
[components]
length = { kind = "constant", value = 1.0, unit = "m" }
width = { kind = "constant", value = 2.0, unit = "m" }
area = { kind = "sum", signs = [1.0], size = 2, unit = "mm" }
#
[connections]
"area.u1" = { from = ["length.y", "width.y"], offset = -0.5 }
"""


def test_a_connection_shows_all_its_sources_and_one_conversion(tmp_path):
    """Two sources in m stacked to an input in mm: the map and the conversion stand once."""
    (tmp_path / "x.toml").write_text(SCENARIO)
    (row,) = describe_scenario(str(tmp_path / "x.toml"))["connections"]
    expected = {
        "to": "area.u1",
        "from": "length.y, width.y",
        "map": "v - 0.5",
        "unit": "m -> mm",
        "conversion": "((v * 1.0 + 0.0) - 0.0) / 0.001",
    }
    assert expected.items() <= row.items()


def test_a_log_says_when_by_what_and_on_which_machine_it_was_written(tmp_path):
    """The clock of the machine, to a second; the version; the system and the processor."""
    before = datetime.now(UTC) - timedelta(seconds=1)
    record(tmp_path / "x.mcap")
    shown = describe_log(str(tmp_path / "x.mcap"))["run"]
    assert before <= datetime.fromisoformat(shown["written"]) <= datetime.now(UTC)
    for text in (f"cosim {cosim.__version__}", platform.python_version()):
        assert text in shown["written by"]
    assert platform.platform() in shown["machine"]
    assert platform.node() not in shown["machine"]  # the name of the machine is its owner's


def test_a_log_has_no_path_of_its_sender(tmp_path, monkeypatch):
    """Whatever was given with a whole path: scenario, swaps, log of a replay, and its files."""
    folder = tmp_path / "sender"
    scenarios = folder / "scenarios"
    scenarios.mkdir(parents=True)
    (scenarios / "relay.py").write_text(RELAY)
    (scenarios / "few.csv").write_text("t,y\n0,1\n0.2,2\n")  # a warning names it
    export_component("closed-loop", "plant", folder / "plant.fmu")
    components = """
    few = { kind = "field-data", path = "few.csv" }
    relay = { kind = "python", class = "relay:Relay", width = 0.1 }
    plant = { kind = "constant", value = 1.0 }
    [connections]
    "relay.u" = "length.y"
    """
    (scenarios / "x.toml").write_text(SCENARIO.replace("#\n[connections]", components))
    monkeypatch.chdir(folder)
    swaps = {"plant": folder / "plant.fmu", "width": scenarios / "few.csv"}
    run_given = {"swap": swaps, "map": {"width.y": "y"}, "out": folder / "x.mcap"}
    with pytest.warns(cosim.CosimWarning):
        run = cosim.run(scenarios / "x.toml", **run_given)
    with pytest.warns(cosim.CosimWarning):
        again = cosim.replay(folder / "x.mcap", out=folder / "y.mcap")
    for log in (run, again):
        shown = describe_log(str(log.path))
        assert str(tmp_path) not in f"{shown} {log.metadata}"
        for name in log.attachments:
            assert str(tmp_path).encode() not in log.attachment(name)
    assert shown["run"]["replay of"]["log"] == "x.mcap"
    assert describe_log(str(run.path))["metadata"]["plant"]["path"] == "plant.fmu"


# --- recordings of other tools ---


def fields_of(path):
    """Return the types of the fields of a recording."""
    return {row["field"]: row["type"] for row in describe_recording(str(path))["fields"]}


def test_topics_are_shown_with_their_messages_in_time(tmp_path):
    """Counts, rate at the median distance, order, the largest gap and where it is."""
    times = [0, 10, 20, 20, 30, 70, 60, 80]
    rows = [(EPOCH + 10**6 * time, {"x": 1, "name": "n"}) for time in times]
    topics = {"/b": rows, "/a": [(EPOCH - 5, {})]}
    path = write_json(tmp_path / "log.mcap", topics, schema={"type": "object"})
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
    assert fields_of(path) == {"/b.x": "number"}


def test_fields_of_protobuf_are_those_of_its_schema(tmp_path):
    """Without a message; those of any length with brackets."""
    path = tmp_path / "state.mcap"
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        writer.write_message("/state", state_class()(), EPOCH, EPOCH)
    fields = fields_of(path)
    assert {
        "/state.position": "double",
        "/state.effort[]": "double",
        "/state.mode": "enum",
        "/state.inner.points[].y": "float",
        "/state.stamp": "time",
        "/state.stamp.seconds": "int64",
    }.items() <= fields.items()
    assert not {"/state.name", "/state.raw", "/state.inner"} & fields.keys()


def test_fields_of_ros_are_those_of_its_schema(tmp_path):
    definition = (
        "builtin_interfaces/Time stamp\nfloat64[3] x\nint8[] n\nP[2] p\nstring s\nbool on\n"
        "===\nMSG: demo_msgs/P\nfloat32 y"
    )
    path = tmp_path / "ros.mcap"
    with path.open("wb") as stream, RosWriter(stream) as writer:
        schema = writer.register_msgdef("demo_msgs/msg/Demo", definition)
        writer.write_message("/demo", schema, {}, EPOCH)
    assert fields_of(path) == {
        "/demo.stamp": "time",
        "/demo.stamp.sec": "int32",
        "/demo.stamp.nanosec": "uint32",
        "/demo.x[0:3]": "float64",
        "/demo.n[]": "int8",
        "/demo.p[].y": "float32",
        "/demo.on": "bool",
    }


def test_a_file_without_topics_has_nothing_and_times_beyond_63_bits_are_refused(tmp_path):
    path = write_json(tmp_path / "none.mcap", {})
    nothing = {"recording": {"topics": 0, "messages": 0}, "topics": [], "fields": []}
    assert describe_recording(str(path)) == nothing
    path = write_json(tmp_path / "log.mcap", {"/t": [(2**63, {"x": 1})]})
    with pytest.raises(LogError, match=r"'/t'.* 9223372036854775808 ns"):
        describe_recording(str(path))
