"""Send rows and messages to viewers in order of time, with the schemas that they have in a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import Final, final

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.signals import Channel
from cosim.instants import StepNs
from cosim.live.connection import LiveTopic, ViewerConnection
from cosim.live.selection import selected
from cosim.log.layout import Part, blank_records, fill_values, split_channel
from cosim.log.preamble import SCHEMAS, part_schemas

# Instants that viewers are told of at once: they are never dropped, so that a slow viewer of more
# would be disconnected. A message has its own time anyhow.
MOST_TIMES: Final = 10
_MESSAGE_HEADER: Final = 31  # bytes of a record before its message


@final
class Publisher:
    """Collects what belongs to some instants, and sends it in their order.

    Parameters
    ----------
    connection : ViewerConnection
    channels : mapping of component name to Channel
    kinds : mapping of component name to str
    step_ns : int
        Communication step [ns].
    names : sequence of str
        Components or signals to publish; none: all.
    source : str
        Where these are looked for, for messages.

    Raises
    ------
    UnknownSignalError
        If there is no such component or signal.
    """

    def __init__(
        self,
        connection: ViewerConnection,
        channels: Mapping[str, Channel],
        *,
        kinds: Mapping[str, str],
        step_ns: StepNs,
        names: Sequence[str],
        source: str,
    ) -> None:
        self._connection = connection
        parts: list[Part] = []
        for name, channel in channels.items():
            parts += split_channel(channel, kind=kinds.get(name, ""), step_ns=step_ns)
        self._parts = selected(parts, names, channels, source=source)
        titles = {part.title for part in self._parts}
        self._topics: dict[str, LiveTopic] = {}
        for part, (schema_name, schema) in zip(parts, part_schemas(parts), strict=True):
            if part.title in titles:
                self._topics[part.title] = connection.topic(
                    f"/{part.title}",
                    schema_name=schema_name,
                    schema=schema,
                    metadata=part.metadata,
                )
        self._waiting: list[tuple[int, LiveTopic, bytes]] = []

    @property
    def components(self) -> list[str]:
        """Names of the components that are published."""
        return list(dict.fromkeys(part.channel.name for part in self._parts))

    def add_rows(self, component: str, time_ns: Nanoseconds, rows: Matrix) -> None:
        """Add rows of a component, where a viewer has subscribed to it.

        Parameters
        ----------
        component : str
        time_ns : Nanoseconds, shape (n,)
        rows : Matrix, shape (n, width of the component)
        """
        for part in self._parts:
            topic = self._topics[part.title]
            if part.channel.name == component and topic.is_watched:
                messages = _encoded(rows[:, part.columns])
                for instant, data in zip(time_ns.tolist(), messages, strict=True):
                    self._waiting.append((instant, topic, data))

    def add_message(self, topic: str, time_ns: int, data: bytes) -> None:
        """Add a message beside the rows, of a topic that is advertised."""
        self._waiting.append((time_ns, self._topics[topic], data))

    def advertise(self, topic: str) -> None:
        """Add a topic beside the rows, for viewers to subscribe to."""
        schema = SCHEMAS[topic]
        self._topics[topic] = self._connection.topic(
            topic, schema_name=schema.name, schema=schema.serialized, metadata={}
        )

    def send(self) -> None:
        """Send what was added, in the order of time; of one instant in the order of the calls."""
        self._waiting.sort(key=itemgetter(0))
        instants = sorted({time_ns for time_ns, _, _ in self._waiting})
        stride = -(-len(instants) // MOST_TIMES)
        marked = {*instants[::stride], *instants[-1:]} if instants else set()
        for time_ns, topic, data in self._waiting:
            if time_ns in marked:
                self._connection.set_time(time_ns)
            topic.publish(time_ns, data)
        self._waiting.clear()


def _encoded(rows: Matrix) -> list[bytes]:
    """Return the protobuf messages of rows, shape (n, size)."""
    count, size = rows.shape
    records = blank_records(0, size, count)
    fill_values(records, rows)
    length = records.itemsize
    data = records.tobytes()
    starts = range(_MESSAGE_HEADER, _MESSAGE_HEADER + count * length, length)
    return [data[start : start + length - _MESSAGE_HEADER] for start in starts]
