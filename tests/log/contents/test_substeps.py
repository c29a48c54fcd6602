"""The substeps of loops in a log: what was written is read, by any reader of protobuf."""

import math

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from cosim.core.contracts import Block
from cosim.core.recording import Substep
from cosim.log import Log, McapRecorder
from cosim.log.contents.messages import decode_substep, encode_substep
from tests.log.recordings import STEP_NS, blocks, layout, plan, table

HALF = STEP_NS // 2
EVENT = (HALF + 0.3) / 1e9  # no whole nanosecond
SUBSTEPS = [
    Substep(0.0, STEP_NS / 1e9, "plant", math.inf, False),
    Substep(0.0, HALF / 1e9, "plant", 0.25, True, "", (1.0, -0.0)),
    Substep(HALF / 1e9, EVENT, "plant", None, True, "relay", (math.nan, 5e-324)),
    Substep(EVENT, STEP_NS / 1e9, "plant", 0.5, True, "", (2.0, 1.0)),
]


@pytest.fixture
def path(tmp_path):
    """Record five steps, and the substeps of the first one."""
    rows = table(layout(), 5)
    with McapRecorder(tmp_path / "x.mcap", substeps=True) as recorder:
        recorder.begin(plan(layout()))
        start = np.zeros(1, np.int64)
        recorder.write(Block(0, start, start / 1e9, STEP_NS / 1e9), rows[:1])
        for block, signals in blocks(rows, 1):
            recorder.write(block, signals)
            if block.index == 0:
                for substep in SUBSTEPS:
                    recorder.substep(substep)
    return tmp_path / "x.mcap"


def bits(substep):
    """Return a substep with its values as bytes: NaN equals nothing."""
    return (*substep[:-1], np.array(substep.values).tobytes())


def test_substeps_are_read_as_they_were_written(path):
    """In the order in which they were tried."""
    log = Log(path)
    assert list(map(bits, log.substeps())) == list(map(bits, SUBSTEPS))
    assert log.content_hash() == log.recorded_hash


def test_any_reader_decodes_substeps_by_their_schema(path):
    """With the official reader, and the descriptors that the log carries."""
    pool = descriptor_pool.DescriptorPool()
    found = []
    with path.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages(topics=["/cosim/step"]):
            if not found:
                for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(file)
            descriptor = pool.FindMessageTypeByName(schema.name)
            decoded = message_factory.GetMessageClass(descriptor).FromString(message.data)
            error = None if math.isnan(decoded.error) else decoded.error
            head = (decoded.begin, decoded.end, decoded.loop, error, decoded.accepted)
            substep = Substep(*head, decoded.event, tuple(decoded.values))
            assert message.log_time == substep.begin_ns == math.floor(decoded.begin * 1e9 + 1e-3)
            found.append(bits(substep))
    assert found == list(map(bits, SUBSTEPS))


def test_a_message_that_is_no_substep_is_refused():
    """It was written by another version, or is damaged."""
    assert bits(decode_substep(encode_substep(SUBSTEPS[1]))) == bits(SUBSTEPS[1])
    with pytest.raises(ValueError, match=r"no cosim_step.Substep message"):
        decode_substep(b"\xff\xff")
