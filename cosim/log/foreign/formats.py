"""How the messages of a channel are decoded: which format reads which encoding and schema."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any, Final, Protocol

from cosim.log.foreign.fields import FieldPath, FieldProblem
from cosim.log.foreign.topics import ForeignChannel, ForeignSchema

MOST_LISTED: Final = 10_000  # fields of a message
_READABLE: Final = "protobuf, json, or cdr with a schema in ros2msg or ros2idl"


class MessageFormat(Protocol):
    """How the messages of a channel are decoded."""

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields; ``x[]`` may have any length.

        ``sample`` is a message of the channel; empty: there is none.
        """
        ...

    def decode(self, data: bytes) -> Any:
        """Return a message, whatever that is; raise FieldProblem if it cannot be decoded."""
        ...

    def value(self, message: Any, path: FieldPath) -> Any:
        """Return a number, a sequence of them, or None where the message has none.

        Raises
        ------
        FieldProblem
            If there is no such field, or it is no number.
        """
        ...


def listed_fields(channel: ForeignChannel, sample: bytes) -> dict[str, str]:
    """Return the types of the numeric fields of a channel's messages by name, at most 10 000.

    Raises
    ------
    FieldProblem
        As from :func:`format_of`, or if the message cannot be decoded.
    """
    return dict(islice(format_of(channel).fields(sample), MOST_LISTED))


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
            from cosim.log.foreign.json_format import JsonFormat  # each only where it is needed

            return JsonFormat()
        case "protobuf", "protobuf":
            from cosim.log.foreign.protobuf_format import ProtobufFormat

            return ProtobufFormat(schema)
        case "cdr", "ros2msg" | "ros2idl":
            from cosim.log.foreign.ros import RosFormat

            return RosFormat(schema)
    found = f"a schema in {schema.encoding!r}" if channel.schema is not None else "no schema"
    raise FieldProblem(f"expected messages in {_READABLE}, got {channel.encoding!r} with {found}")
