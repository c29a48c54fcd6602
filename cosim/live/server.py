"""The server that viewers connect to during a run or while a log is played.

Viewers receive rows and messages in order of time, with the schemas that they have in a log.
A message goes into the queue of every viewer that has subscribed to its topic; threads of
Foxglove's SDK send the queues. If the queue of a viewer is full, its oldest messages are dropped; a
viewer that takes nothing at all is disconnected. So no viewer delays the sender.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from types import ModuleType, SimpleNamespace, TracebackType
from typing import TYPE_CHECKING, Any, Final, Self, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block
from cosim.core.recorded.selection import is_pattern, select_signals
from cosim.core.recorded.signals import find_channel
from cosim.core.recorders import Tee
from cosim.core.recording import Plan, Recorder
from cosim.core.signals import Channel
from cosim.errors import UsageError
from cosim.instants import StepNs
from cosim.live.gate import PATIENCE, Gate
from cosim.log.layout import Part, blank_records, fill_values
from cosim.log.preamble import (
    EVENT_TOPIC,
    LOG_TOPIC,
    SCHEMAS,
    STEP_TOPIC,
    MessageEncoder,
    parts_of,
)

if TYPE_CHECKING:
    from foxglove import Channel as SdkChannel

HOST: Final = "127.0.0.1"
PORT: Final = 8765  # that viewers suggest
BACKLOG: Final = 2**16  # messages that wait for a viewer, before the oldest is dropped
# Instants that viewers are told of at once: they are never dropped, so that a slow viewer of more
# would be disconnected. A message has its own time anyhow.
MOST_TIMES: Final = 10
_MESSAGE_HEADER: Final = 31  # bytes of a record before its message
_QUIET: Final = 0.25  # s in which viewers receive, or subscribe to, what is left
_LOOK: Final = 0.05  # s between two looks at whether the program is to end


def load_sdk() -> ModuleType:
    """Import the SDK.

    Raises
    ------
    UsageError
        If it is not installed.
    """
    try:
        import foxglove
    except ImportError as error:
        raise UsageError(
            "viewers need foxglove-sdk, which is not installed: pip install 'cosim[live]', or, in "
            "a clone of cosim, pip install -e '.[live]'"
        ) from error
    # Without a handler Python would print some of its messages about viewers.
    logging.getLogger("foxglove").addHandler(logging.NullHandler())
    return foxglove


@final
class LiveServer:
    """A WebSocket server for Foxglove and Lichtblick, inside a ``with`` block.

    Given to :func:`cosim.run` as ``live`` it shows the run, given to :func:`cosim.live.play` a log:
    one of them. Viewers can connect from when that begins.

    Parameters
    ----------
    host : str
        Address to listen on; by default viewers on this machine alone can connect.
    port : int
        0: any free one.
    signals : sequence of str
        Components, signals or patterns such as ``*.delta`` to publish, with all of the channels
        that hold them; none: all.
    allow_host : sequence of str
        Further host names: of pages that viewers are, such as ``viewer.example.org``, and of this
        machine. Without: pages of this machine, files, app.foxglove.dev, and programs.
    notice : callable, optional
        Called with the address of the server when viewers can connect.
    """

    def __init__(
        self,
        *,
        host: str = HOST,
        port: int = PORT,
        signals: Sequence[str] = (),
        allow_host: Sequence[str] = (),
        notice: Callable[[str], None] | None = None,
    ) -> None:
        self._address = (host, port, tuple(allow_host))
        self.signals = tuple(signals)
        self._notice = notice
        self._gate: Gate | None = None

    def __enter__(self) -> Self:
        """Take the address.

        Raises
        ------
        UsageError
            If foxglove-sdk is not installed, or the address cannot be used.
        """
        self._sdk = load_sdk()
        self._context = self._sdk.Context()
        self._server: Any = None  # of the SDK, which listens behind the gate
        self._subscribed = threading.Event()
        self._parts: list[tuple[Part, SdkChannel]] = []
        self._topics: dict[str, SdkChannel] = {}  # beside the rows
        self._waiting: list[tuple[int, SdkChannel, bytes]] = []
        self._told_ns = -1
        self._gate = Gate(*self._address)
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect viewers; what is on its way to them arrives."""
        gate = self._opened
        self._gate = None
        if self._server is not None:
            topics = [*self._topics.values(), *(topic for _, topic in self._parts)]
            if any(topic.has_sinks() for topic in topics):
                time.sleep(_QUIET)
            # it waits for answers of viewers, which need not come
            stopping = threading.Thread(target=self._server.stop, daemon=True)
            stopping.start()
            stopping.join(PATIENCE)
        gate.close()

    @property
    def _opened(self) -> Gate:
        if self._gate is None:
            raise UsageError("this LiveServer has no address yet; use it in a 'with' block")
        return self._gate

    @property
    def url(self) -> str:
        """What viewers connect to: ``ws://127.0.0.1:8765``."""
        return self._opened.url

    def beside(self, recorder: Recorder, kinds: Mapping[str, str]) -> Recorder:
        """Return what takes a run, shows it, and passes it on to its recorder.

        Parameters
        ----------
        recorder : Recorder
        kinds : mapping of component name to str
            The kinds of the components.
        """
        self._check_free()
        return Tee(recorder, LiveRecorder(self, kinds))

    def _check_free(self) -> None:
        if self._opened.is_open:
            raise UsageError("this LiveServer has already shown a run or a log; create another one")

    def advertise(
        self,
        channels: Mapping[str, Channel],
        *,
        kinds: Mapping[str, str],
        step_ns: StepNs,
        topics: Iterable[str],
        source: str,
    ) -> None:
        """Add all topics of a run or a log, before viewers can connect.

        Parameters
        ----------
        channels : mapping of component name to Channel
        kinds : mapping of component name to str
        step_ns : int
            Communication step [ns].
        topics : iterable of str
            Those beside the rows.
        source : str
            Where signals are looked for, for messages.

        Raises
        ------
        UsageError
            If the server is outside its ``with`` block, or has shown something already.
        UnknownSignalError
            If a component or signal to publish is not there.
        """
        self._check_free()
        wanted = _wanted(self.signals, channels, source)
        for part, schema in parts_of(channels.values(), kinds, step_ns):
            if not self.signals or any(_holds(part, *columns) for columns in wanted):
                self._parts.append((part, self._topic(f"/{part.title}", *schema, part.metadata)))
        for name in topics:
            message = SCHEMAS[name]
            self._topics[name] = self._topic(name, message.name, message.serialized, {})

    def _topic(
        self, name: str, schema_name: str, schema: bytes, metadata: Mapping[str, str]
    ) -> SdkChannel:
        # The SDK tells connected viewers of a topic before it takes subscriptions to it: one that
        # subscribes at once may be refused for good. So all are there before.
        topic: SdkChannel = self._sdk.Channel(
            name,
            message_encoding="protobuf",
            schema=self._sdk.Schema(name=schema_name, encoding="protobuf", data=schema),
            context=self._context,
            metadata=dict(metadata),
        )
        return topic

    def listen(self) -> None:
        """Start the server, when all topics are there, so that viewers can connect."""
        gate = self._opened
        # of this machine alone, and nobody guesses it: who knows it passes the gate
        octets = [secrets.randbelow(256), secrets.randbelow(256), 1 + secrets.randbelow(254)]
        try:
            address = self._start(".".join(map(str, [127, *octets])))
        except RuntimeError:  # a system may have one address of its own only
            address = self._start(HOST)
        gate.open(address)
        if self._notice is not None:
            self._notice(gate.url)

    def _start(self, host: str) -> tuple[str, int]:
        """Start the server behind the gate; return its address."""
        hearing = SimpleNamespace(
            on_subscribe=lambda client, channel: self._subscribed.set(),
            on_unsubscribe=lambda client, channel: None,  # the SDK sends no more
        )
        self._server = self._sdk.start_server(
            name="cosim",
            host=host,
            port=0,
            capabilities=[self._sdk.websocket.Capability.Time],
            server_listener=hearing,
            context=self._context,
            message_backlog_size=BACKLOG,
        )
        return host, self._server.port

    @property
    def components(self) -> list[str]:
        """Names of the components that are published."""
        return list(dict.fromkeys(part.channel.name for part, _ in self._parts))

    def add_rows(self, component: str, time_ns: Nanoseconds, rows: Matrix) -> None:
        """Add rows of a component, where a viewer has subscribed to it.

        Parameters
        ----------
        component : str
        time_ns : Nanoseconds, shape (n,)
        rows : Matrix, shape (n, width of the component)
        """
        for part, topic in self._parts:
            if part.channel.name == component and topic.has_sinks():
                messages = _encoded(rows[:, part.columns])
                for instant, data in zip(time_ns.tolist(), messages, strict=True):
                    self._waiting.append((instant, topic, data))

    def add_message(self, topic: str, time_ns: int, data: bytes) -> None:
        """Add a message of a topic beside the rows."""
        self._waiting.append((time_ns, self._topics[topic], data))

    def send(self) -> None:
        """Send what was added, in the order of time; of one instant in the order of the calls."""
        self._waiting.sort(key=itemgetter(0))
        instants = sorted({time_ns for time_ns, _, _ in self._waiting})
        stride = max(1, -(-len(instants) // MOST_TIMES))
        marked = {*instants[::stride], *instants[-1:]}
        for time_ns, topic, data in self._waiting:
            if time_ns in marked and time_ns > self._told_ns:
                self._told_ns = time_ns
                self._server.broadcast_time(time_ns)
            topic.log(data, log_time=time_ns)
        self._waiting.clear()

    def turn_back(self) -> None:
        """Allow the next time to be an earlier one."""
        self._told_ns = -1

    def wait_for_viewer(self, check: Callable[[], None] = lambda: None) -> None:
        """Wait until viewers have subscribed, and subscribe to no more.

        Parameters
        ----------
        check : callable
            Called again and again; what it raises ends the waiting.
        """
        while self._opened and not self._subscribed.wait(_LOOK):
            check()
        # They subscribe to one topic after the other.
        while self._subscribed.is_set():
            self._subscribed.clear()
            self._subscribed.wait(_QUIET)
            check()


def _wanted(
    names: Sequence[str], channels: Mapping[str, Channel], source: str
) -> list[tuple[str, slice]]:
    """Return components and columns that are named: components, signals, elements, patterns."""
    wanted = []
    for name in names:
        if "." in name or is_pattern(name):
            ports = select_signals(channels, name, source=source).values()
            wanted += [(port.channel.name, port.columns) for port in ports]
        else:
            channel = find_channel(channels, name, source=source)
            wanted.append((channel.name, slice(0, channel.columns.stop - channel.start)))
    return wanted


def _holds(part: Part, component: str, columns: slice) -> bool:
    own = part.columns
    overlaps = columns.start < own.stop and own.start < columns.stop
    # A component without elements is wanted as a whole.
    return component == part.channel.name and (overlaps or columns.start == columns.stop)


def _encoded(rows: Matrix) -> list[bytes]:
    """Return the protobuf messages of rows, shape (n, size)."""
    count, size = rows.shape
    records = blank_records(0, size, count)
    fill_values(records, rows)
    length = records.itemsize
    data = records.tobytes()
    starts = range(_MESSAGE_HEADER, _MESSAGE_HEADER + count * length, length)
    return [data[start : start + length - _MESSAGE_HEADER] for start in starts]


@final
class LiveRecorder(MessageEncoder):
    """Publishes rows, messages, events and substeps of a run; keeps nothing.

    Parameters
    ----------
    server : LiveServer
    kinds : mapping of component name to str
    """

    def __init__(self, server: LiveServer, kinds: Mapping[str, str]) -> None:
        self._server = server
        self._kinds = kinds
        self._channels: dict[str, Channel] = {}  # until the run begins
        self._has_rows = False

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Send what came after the last block."""
        self._server.send()

    def begin(self, plan: Plan) -> None:
        """Advertise the topics; whether there will be events and substeps is not known.

        Raises
        ------
        UnknownSignalError
            If a component or signal to publish is not there.
        """
        channels = {channel.name: channel for channel in plan.layout.channels}
        self._server.advertise(
            channels,
            kinds=self._kinds,
            step_ns=plan.step_ns,
            topics=(LOG_TOPIC, EVENT_TOPIC, STEP_TOPIC),
            source="the run",
        )
        self._channels = channels
        self._server.listen()

    def write(self, block: Block, signals: Matrix) -> None:
        """Publish the new rows, of each component those that its log has."""
        first = 1 if self._has_rows or block.index else 0
        self._has_rows = True
        rows = np.arange(first, block.steps + 1)
        for name in self._server.components:
            channel = self._channels[name]
            kept = rows[(block.index + rows) % channel.period == 0]
            own_rows = signals[kept, channel.columns]
            self._server.add_rows(name, block.time_ns[kept], own_rows)
        self._server.send()

    def _add_message(self, topic: str, time_ns: int, data: bytes) -> None:
        """Publish a message with the next rows; nothing of a run that could not begin."""
        if self._channels:
            self._server.add_message(topic, time_ns, data)
