"""Messages, events and substeps in a log: what was written is read, by any reader of protobuf."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mcap.reader import make_reader

from cosim.core.contracts import Block
from cosim.core.recording import SignalEvent, Substep
from cosim.log import Log, McapRecorder
from cosim.log.messages import (
    decode_event,
    decode_log,
    decode_substep,
    encode_event,
    encode_log,
    encode_substep,
)
from tests.log.decoding import message_class
from tests.log.recordings import STEP_NS, blocks, layout, plan, record, table

EVENTS = [
    SignalEvent(0, "override", "plant.u", (0.3,)),
    SignalEvent(2 * STEP_NS, "follow", "plant.x_a", (1.0, -0.0)),
    SignalEvent(2 * STEP_NS, "release", "plant.u", (math.inf,)),
]
HALF = STEP_NS // 2
INSTANT = (HALF + 0.3) / 1e9  # no whole nanosecond
SUBSTEPS = [
    Substep(0.0, STEP_NS / 1e9, "plant", math.inf, False),
    Substep(0.0, HALF / 1e9, "plant", 0.25, True, "", (1.0, -0.0)),
    Substep(HALF / 1e9, INSTANT, "plant", None, True, "relay", (math.nan, 5e-324)),
    Substep(INSTANT, STEP_NS / 1e9, "plant", 0.5, True, "", (2.0, 1.0)),
]


def recorded(path):
    """Record five steps, events at their instants and the substeps of the first step."""
    rows = table(layout(), 5)
    waiting = list(EVENTS)
    with McapRecorder(path, events=True, substeps=True) as recorder:
        recorder.begin(plan(layout()))
        start = np.zeros(1, np.int64)
        recorder.write(Block(0, start, start / 1e9, STEP_NS / 1e9), rows[:1])
        for block, signals in blocks(rows, 1):
            while waiting and waiting[0].time_ns == block.time_ns[0]:
                recorder.event(waiting.pop(0))
            recorder.write(block, signals)
            if block.index == 0:
                for substep in SUBSTEPS:
                    recorder.substep(substep)
    return rows


def bits(substep):
    """Return a substep with its values as bytes: NaN equals nothing."""
    return (*substep[:-1], np.array(substep.values).tobytes())


def decoded(path, topic):
    """Yield the messages of a topic, decoded with the descriptors that the log carries."""
    with path.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages(topics=[topic]):
            yield message, message_class(schema.name, schema.data).FromString(message.data)


def test_events_and_substeps_are_read_as_they_were_written(tmp_path):
    """In the order of time, and as they were tried; the rows are those of a run without."""
    path = tmp_path / "x.mcap"
    rows = recorded(path)
    log = Log(path)
    assert log.events() == EVENTS
    assert math.copysign(1.0, log.events()[1].values[1]) == -1.0
    assert list(map(bits, log.substeps())) == list(map(bits, SUBSTEPS))
    record(tmp_path / "plain.mcap", rows=rows)
    plain = Log(tmp_path / "plain.mcap")
    assert log.content_hash() == log.recorded_hash == plain.recorded_hash
    assert plain.events() == []


def test_any_reader_decodes_events_and_substeps_by_their_schemas(tmp_path):
    """With the official reader of MCAP, and stock protobuf."""
    recorded(tmp_path / "x.mcap")
    events = []
    for message, event in decoded(tmp_path / "x.mcap", "/cosim/event"):
        values = tuple(event.values)
        events.append(SignalEvent(message.log_time, event.cause, event.signal, values))
        assert message.sequence == message.log_time // STEP_NS
    assert events == EVENTS
    substeps = []
    for message, substep in decoded(tmp_path / "x.mcap", "/cosim/step"):
        error = None if math.isnan(substep.error) else substep.error
        head = (substep.begin, substep.end, substep.loop, error, substep.accepted)
        again = Substep(*head, substep.event, tuple(substep.values))
        assert message.log_time == again.begin_ns == math.floor(substep.begin * 1e9 + 1e-3)
        substeps.append(bits(again))
    assert substeps == list(map(bits, SUBSTEPS))


def test_every_bit_comes_back_and_another_kind_is_refused():
    """Not a number among them; what was written by another version, or is damaged, is refused."""
    message = ("warning", "plant", "hei\nße")
    assert decode_log(encode_log(1_500_000_000, *message)) == message
    assert bits(decode_substep(encode_substep(SUBSTEPS[2]))) == bits(SUBSTEPS[2])
    event = SignalEvent(7, "follow", "a.y", (math.nan, 5e-324))
    again = decode_event(7, encode_event(event))
    assert np.array(again.values).tobytes() == np.array(event.values).tobytes()
    assert again[:3] == event[:3]
    with pytest.raises(ValueError, match=r"cause.*override.*'fallow'"):
        decode_event(0, encode_event(event).replace(b"follow", b"fallow"))
    for decode, name in [
        (lambda data: decode_event(0, data), "cosim_event.SignalEvent"),
        (decode_substep, "cosim_step.Substep"),
        (decode_log, "foxglove.Log"),
    ]:
        with pytest.raises(ValueError, match=name):
            decode(b"\xff\xff")
