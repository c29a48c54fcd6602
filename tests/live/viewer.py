"""A viewer: a WebSocket client of Foxglove's protocol, and the stock decoder of protobuf.

The formats are those of https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md.
"""

from __future__ import annotations

import base64
import json
import struct
from collections import defaultdict
from contextlib import ExitStack

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.sync.client import connect

SUBPROTOCOL = "foxglove.sdk.v1"
PATIENCE = 30.0  # s, for one message; the tests fail behind it
_MESSAGE = 1  # opcodes of binary messages
_TIME = 2
MOST_MESSAGES = 1_000_000


class Viewer:
    """Connects to a server, subscribes, and decodes with the schemas that were advertised."""

    def __init__(self, url):
        self._opened = ExitStack()
        connection = connect(
            url,
            subprotocols=[SUBPROTOCOL],
            proxy=None,
            max_size=None,
            open_timeout=PATIENCE,
            close_timeout=0.1,  # the server may not answer
        )
        self._socket = self._opened.enter_context(connection)
        assert self._socket.subprotocol == SUBPROTOCOL
        self.info = self._received()
        assert self.info["op"] == "serverInfo"
        self.channels = {}
        self.times = []  # [ns] that the server said
        self._topics = {}  # by subscription
        self._classes = {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._opened.close()

    def wait_for_channels(self, *topics):
        """Take what is advertised until some topics are there."""
        for _ in range(MOST_MESSAGES):
            if self.channels.keys() >= set(topics):
                return
            self._take(self._received())
        raise AssertionError(f"not advertised: {topics}")

    def subscribe(self, *topics):
        """Subscribe to topics in one message."""
        self.wait_for_channels(*topics)
        subscriptions = []
        for topic in topics:
            number = len(self._topics) + 1
            self._topics[number] = topic
            subscriptions.append({"id": number, "channelId": self.channels[topic]["id"]})
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def messages(self, counts):
        """Receive until there are so many messages of each topic: time [ns] and message."""
        found = defaultdict(list)
        for _ in range(MOST_MESSAGES):
            if all(len(found[topic]) >= count for topic, count in counts.items()):
                return found
            taken = self._take(self._received())
            if taken is not None:
                topic, time_ns, message = taken
                found[topic].append((time_ns, message))
        raise AssertionError(f"not received: {counts}")

    def wait_for_time(self, time_ns):
        """Receive until the server has told a time [ns]."""
        while time_ns not in self.times:
            self._take(self._received())

    def _received(self):
        message = self._socket.recv(timeout=PATIENCE)
        return json.loads(message) if isinstance(message, str) else message

    def _take(self, message):
        """Return topic, time and decoded message; None of what is no message."""
        if isinstance(message, dict):
            if message["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in message["channels"]}
            return None
        if message[0] == _TIME:
            self.times.append(struct.unpack_from("<Q", message, 1)[0])
            return None
        assert message[0] == _MESSAGE
        number, time_ns = struct.unpack_from("<IQ", message, 1)
        topic = self._topics[number]
        return topic, time_ns, self._class(topic).FromString(message[13:])

    def _class(self, topic):
        if topic not in self._classes:
            channel = self.channels[topic]
            assert (channel["encoding"], channel["schemaEncoding"]) == ("protobuf", "protobuf")
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(self.schema(topic)).file:
                pool.Add(file)
            descriptor = pool.FindMessageTypeByName(channel["schemaName"])
            self._classes[topic] = message_factory.GetMessageClass(descriptor)
        return self._classes[topic]

    def schema(self, topic):
        """Return the schema that was advertised."""
        return base64.b64decode(self.channels[topic]["schema"])


def fields(message):
    """Return the values of a message in the order of its fields."""
    return [getattr(message, field.name) for field in message.DESCRIPTOR.fields]
