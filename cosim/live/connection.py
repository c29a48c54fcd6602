"""The WebSocket connection to viewers: the only module that uses Foxglove's SDK.

A message goes into the queue of every viewer that has subscribed to its topic; threads of the SDK
send the queues. If the queue of a viewer is full, its oldest messages are dropped; a viewer that
takes nothing at all is disconnected. So no viewer delays the sender.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Collection, Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, final

from cosim.errors import UsageError
from cosim.live.address import ReservedAddress
from cosim.live.gate import PATIENCE, Gate

if TYPE_CHECKING:
    from foxglove import Channel as SdkChannel
    from foxglove.websocket import WebSocketServer

BACKLOG: Final = 2**16  # messages that wait for a viewer, before the oldest is dropped
_LOOPBACK: Final = "127.0.0.1"
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
class LiveTopic:
    """A topic that viewers may subscribe to."""

    def __init__(self, channel: SdkChannel) -> None:
        self._channel = channel

    @property
    def is_watched(self) -> bool:
        """Whether a viewer has subscribed to it."""
        return self._channel.has_sinks()

    def publish(self, time_ns: int, data: bytes) -> None:
        """Send a message to the viewers that have subscribed; never waits."""
        self._channel.log(data, log_time=time_ns)


class _Listener:
    """Hears of subscriptions, in threads of the SDK."""

    def __init__(self) -> None:
        self.subscribed = threading.Event()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.subscribed.set()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing: the SDK sends no more."""


@final
class ViewerConnection:
    """A WebSocket server at an address: first it gets its topics, then it listens.

    Parameters
    ----------
    host : str
    port : int
        0: any free one.
    name : str
        Shown by viewers.
    hosts : collection of str
        See :func:`cosim.live.gate.refusal`.

    Raises
    ------
    UsageError
        If the SDK is missing, or the address cannot be used.
    """

    def __init__(self, host: str, port: int, name: str, hosts: Collection[str] = ()) -> None:
        self._sdk = load_sdk()
        self._name = name
        self._hosts = (host, *hosts)
        self._gate: Gate | None = None
        self._address = ReservedAddress(host, port)
        self._context = self._sdk.Context()
        self._listener = _Listener()
        self._topics: list[LiveTopic] = []
        self._last_ns = -1
        self._server: WebSocketServer | None = None

    @property
    def url(self) -> str:
        """What viewers connect to: ``ws://127.0.0.1:8765``."""
        return f"ws://{self._address.host}:{self._address.port}"

    @property
    def listens(self) -> bool:
        """Whether viewers can connect."""
        return self._gate is not None

    def topic(
        self, name: str, *, schema_name: str, schema: bytes, metadata: Mapping[str, str]
    ) -> LiveTopic:
        """Add a topic of protobuf messages.

        Parameters
        ----------
        name : str
        schema_name : str
            Name of the messages' type.
        schema : bytes
            Its FileDescriptorSet.
        metadata : mapping of str to str
        """
        # The SDK tells connected viewers of a topic before it takes subscriptions to it: one that
        # subscribes at once may be refused for good.
        assert not self.listens
        declared = self._sdk.Schema(name=schema_name, encoding="protobuf", data=schema)
        channel = self._sdk.Channel(
            name,
            message_encoding="protobuf",
            schema=declared,
            context=self._context,
            metadata=dict(metadata),
        )
        topic = LiveTopic(channel)
        self._topics.append(topic)
        return topic

    def listen(self) -> None:
        """Start the server, so that viewers can connect.

        Raises
        ------
        UsageError
            If somebody else has taken the address.
        """
        server = self._start(_unlikely_address())
        try:
            self._gate = Gate(self._address.socket, server, self._hosts)
        except OSError as error:
            raise self._address.refusal(error.strerror or str(error)) from error

    def _start(self, host: str) -> tuple[str, int]:
        """Start the server behind the gate; return its address."""
        try:
            self._server = self._sdk.start_server(
                name=self._name,
                host=host,
                port=0,
                capabilities=[self._sdk.websocket.Capability.Time],
                server_listener=self._listener,
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            if host == _LOOPBACK:
                raise self._address.refusal(str(error)) from error
            return self._start(_LOOPBACK)
        return host, self._server.port

    def set_time(self, time_ns: int) -> None:
        """Send viewers the time of the messages that follow, where it goes on."""
        assert self._server is not None
        if time_ns > self._last_ns:
            self._last_ns = time_ns
            self._server.broadcast_time(time_ns)

    def turn_back(self) -> None:
        """Allow the next time to be an earlier one."""
        self._last_ns = -1

    def wait_for_viewer(self, check: Callable[[], None]) -> None:
        """Wait until viewers have subscribed, and subscribe to no more.

        Parameters
        ----------
        check : callable
            Called again and again; what it raises ends the waiting.
        """
        subscribed = self._listener.subscribed
        while not subscribed.wait(_LOOK):
            check()
        # They subscribe to one topic after the other.
        while subscribed.is_set():
            subscribed.clear()
            subscribed.wait(_QUIET)
            check()

    def close(self) -> None:
        """Stop the server; first give viewers the time to receive what is on its way."""
        if self._server is not None:
            if any(topic.is_watched for topic in self._topics):
                time.sleep(_QUIET)
            # it waits for answers of viewers, which need not come
            stopping = threading.Thread(target=self._server.stop, daemon=True)
            stopping.start()
            stopping.join(PATIENCE)
        if self._gate is not None:
            self._gate.close()
        self._address.release()


def _unlikely_address() -> str:
    """Return an address of this machine alone that nobody guesses: who knows it passes the gate."""
    return f"127.{secrets.randbelow(256)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
