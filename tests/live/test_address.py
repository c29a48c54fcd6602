"""What a server listens on, and what it says where it cannot."""

from __future__ import annotations

import socket

import pytest

from cosim.errors import UsageError
from cosim.live.address import ReservedAddress


def refusal(host, port):
    """Return the text of the refusal of an address."""
    with pytest.raises(UsageError) as refused:
        ReservedAddress(host, port).release()
    return str(refused.value)


def test_any_free_port_is_found():
    """Two of them beside each other."""
    first = ReservedAddress("127.0.0.1", 0)
    second = ReservedAddress("127.0.0.1", 0)
    assert first.port != second.port
    assert first.host == second.host == "127.0.0.1"
    first.release()
    second.release()


def test_a_port_in_use_is_one_clear_error():
    """Whoever uses it; the way out is another port."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        text = refusal("127.0.0.1", port)
    assert text.startswith(f"port: cannot listen on 127.0.0.1:{port}: Address already in use; ")
    assert "0 for any free" in text


def test_wrong_addresses_are_refused():
    """TCP has 65535 ports, a label of a name 63 characters; 192.0.2.1 is nobody's (RFC 5737)."""
    for port in (-1, 65536, 10**30):
        assert refusal("127.0.0.1", port) == f"port: expected 0 to 65535, got {port}"
    assert "cannot listen on 192.0.2.1:0: Cannot assign" in refusal("192.0.2.1", 0)
    assert "cannot listen on " in refusal("a" * 70 + ".b", 0)


def test_an_address_of_ip_version_6_has_brackets():
    """As addresses of the web write it."""
    try:
        address = ReservedAddress("::1", 0)
    except UsageError:
        pytest.skip("no loopback of IPv6 here")
    assert address.host == "[::1]"
    address.release()
