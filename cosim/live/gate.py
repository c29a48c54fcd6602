"""The gate before the server of viewers: who may connect, and how long that may take.

Any page that a browser shows may connect to any address of its machine. What it cannot do is hide
where it is from: the browser says so, in ``Origin``. A page may also have a name of its own made
an alias of this machine's address, but then asks for that name, in ``Host``. So a viewer has to be

* no page (it sends no Origin), a page of a file, of this machine, or of a host that is known;
* and to ask for this machine by a number, as ``localhost``, or by a name that is known.

Behind the gate the bytes are passed on as they are.

The address belongs to the gate from the start on: one that cannot be used is refused at once, and
port 0 becomes a number. Who connects early waits until there is a server.
"""

from __future__ import annotations

import asyncio
import http.client
import io
import ipaddress
import socket
import threading
from collections.abc import Collection
from contextlib import closing, suppress
from typing import Final, final
from urllib.parse import urlsplit

from cosim.errors import UsageError, option

PATIENCE: Final = 1.0  # s that a handshake, and the end of a connection, may take
_LARGEST_PORT: Final = 2**16 - 1
# pages of viewers
_KNOWN: Final = frozenset({"localhost", "app.foxglove.dev"})
_MOST_BYTES: Final = 2**16  # of a handshake, and at once


def refusal(head: bytes, hosts: Collection[str] = ()) -> str:
    r"""Return why who sends the head of an HTTP request may not connect; empty: it may.

    Parameters
    ----------
    head : bytes
    hosts : collection of str
        Further names: of this machine, and of where pages of viewers are from.

    Examples
    --------
    >>> refusal(b"GET / HTTP/1.1\r\nHost: 127.0.0.1:8765\r\n\r\n")
    ''
    """
    known = _KNOWN | {host.lower() for host in hosts}
    try:
        _, _, fields = head.partition(b"\r\n")
        headers = http.client.parse_headers(io.BytesIO(fields))
        (asked,) = headers.get_all("Host", [])
        origins = headers.get_all("Origin", [])
        host = urlsplit(f"//{asked}").hostname or ""
        if host not in known and _number(host) is None:
            return f"Host {asked!r}: expected the number of an address, or a known name"
        for origin in origins:
            page = urlsplit(origin)
            number = _number(page.hostname or "")
            is_here = page.scheme == "file" or (number is not None and number.is_loopback)
            if not is_here and page.hostname not in known:
                return f"Origin {origin!r}: expected a viewer of this machine, or of a known host"
    except (ValueError, http.client.HTTPException):
        return "expected the request of a viewer, with one Host"
    return ""


def _number(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


@final
class Gate:
    """Passes viewers on to a server, in a thread of its own.

    Parameters
    ----------
    host : str
    port : int
        0: any free one.
    hosts : collection of str
        See :func:`refusal`.

    Raises
    ------
    UsageError
        If the port is invalid, or the address cannot be used.
    """

    def __init__(self, host: str, port: int, hosts: Collection[str] = ()) -> None:
        if not 0 <= port <= _LARGEST_PORT:
            raise UsageError(f"{option('port')}: expected 0 to {_LARGEST_PORT}, got {port}")
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            is_6 = family == socket.AF_INET6
            is_both = is_6 and socket.has_dualstack_ipv6()
            self._listener = socket.create_server(address, family=family, dualstack_ipv6=is_both)
        except (OSError, ValueError) as error:  # names that are none are ValueErrors
            reason = (getattr(error, "strerror", None) or str(error)).partition(" (while")[0]
            raise UsageError(
                f"{option('port')}: cannot listen on {host}:{port}: {reason}; choose another "
                "port, or 0 for any free one"
            ) from error
        number, port = self._listener.getsockname()[:2]
        self.url = f"ws://[{number}]:{port}" if is_6 else f"ws://{number}:{port}"
        self._hosts = (host, *hosts)
        self._way_out = f"; {option('allow_host')} names further hosts"  # as this thread says it
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_open(self) -> bool:
        """Whether viewers are passed on."""
        return self._thread is not None

    def open(self, server: tuple[str, int]) -> None:
        """Pass viewers on to the address of a server."""
        self._server = server
        self._thread = threading.Thread(target=self._run, name="viewers", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disconnect everybody, and give the address back."""
        if self._thread is None:
            self._loop.close()
        else:
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(PATIENCE)
        self._listener.close()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._admit, sock=self._listener, limit=_MOST_BYTES)
        await self._closing.wait()
        server.close()  # connections are cancelled with the loop

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass a viewer on, or say why not; who is no viewer is left alone after a second."""
        with suppress(OSError, asyncio.CancelledError), closing(writer):
            try:
                async with asyncio.timeout(PATIENCE):
                    head = await reader.readuntil(b"\r\n\r\n")
            except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
                return
            reason = refusal(head, self._hosts)
            if reason:
                writer.write(_forbidden(f"cosim: {reason}{self._way_out}\n"))
                return
            there, onwards = await asyncio.open_connection(*self._server, limit=_MOST_BYTES)
            with closing(onwards):
                onwards.write(head)
                ways = [_pass(reader, onwards), _pass(there, writer)]
                tasks = [asyncio.ensure_future(way) for way in ways]
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in tasks:
                    task.cancel()


async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Pass bytes on until there are no more."""
    with suppress(OSError):
        while data := await reader.read(_MOST_BYTES):
            writer.write(data)
            await writer.drain()


def _forbidden(reason: str) -> bytes:
    text = reason.encode()
    head = f"HTTP/1.1 403 Forbidden\r\nContent-Length: {len(text)}\r\nConnection: close\r\n\r\n"
    return head.encode() + text
