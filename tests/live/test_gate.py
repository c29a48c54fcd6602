"""Who may connect to a server for viewers, and for how long nobody keeps it."""

from __future__ import annotations

import socket
import time

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from cosim.live import LiveServer
from cosim.live.gate import refusal
from tests.live.viewer import SUBPROTOCOL, Viewer


def head(*fields):
    """Return the head of a request."""
    return "\r\n".join(["GET / HTTP/1.1", *fields, "", ""]).encode()


@pytest.mark.parametrize(
    "fields",
    [
        ["Host: 127.0.0.1:8765"],  # a program says no Origin
        ["Host: [::1]:8765", "Origin: http://localhost:8080"],
        ["Host: localhost", "Origin: file://"],
        ["Host: LocalHost:1", "Origin: https://app.foxglove.dev"],
        ["Host: 192.168.0.7:8765", "Origin: http://127.0.0.1"],
        ["Host: rig.example:8765", "Origin: https://viewer.example"],
    ],
)
def test_programs_pages_of_this_machine_and_of_known_hosts_may_connect(fields):
    """Any number may be asked for: a name that was made an alias of this machine is no number."""
    assert refusal(head(*fields), ["viewer.example", "Rig.example"]) == ""


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        (["Host: 127.0.0.1:8765", "Origin: https://evil.example"], "https://evil.example"),
        (["Host: 127.0.0.1:8765", "Origin: null"], "null"),  # a page may hide where it is from
        (["Host: 127.0.0.1", "Origin: http://203.0.113.5"], "203.0.113.5"),
        (["Host: 127.0.0.1", "Origin: https://app.foxglove.dev.evil.example"], "evil"),
        (["Host: 127.0.0.1", "Origin: https://app.foxglove.dev@evil.example"], "evil"),
        (["Host: 127.0.0.1", "Origin: http://localhost", "Origin: http://evil.example"], "evil"),
        (["Host: evil.example:8765"], "evil.example:8765"),  # DNS rebinding
        (["Host: 127.0.0.1.evil.example"], "evil.example"),
        (["Host: localhost", "Host: evil.example"], "one Host"),
        ([], "one Host"),
        (["Host: [::1"], "one Host"),
    ],
)
def test_pages_of_other_hosts_and_unknown_names_are_refused(fields, named):
    """With what they said."""
    assert named in refusal(head(*fields), ["viewer.example"])


@pytest.mark.slow
def test_a_page_of_another_host_gets_the_way_out_in_place_of_a_connection(server):
    """One that is named connects."""
    server.listen()
    with pytest.raises(InvalidStatus, match="403") as refused:
        connect(server.url, origin="https://viewer.example", proxy=None)
    assert b"allow_host names further hosts" in refused.value.response.body
    with LiveServer(port=0, allow_host=["viewer.example"]) as other:
        other.listen()
        protocols = [SUBPROTOCOL]
        origin = "https://viewer.example"
        with connect(other.url, origin=origin, subprotocols=protocols, proxy=None) as viewer:
            assert "serverInfo" in viewer.recv(timeout=10)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n", None])
def test_a_connection_without_a_handshake_keeps_no_server_from_ending(sent):
    """Nothing sent, half a request, or a handshake and no answer to anything after it."""
    with LiveServer(port=0) as server:
        server.listen()
        port = int(server.url.rpartition(":")[2])
        mute = socket.create_connection(("127.0.0.1", port))
        if sent is None:
            mute.sendall(
                head(
                    f"Host: 127.0.0.1:{port}",
                    "Connection: Upgrade",
                    "Upgrade: websocket",
                    "Sec-WebSocket-Version: 13",
                    "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==",
                    f"Sec-WebSocket-Protocol: {SUBPROTOCOL}",
                )
            )
            assert b"101 Switching" in mute.recv(12 + 2**16)
        else:
            mute.sendall(sent)
        with Viewer(server.url) as viewer:
            assert viewer.info["name"] == "cosim"
        begun = time.monotonic()
    assert time.monotonic() - begun < 3.0
    mute.close()
    with socket.socket() as again:  # the address is free
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", port))
