"""What a server listens on, and what it says where it cannot."""

from __future__ import annotations

import socket
import sys

import pytest

from cosim.core.recorders import Memory
from cosim.errors import UsageError
from cosim.live import LiveServer

from .viewer import Viewer


def test_any_free_port_is_found():
    """Two servers of one process beside each other; viewers connect to what ``url`` says."""
    with LiveServer(port=0) as first, LiveServer(port=0) as second:
        assert first.url != second.url
        assert first.url.startswith("ws://127.0.0.1:")
        first.listen()
        with Viewer(first.url) as viewer:
            assert viewer.info["name"] == "cosim"


def test_a_port_in_use_is_one_clear_error():
    """Whoever uses it."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        text = (
            rf"^port: 127\.0\.0\.1:{port} cannot be listened on: Address already in use; choose "
            "another port, or 0 for any free one$"
        )
        with pytest.raises(UsageError, match=text), LiveServer(port=port):
            pass


@pytest.mark.parametrize("port", [-1, 65536, 10**30])
def test_a_port_that_is_none_is_refused(port):
    """TCP has 65535."""
    with pytest.raises(UsageError, match=f"port: found {port}; needed 0 to 65535"):
        LiveServer(port=port).__enter__()


def test_an_address_of_another_machine_is_refused():
    """192.0.2.1 is reserved for documentation (RFC 5737)."""
    with pytest.raises(UsageError, match=r"192\.0\.2\.1:0 cannot be listened on: Cannot assign"):
        LiveServer(host="192.0.2.1", port=0).__enter__()


def test_a_missing_sdk_is_one_clear_error(monkeypatch):
    """It names the extra."""
    monkeypatch.setitem(sys.modules, "foxglove", None)
    text = r"viewers need foxglove-sdk, which is not installed: pip install 'cosim\[live\]'"
    with pytest.raises(UsageError, match=text):
        LiveServer(port=0).__enter__()


def test_a_server_works_inside_its_with_block_only():
    """Outside nothing listens."""
    server = LiveServer(port=0)
    with pytest.raises(UsageError, match="has no address; use it inside its 'with' block"):
        _ = server.url
    with server:
        assert server.url
    with pytest.raises(UsageError, match="has no address"):
        server.beside(Memory(), {})


def test_the_port_is_free_again_behind_the_block():
    """Viewers are disconnected."""
    with LiveServer(port=0) as server:
        url = server.url
        server.listen()
        with Viewer(url):
            pass
    port = int(url.rpartition(":")[2])
    with LiveServer(port=port) as again:
        again.listen()
        assert again.url == url


def test_an_address_of_ip_version_6_has_brackets():
    """As addresses of the web write it."""
    try:
        server = LiveServer(host="::1", port=0).__enter__()
    except UsageError:
        pytest.skip("no loopback of IPv6 here")
    try:
        server.listen()
        assert server.url.startswith("ws://[::1]:")
        with Viewer(server.url) as viewer:
            assert viewer.info["name"] == "cosim"
    finally:
        server.__exit__(None, None, None)


def test_what_viewers_connect_to_is_told_when_they_can():
    """Not before the topics are there."""
    told = []
    with LiveServer(port=0, notice=told.append) as server:
        assert told == []
        server.listen()
        assert told == [server.url]


def test_a_port_that_was_taken_meanwhile_is_the_same_error():
    """Between the question and the answer, another may listen there."""
    with LiveServer(port=0) as server:
        port = int(server.url.rpartition(":")[2])
        with socket.socket() as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            other.bind(("127.0.0.1", port))
            other.listen()
            with pytest.raises(UsageError, match=r"cannot be listened on: .*Address already in"):
                server.listen()


def test_a_name_that_is_none_is_refused():
    """A label of a name has 63 characters at most."""
    with pytest.raises(UsageError, match="cannot be listened on: "):
        LiveServer(host="a" * 70 + ".b", port=0).__enter__()


def test_a_server_shows_one_thing():
    """Its topics are those of the first."""
    with LiveServer(port=0) as server:
        server.beside(Memory(), {})
        server.listen()
        with pytest.raises(UsageError, match="has shown something already; needed another one"):
            server.beside(Memory(), {})
