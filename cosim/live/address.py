"""The address of a server, reserved until the server listens on it.

So an address that cannot be used is refused at once, and port 0 becomes a number before
viewers can connect.
"""

from __future__ import annotations

import socket
import sys
from typing import Any, Final, final

from cosim.errors import UsageError, option

_LARGEST_PORT: Final = 2**16 - 1


@final
class ReservedAddress:
    """A socket that is bound to an address, but does not listen.

    Parameters
    ----------
    host : str
    port : int
        0: any free one.

    Raises
    ------
    UsageError
        If the port is invalid, or the address cannot be used.
    """

    def __init__(self, host: str, port: int) -> None:
        if not 0 <= port <= _LARGEST_PORT:
            raise UsageError(f"{option('port')}: expected 0 to {_LARGEST_PORT}, got {port}")
        self._host = host
        self._port = port
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            family, kind, protocol, _, address = found[0]
            self.socket = socket.socket(family, kind, protocol)
            try:
                _bind(self.socket, address)
            except BaseException:
                self.socket.close()
                raise
        except (OSError, ValueError) as error:  # names that are none are ValueErrors
            reason = getattr(error, "strerror", None) or str(error)
            raise self.refusal(reason) from error
        number, self.port = self.socket.getsockname()[:2]
        self.host = f"[{number}]" if family == socket.AF_INET6 else number

    def release(self) -> None:
        """Give the address back."""
        self.socket.close()

    def refusal(self, reason: str) -> UsageError:
        """Return the error of an address that cannot be used."""
        return UsageError(
            f"{option('port')}: cannot listen on {self._host}:{self._port}: {reason}; choose "
            "another port, or 0 for any free one"
        )


def _bind(unbound: socket.socket, address: Any) -> None:
    """Bind a socket as a server does: connections that have just ended keep nobody away."""
    if sys.platform != "win32":
        unbound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    unbound.bind(address)
