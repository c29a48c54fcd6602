"""Messages decoded by stock protobuf."""

from __future__ import annotations

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory


def message_class(name, data):
    """Return the message class that a FileDescriptorSet describes, as a stock decoder does."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
