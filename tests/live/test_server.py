"""A server inside its ``with`` block, and outside."""

from __future__ import annotations

import socket
import sys

import pytest

from cosim.core.recorders import Memory
from cosim.errors import UsageError
from cosim.live import LiveServer
from tests.live.viewer import Viewer


def test_a_missing_sdk_is_one_clear_error(monkeypatch):
    """It names the extra."""
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(UsageError, match=r"foxglove-sdk, .* pip install 'cosim\[live\]'"):
        LiveServer(port=0).__enter__()


@pytest.mark.usefixtures("collecting")
def test_a_server_works_inside_its_with_block_only():
    """Outside nothing listens."""
    server = LiveServer(port=0)
    with pytest.raises(UsageError, match="has no address"):
        _ = server.url
    with server:
        assert server.url
    with pytest.raises(UsageError, match="has no address"):
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


@pytest.mark.slow
def test_viewers_connect_to_the_address_that_is_told():
    """Two servers of one process beside each other."""
    with LiveServer(port=0) as first, LiveServer(port=0) as second:
        assert first.url != second.url
        assert first.url.startswith("ws://127.0.0.1:")
        first.listen()
        with Viewer(first.url) as viewer:
            assert viewer.info["name"] == "cosim"


@pytest.mark.slow
def test_viewers_connect_by_ip_version_6():
    """Where the machine has it."""
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_port_that_was_taken_meanwhile_is_the_same_error():
    """Between the question and the answer, another may listen there."""
    with LiveServer(port=0) as server:
        port = int(server.url.rpartition(":")[2])
        with socket.socket() as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            other.bind(("127.0.0.1", port))
            other.listen()
            with pytest.raises(UsageError, match=r"cannot listen on .*Address already in"):
                server.listen()
