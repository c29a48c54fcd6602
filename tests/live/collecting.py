"""What a server would send, collected in place of Foxglove's SDK: no viewers, no waiting."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from tests.log.decoding import message_class


class CollectingSdk:
    """Stands for the SDK, and for a viewer that subscribes to all topics."""

    Context = Schema = SimpleNamespace
    websocket = SimpleNamespace(Capability=SimpleNamespace(Time="time"))
    port = 9

    def __init__(self):
        self.topics = {}
        self.times = []  # [ns] that viewers were told
        self.sent = []  # times of all messages [ns]

    def Channel(self, name, *, schema, **_):
        self.topics[name] = CollectingTopic(message_class(schema.name, schema.data), self.sent)
        return self.topics[name]

    def start_server(self, **_):
        return self

    def broadcast_time(self, time_ns):
        self.times.append(time_ns)

    def stop(self):
        pass


class CollectingTopic:
    """Keeps what is published; decoded by stock protobuf where it is asked for."""

    def __init__(self, kind, sent):
        self._kind = kind
        self._sent = sent
        self._data = []
        self.times = []  # of the messages [ns]

    def has_sinks(self):
        return True

    def log(self, data, *, log_time):
        self.times.append(log_time)
        self._sent.append(log_time)
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


def sent(server):
    """Return what a server has collected."""
    return server._sdk
