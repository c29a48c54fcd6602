"""What a server would send, collected in place of a WebSocket: no SDK, no threads, no waiting."""

from __future__ import annotations

import numpy as np

from tests.log.decoding import message_class


class CollectingConnection:
    """Stands for the connection to a viewer that subscribes to all topics."""

    def __init__(self, host, port, name, hosts=()):
        self.url = f"ws://{host}:{port}"
        self.listens = False
        self.topics = {}
        self.times = []  # [ns] that viewers were told

    def topic(self, name, *, schema_name, schema, metadata):
        assert not self.listens
        self.topics[name] = CollectingTopic(message_class(schema_name, schema))
        return self.topics[name]

    def listen(self):
        self.listens = True

    def set_time(self, time_ns):
        self.times.append(time_ns)

    def turn_back(self):
        pass

    def wait_for_viewer(self, check):
        pass

    def close(self):
        pass


class CollectingTopic:
    """Keeps what is published; decoded by stock protobuf where it is asked for."""

    is_watched = True

    def __init__(self, kind):
        self._kind = kind
        self._data = []
        self.times = []  # of the messages [ns]

    def publish(self, time_ns, data):
        self.times.append(time_ns)
        self._data.append(data)

    @property
    def messages(self):
        """Times and messages."""
        return zip(self.times, map(self._kind.FromString, self._data), strict=True)

    def rows(self, stride=1):
        """Return the values of the messages, in the order of their fields."""
        names = [field.name for field in self._kind.DESCRIPTOR.fields]
        messages = map(self._kind.FromString, self._data[::stride])
        return np.array([[getattr(message, name) for name in names] for message in messages])
