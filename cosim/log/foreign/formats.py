"""Choose the format of the messages of a channel by the encodings that the file names."""

from __future__ import annotations

from cosim.log.foreign.field_path import FieldProblem
from cosim.log.foreign.topics import ForeignChannel, ForeignSchema
from cosim.log.foreign.values import MessageFormat

READABLE = "protobuf, json, or cdr with a schema in ros2msg or ros2idl"


def format_of(channel: ForeignChannel) -> MessageFormat:
    """Return how the messages of a channel are decoded.

    Raises
    ------
    FieldProblem
        If nothing here decodes them, or their schema cannot be parsed.
    """
    schema = channel.schema or ForeignSchema("", "", b"")
    match channel.encoding, schema.encoding:
        case "json", _:
            from cosim.log.foreign.json_format import JsonFormat

            return JsonFormat()
        case "protobuf", "protobuf":
            from cosim.log.foreign.protobuf_format import ProtobufFormat

            return ProtobufFormat(schema.name, schema.data)
        case "cdr", "ros2msg":
            from cosim.log.foreign.cdr_format import CdrFormat
            from cosim.log.foreign.ros_definitions import read_ros2msg, short_name

            text = _text(schema)
            return CdrFormat(short_name(schema.name), read_ros2msg(schema.name, text))
        case "cdr", "ros2idl":
            from cosim.log.foreign.cdr_format import CdrFormat
            from cosim.log.foreign.ros_definitions import short_name
            from cosim.log.foreign.ros_idl import read_ros2idl

            text = _text(schema)
            return CdrFormat(short_name(schema.name), read_ros2idl(schema.name, text))
    found = f"a schema in {schema.encoding!r}" if channel.schema is not None else "no schema"
    raise FieldProblem(f"expected messages in {READABLE}, got {channel.encoding!r} with {found}")


def _text(schema: ForeignSchema) -> str:
    try:
        return schema.data.decode()
    except UnicodeDecodeError as error:
        raise FieldProblem(f"its schema {schema.name!r} is not UTF-8 text") from error
