"""The connection to a scheduler of dask."""

import gc
import signal
import socket
import threading

import pytest

from cosim.errors import UsageError
from cosim.studies.cluster import connection
from cosim.studies.cluster.connection import connect

pytestmark = pytest.mark.slow


@pytest.fixture
def clients(monkeypatch):
    """Return the clients that were left; none of them is collected meanwhile."""
    monkeypatch.setattr(connection, "CONNECTING", 0.1)
    gc.collect()
    gc.disable()
    before = set(map(id, _clients()))
    yield lambda: [client for client in _clients() if id(client) not in before]
    gc.enable()


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "nowhere", "tls://127.0.0.1:1", "x://y:1"]
)
def test_a_scheduler_that_is_not_there_is_one_error(address, clients):
    """No finalizer is left with a client to close: it would wait for a lock of the next one."""
    with (
        pytest.raises(
            UsageError,
            match=r"cannot connect to a dask scheduler at '.*' \(.*\); expected the addr",
        ),
        connect(address),
    ):
        pass
    assert [client.status for client in clients()] == ["closed"]


def test_a_client_that_is_interrupted_while_it_connects_is_closed(clients):
    """As one that did not connect."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        main = threading.main_thread().ident
        accepted = []

        def interrupt():
            accepted.append(server.accept())
            signal.pthread_kill(main, signal.SIGINT)

        thread = threading.Thread(target=interrupt, daemon=True)
        thread.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(KeyboardInterrupt), connect(address):
            pass
        thread.join()
        accepted[0][0].close()
    assert [client.status for client in clients()] == ["closed"]


def _clients():
    from distributed import Client

    return [one for one in gc.get_objects() if isinstance(one, Client)]
