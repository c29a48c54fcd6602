"""MCAP files of other tools, by the writers and encoders that are usual for them, and readers."""

from __future__ import annotations

import json

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from cosim.log.foreign.samples import read_fields

EPOCH = 1_700_000_000_000_000_000  # ns: wall clock, as logs of the field have it
STEP = 10_000_000  # ns
COUNT = 300
COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}

Field = descriptor_pb2.FieldDescriptorProto


def _field(message, name, number, type_name, *, repeated=False, optional=False, of=None):
    field = message.field.add(name=name, number=number)
    field.label = Field.LABEL_REPEATED if repeated else Field.LABEL_OPTIONAL
    field.type = getattr(Field, f"TYPE_{type_name.upper()}")
    if of is not None:
        field.type_name = of
    if optional:
        field.proto3_optional = True
        field.oneof_index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")


def state_class():
    """Return the class of demo.State, a message with fields of every sort."""
    file = descriptor_pb2.FileDescriptorProto(
        name="demo/state.proto", package="demo", syntax="proto3"
    )
    file.dependency.append("google/protobuf/timestamp.proto")
    mode = file.enum_type.add(name="Mode")
    mode.value.add(name="OFF", number=0)
    mode.value.add(name="DRIVING", number=3)
    point = file.message_type.add(name="Point")
    _field(point, "x", 1, "float")
    _field(point, "y", 2, "float")
    inner = file.message_type.add(name="Inner")
    _field(inner, "points", 1, "message", repeated=True, of=".demo.Point")
    _field(inner, "offset", 2, "message", of=".demo.Point")
    _field(inner, "again", 3, "message", of=".demo.Inner")
    state = file.message_type.add(name="State")
    _field(state, "position", 1, "double")
    _field(state, "effort", 2, "double", repeated=True)
    _field(state, "mode", 3, "enum", of=".demo.Mode")
    _field(state, "on", 4, "bool")
    _field(state, "inner", 5, "message", of=".demo.Inner")
    _field(state, "stamp", 6, "message", of=".google.protobuf.Timestamp")
    _field(state, "count", 7, "sint64")
    _field(state, "name", 8, "string")
    _field(state, "maybe", 9, "double", optional=True)
    _field(state, "raw", 10, "bytes")
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("demo.State"))


def write_json(path, topics, *, schema=None, **options):
    """Write messages in JSON: of every topic, rows of time [ns] and object, in the order given."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        for topic, rows in topics.items():
            number = 0
            if schema is not None:
                number = writer.register_schema(topic, "jsonschema", json.dumps(schema).encode())
            channel = writer.register_channel(topic, "json", number)
            for time_ns, value in rows:
                data = json.dumps(value).encode()
                writer.add_message(channel, time_ns, data, time_ns + 7)
        writer.finish()
    return path


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


def read(path, *fields, **options):
    return read_fields(path, fields, **options)


def decoded(path, factory, topic):
    """Return the messages of a topic as the stock decoder has them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[factory])
        return [item.decoded_message for item in reader.iter_decoded_messages([topic])]
