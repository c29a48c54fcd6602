"""Logs taken apart and written anew, with all checksums right: what is wrong reaches the reader."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from cosim.log.layout import copy_columns, record_dtype
from cosim.log.metadata import CHECKSUM, add_checksum


@dataclass
class Content:
    """What a log consists of."""

    channels: dict = field(default_factory=dict)  # id: (topic, schema, metadata)
    metadata: list = field(default_factory=list)  # (name, items)
    attachments: list = field(default_factory=list)  # (name, data)
    messages: list = field(default_factory=list)  # (channel id, time, sequence, data)


def without_checksum(items):
    """Return a map without its checksum."""
    return {key: value for key, value in items.items() if key != CHECKSUM}


def take_apart(path):
    """Return the content of a log."""
    content = Content()
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        for number, channel in summary.channels.items():
            schema = summary.schemas[channel.schema_id]
            items = without_checksum(channel.metadata)
            content.channels[number] = (channel.topic, schema, items)
        for item in reader.iter_metadata():
            content.metadata.append((item.name, without_checksum(item.metadata)))
        for attachment in reader.iter_attachments():
            content.attachments.append((attachment.name, attachment.data))
        for _, channel, message in reader.iter_messages(log_time_order=False):
            row = (channel.id, message.log_time, message.sequence, message.data)
            content.messages.append(row)
    return content


def put_together(content, path, **options):
    """Write a log of this content."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        ids = {}
        for number, (topic, schema, items) in content.channels.items():
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
            if items:
                items = add_checksum("cosim.channel", items)
            ids[number] = writer.register_channel(topic, "protobuf", schema_id, items)
        for name, items in content.metadata:
            writer.add_metadata(name, add_checksum(name, items))
        for name, data in content.attachments:
            writer.add_attachment(0, 0, name, "text/plain", data)
        for number, time_ns, sequence, data in content.messages:
            writer.add_message(ids[number], time_ns, data, time_ns, sequence)
        writer.finish()
    return path


def change_rows(content, component, change):
    """Change the rows of a component in place, with ``change(number, values)`` of each."""
    (own,) = [n for n, channel in content.channels.items() if channel[0] == f"/{component}"]
    rows = []
    count = 0
    for number, time_ns, sequence, data in content.messages:
        if number == own:
            size = len(data) // 9
            record = np.zeros(1, record_dtype(size))
            record.view("u1")[-len(data) :] = np.frombuffer(data, "u1")
            values = np.empty((1, size))
            copy_columns(record, values, size=size, columns=slice(0, size))
            change(count, values[0])
            record["short"]["value"] = values
            data = record.tobytes()[-len(data) :]
            count += 1
        rows.append((number, time_ns, sequence, data))
    content.messages = rows


def rewrite(source, target, *, order=lambda messages: messages, **options):
    """Copy a log message by message through mcap's own writer."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        summary = reader.get_summary()
        writer = Writer(out, **options)
        writer.start()
        ids = {}
        for number, channel in summary.channels.items():
            schema = summary.schemas[channel.schema_id]
            schema_id = writer.register_schema(f"other.{schema.name}", schema.encoding, schema.data)
            ids[number] = writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        for item in reader.iter_metadata():
            writer.add_metadata(item.name, item.metadata)
        for _, channel, message in order(list(reader.iter_messages())):
            channel_id = ids[channel.id]
            times = {"log_time": message.log_time, "publish_time": message.publish_time}
            writer.add_message(channel_id, data=message.data, sequence=message.sequence, **times)
        writer.finish()


def rows_of_plant(content):
    """Return where the messages of the plant stand among all."""
    (plant,) = [number for number, channel in content.channels.items() if channel[0] == "/plant"]
    return [index for index, message in enumerate(content.messages) if message[0] == plant]
