"""The connection to a scheduler of dask.

A client that is left to the collector of garbage is closed by its finalizer: wherever objects
happen to be made, also where the next client is, which then waits for its own lock for ever. So a
client is closed here whatever happens to it, also before it is made.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from cosim.errors import RunError, UsageError, option, quoted, shortened
from cosim.filters import ignored_warnings
from cosim.interrupts import uninterrupted
from cosim.studies.cluster.environment import describe_environment, lacks

if TYPE_CHECKING:
    from distributed import Client

CONNECTING: Final = 5.0  # [s]
CLOSING: Final = 2.0  # [s]


@contextmanager
def connect(scheduler: str | Client) -> Iterator[Client]:
    """Connect to a scheduler; a client that is given is not closed.

    Parameters
    ----------
    scheduler : str or Client
        An address such as ``tcp://host:8786``, or a client that is connected.

    Raises
    ------
    UsageError
        If distributed is not installed, there is no scheduler, or the client is an asynchronous
        one.
    """
    library = distributed()
    if isinstance(scheduler, library.Client):
        if scheduler.asynchronous or scheduler.status != "running":
            raise UsageError(
                f"{option('scheduler')}: expected a connected synchronous client, such as "
                "distributed.Client(address), got one that is "
                f"{'asynchronous' if scheduler.asynchronous else scheduler.status}"
            )
        yield scheduler
        return
    client: Client = object.__new__(library.Client)  # one that can be closed as it is made
    try:
        _open(library, client, scheduler)
        yield client
    finally:
        _close(client)


def distributed() -> Any:
    """Return the library.

    Raises
    ------
    UsageError
        If there is none.
    """
    try:
        return import_module("distributed")
    except ImportError as error:
        raise UsageError(
            "studies on a cluster need dask.distributed, which is not installed: pip install "
            "distributed, or, in a clone of cosim, pip install -e '.[dask]'"
        ) from error


def check_scheduler(client: Client) -> None:
    """Check that a scheduler can read the tasks of this process.

    Raises
    ------
    UsageError
        If it has no cosim, or another one.
    """
    from cosim.studies.cluster.worker_functions import describe_scheduler

    own = describe_environment()
    try:
        found = client.run_on_scheduler(describe_scheduler)
    except OSError as error:
        raise lost(client) from error
    except Exception as error:  # whatever its Python raises, such as an ImportError
        problem = f"{type(error).__name__}: {error}"
    else:
        problem = lacks(own, {**own, **{name: found[name] for name in ("python", "cosim")}})
    if problem:
        raise UsageError(
            f"the scheduler at {_address(client)} cannot read the tasks of a study: {problem}; "
            f"start it with Python {own['python']} and cosim {own['cosim']}"
        )


def lost(client: Client) -> RunError:
    """Return the error of a scheduler that has gone."""
    return RunError(
        f"the connection to {_address(client)} was lost; run the same study again to continue "
        "from its dataset"
    )


def _address(client: Client) -> str:
    return client.scheduler.address if client.scheduler is not None else "the scheduler"


def _open(library: Any, client: Client, address: str) -> None:
    try:
        # what differs is checked, and named, for each worker
        with ignored_warnings(r"\s*Mismatched versions"):
            library.Client.__init__(client, address, timeout=CONNECTING, set_as_default=False)
    except (OSError, TypeError, ValueError) as error:  # TypeError: of TLS without certificates
        cause = shortened(" ".join(f"{type(error).__name__}: {error}".split()))
        raise UsageError(
            f"{option('scheduler')}: cannot connect to a dask scheduler at {quoted(address)} "
            f"({cause}); expected the address printed by 'dask scheduler', such as tcp://host:8786"
        ) from error


def _close(client: Client) -> None:
    """Close a client, also one that is half-made or has lost its scheduler."""
    with uninterrupted():
        with suppress(Exception):  # dask's own: what is not there cannot be closed
            client.close(timeout=CLOSING)
        client.status = "closed"  # its finalizer has nothing to do
