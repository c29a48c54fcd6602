"""The jumps of signals in a log: what was written is read, by any reader of protobuf."""

import math

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from cosim.core.contracts import Block
from cosim.core.recording import SignalEvent
from cosim.log import Log, McapRecorder
from cosim.log.contents.messages import decode_event, encode_event
from tests.log.recordings import STEP_NS, blocks, layout, plan, record, table

EVENTS = [
    SignalEvent(0, "override", "plant.u", (0.3,)),
    SignalEvent(2 * STEP_NS, "follow", "plant.x_a", (1.0, -0.0)),
    SignalEvent(2 * STEP_NS, "release", "plant.u", (math.inf,)),
]


def recorded(path, events=EVENTS, **options):
    """Record five steps, and events at their instants."""
    rows = table(layout(), 5)
    waiting = list(events)
    with McapRecorder(path, events=True, **options) as recorder:
        recorder.begin(plan(layout()))
        start = np.zeros(1, np.int64)
        recorder.write(Block(0, start, start / 1e9, STEP_NS / 1e9), rows[:1])
        for block, signals in blocks(rows, 1):
            while waiting and waiting[0].time_ns == block.time_ns[0]:
                recorder.event(waiting.pop(0))
            recorder.write(block, signals)
    return rows


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_events_are_read_as_they_were_written(compression, tmp_path):
    """In the order of time, and of their causes; the rows are those of a run without."""
    path = tmp_path / "x.mcap"
    rows = recorded(path, compression=compression)
    log = Log(path)
    assert log.events() == EVENTS
    assert math.copysign(1.0, log.events()[1].values[1]) == -1.0
    record(tmp_path / "plain.mcap", rows=rows)
    plain = Log(tmp_path / "plain.mcap")
    assert log.content_hash() == log.recorded_hash == plain.recorded_hash
    assert plain.events() == []


def test_an_event_keeps_the_bits_of_its_values():
    """No value yet among them."""
    event = SignalEvent(7, "follow", "a.y", (math.nan, 5e-324))
    decoded = decode_event(7, encode_event(event))
    assert np.array(decoded.values).tobytes() == np.array(event.values).tobytes()
    assert decoded[:3] == event[:3]


def test_any_reader_decodes_events_by_their_schema(tmp_path):
    """With the official reader, and the descriptors that the log carries."""
    path = tmp_path / "x.mcap"
    recorded(path)
    pool = descriptor_pool.DescriptorPool()
    found = []
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(topics=["/cosim/event"]):
            if channel.topic == "/cosim/event" and not found:
                files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
                for file in files.file:
                    pool.Add(file)
            descriptor = pool.FindMessageTypeByName(schema.name)
            decoded = message_factory.GetMessageClass(descriptor).FromString(message.data)
            values = tuple(decoded.values)
            found.append(SignalEvent(message.log_time, decoded.cause, decoded.signal, values))
            assert message.sequence == message.log_time // STEP_NS
    assert found == EVENTS


def test_an_event_of_another_cause_is_refused():
    """It was written by another version, or is damaged."""
    data = encode_event(SignalEvent(0, "override", "a.y", (1.0,)))
    with pytest.raises(ValueError, match=r"an event has the cause 'overridd'; needed one of"):
        decode_event(0, data.replace(b"override", b"overridd"))
    with pytest.raises(ValueError, match=r"no cosim_event.SignalEvent message"):
        decode_event(0, b"\xff\xff")
