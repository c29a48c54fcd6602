"""What viewers and tools of protobuf find in the schemas about a field."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import Log, McapRecorder
from cosim.log.layout import read_part, signals_json, split_channel
from cosim.log.metadata import add_checksum
from cosim.log.preamble import part_schemas
from tests.log.crafting import without_checksum
from tests.log.recordings import blocks, plan, same_bits, table

INTERFACE = Interface(
    (Signal("u", unit="N", role="input", description="force on the mass"),),
    (
        Signal("x", 3, unit="m", role="state", description="positions"),
        Signal("der(x)", unit="m/s"),
        Signal("on", type="boolean", variability="discrete"),
    ),
)


def schema_of(part):
    """Return the FileDescriptorSet of a part."""
    ((_, data),) = part_schemas([part])
    return data


def comments(data):
    """Return the comments of a FileDescriptorSet by path, and its one message."""
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(data).file
    found = {}
    for location in file.source_code_info.location:
        found[tuple(location.path)] = location.leading_comments
    return found, file.message_type[0]


def test_every_field_has_a_comment_with_name_unit_role_and_description():
    """The paths are those of descriptor.proto: 4 a message of the file, 2 a field of it."""
    (part,) = split_channel(Channel("plant", INTERFACE, 0), kind="descriptor", step_ns=1)
    found, message = comments(schema_of(part))
    assert found == {
        (4, 0): " plant, descriptor\n",
        (4, 0, 2, 0): " u [N], input: force on the mass\n",
        (4, 0, 2, 1): " x[0] [m], state: positions\n",
        (4, 0, 2, 2): " x[1] [m], state\n",
        (4, 0, 2, 3): " x[2] [m], state\n",
        (4, 0, 2, 4): " der(x) [m/s], output\n",
        (4, 0, 2, 5): " on, output, boolean\n",
    }
    assert [field.name for field in message.field] == ["u", "x_0", "x_1", "x_2", "der_x", "on"]


def test_protobuf_takes_a_schema_with_comments():
    """Every location has a span of three or four numbers, as descriptor.proto demands."""
    (part,) = split_channel(Channel("plant", INTERFACE, 0), kind="", step_ns=1)
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(schema_of(part)).file
    assert all(len(location.span) in (3, 4) for location in file.source_code_info.location)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("cosim.plant"))
    assert kind(x_1=2.0).x_1 == 2.0


def test_parts_of_a_wide_component_have_the_comments_of_their_own_elements():
    """The second part begins inside a signal."""
    wide = Interface((Signal("u"),), (Signal("y", 5000, unit="K", description="temperatures"),))
    parts = split_channel(Channel("wide", wide, 0), kind="", step_ns=1)
    first, _ = comments(schema_of(parts[0]))
    second, _ = comments(schema_of(parts[1]))
    assert first[4, 0, 2, 1] == " y[0] [K], output: temperatures\n"
    assert second[4, 0, 2, 0] == " y[4095] [K], output\n"
    assert len(first) + len(second) == 2 + 5001


def test_a_description_with_half_a_character_can_be_written():
    """JSON of the metadata keeps it, a text of protobuf cannot."""
    odd = Interface((), (Signal("y", description="a\ud800b"),))
    (part,) = split_channel(Channel("odd", odd, 0), kind="", step_ns=1)
    found, _ = comments(schema_of(part))
    assert found[4, 0, 2, 0] == " y, output: a?b\n"


def test_the_stock_decoder_reads_a_log_with_comments(tmp_path):
    """The decoder of mcap-protobuf-support gives every value, bit for bit."""
    layout = Layout((Channel("plant", INTERFACE, 0),))
    rows = table(layout, 20)
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan(layout))
        for block, signals in blocks(rows, 7):
            recorder.write(block, signals)
    decoded = []
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, _, _, message in reader.iter_decoded_messages("/plant"):
            assert schema.name == "cosim.plant"
            names = [field.name for field in message.DESCRIPTOR.fields]
            decoded.append([getattr(message, name) for name in names])
    assert same_bits(np.array(decoded), rows)


def test_a_log_gives_the_descriptions_back(tmp_path):
    """They stand in the metadata of the channel, under its checksum."""
    layout = Layout((Channel("plant", INTERFACE, 0),))
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan(layout))
        for block, signals in blocks(table(layout, 20), 7):
            recorder.write(block, signals)
    signals = Log(tmp_path / "a.mcap").channels["plant"].signals
    texts = [signal.description for signal in signals]
    assert texts == ["force on the mass", "positions", "", ""]


def test_descriptions_change_no_hash():
    """The text that the content hash covers is the same without them."""
    plain = Interface((Signal("u", unit="N", role="input"),))
    described = Interface((Signal("u", unit="N", role="input", description="force"),))
    assert signals_json(plain) == signals_json(described)
    assert plain == described


def test_descriptions_that_are_no_texts_are_refused(subtests):
    """As any other damage of the metadata."""
    (part,) = split_channel(Channel("plant", INTERFACE, 0), kind="", step_ns=1)
    for text in ('{"u": 5}', '["u"]', '{"u": null}'):
        items = {**without_checksum(part.metadata), "cosim.descriptions": text}
        with (
            subtests.test(case=text),
            pytest.raises(Exception, match=r"description|expected a table"),
        ):
            read_part(add_checksum("cosim.channel", items))
