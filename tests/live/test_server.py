"""A server inside its ``with`` block, and outside; its address."""

from __future__ import annotations

import socket
import sys

import pytest

from cosim.core.recorders import Memory
from cosim.errors import UsageError
from cosim.live import LiveServer
from tests.live.viewer import Viewer


def refusal(host, port):
    """Return the text of the refusal of an address."""
    with pytest.raises(UsageError) as refused:
        LiveServer(host=host, port=port).__enter__()
    return str(refused.value)


def test_a_missing_sdk_is_one_clear_error(monkeypatch):
    """It names the extra."""
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(UsageError, match=r"foxglove-sdk, .* pip install 'cosim\[live\]'"):
        LiveServer(port=0).__enter__()


def test_a_server_works_inside_its_with_block_only(collecting):
    """Outside nothing listens."""
    server = collecting()
    with pytest.raises(UsageError, match="has no address"):
        _ = server.url
    with server:
        assert server.url.startswith("ws://127.0.0.1:")
        server.listen()
    for use in (lambda: server.beside(Memory(), {}), server.wait_for_viewer):
        with pytest.raises(UsageError, match="has no address"):
            use()
    with server:  # another one
        server.beside(Memory(), {})


@pytest.mark.usefixtures("collecting")
def test_the_address_is_told_when_viewers_can_connect():
    """Not before the topics are there."""
    told = []
    with LiveServer(port=0, notice=told.append) as server:
        assert told == []
        server.listen()
        assert told == [server.url]


def test_a_server_shows_one_thing(collector):
    """Its topics are those of the first."""
    collector.beside(Memory(), {})
    collector.listen()
    with pytest.raises(UsageError, match="already"):
        collector.beside(Memory(), {})


@pytest.mark.usefixtures("collecting")
def test_wrong_addresses_are_refused():
    """TCP has 65535 ports, a label of a name 63 characters; 192.0.2.1 is nobody's (RFC 5737)."""
    for port in (-1, 65536, 10**30):
        assert refusal("127.0.0.1", port) == f"port: expected 0 to 65535, got {port}"
    assert "cannot listen on 192.0.2.1:0: Cannot assign" in refusal("192.0.2.1", 0)
    assert "cannot listen on " in refusal("a" * 70 + ".b", 0)


@pytest.mark.usefixtures("collecting")
def test_an_address_is_taken_from_the_first_line_of_the_block_to_the_last():
    """By one server; whoever comes second is told of the way out."""
    with LiveServer(port=0) as first, LiveServer(port=0) as second:
        assert first.url != second.url
        port = int(first.url.rpartition(":")[2])
        text = refusal("127.0.0.1", port)
        first.listen()
    assert text.startswith(f"port: cannot listen on 127.0.0.1:{port}: Address already in use; ")
    assert "0 for any free" in text
    with LiveServer(port=port) as again:
        assert again.url == f"ws://127.0.0.1:{port}"


@pytest.mark.slow
def test_viewers_connect_by_ip_version_6():
    """Where the machine has it."""
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no loopback of IPv6 here")
    with LiveServer(host="::1", port=0) as server:
        server.listen()
        assert server.url.startswith("ws://[::1]:")
        with Viewer(server.url) as viewer:
            assert viewer.info["name"] == "cosim"
