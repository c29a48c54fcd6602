"""The server that viewers connect to during a run or while a log is played."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Final, Self, final

from cosim.core.recorders import Tee
from cosim.core.recording import Recorder
from cosim.errors import UsageError
from cosim.live.connection import ViewerConnection
from cosim.live.recorder import LiveRecorder

HOST: Final = "127.0.0.1"
PORT: Final = 8765  # that viewers suggest


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
        self._host = host
        self._port = port
        self.signals = tuple(signals)
        self._hosts = tuple(allow_host)
        self._notice = notice
        self._connection: ViewerConnection | None = None

    def __enter__(self) -> Self:
        """Take the address.

        Raises
        ------
        UsageError
            If foxglove-sdk is not installed, or the address cannot be used.
        """
        self._connection = ViewerConnection(self._host, self._port, "cosim", self._hosts)
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect viewers; what is on its way to them arrives."""
        connection = self.connection
        self._connection = None
        connection.close()

    @property
    def connection(self) -> ViewerConnection:
        """The connection to viewers.

        Raises
        ------
        UsageError
            If the server is outside its ``with`` block.
        """
        if self._connection is None:
            raise UsageError("this LiveServer has no address yet; use it in a 'with' block")
        return self._connection

    def free_connection(self) -> ViewerConnection:
        """Return the connection to viewers for one run, or for one log.

        Raises
        ------
        UsageError
            If the server is outside its ``with`` block, or shows something already.
        """
        if self.connection.listens:
            raise UsageError("this LiveServer has already shown a run or a log; create another one")
        return self.connection

    def listen(self) -> None:
        """Start the server, when all topics are there, so that viewers can connect.

        Raises
        ------
        UsageError
            If somebody else has taken the address.
        """
        self.connection.listen()
        if self._notice is not None:
            self._notice(self.url)

    @property
    def url(self) -> str:
        """What viewers connect to: ``ws://127.0.0.1:8765``."""
        return self.connection.url

    def beside(self, recorder: Recorder, kinds: Mapping[str, str]) -> Recorder:
        """Return what takes a run, shows it, and passes it on to its recorder.

        Parameters
        ----------
        recorder : Recorder
        kinds : mapping of component name to str
            The kinds of the components.
        """
        live = LiveRecorder(self.free_connection(), kinds, self.signals, self.listen)
        return Tee(recorder, live)

    def wait_for_viewer(self, check: Callable[[], None] = lambda: None) -> None:
        """Wait until a viewer has subscribed; what ``check`` raises ends the waiting."""
        self.connection.wait_for_viewer(check)
