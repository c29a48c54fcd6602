"""The connection to a scheduler of dask."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from cosim.errors import RunError, UsageError, option, quoted
from cosim.filters import ignored_warnings

if TYPE_CHECKING:
    from distributed import Client

CONNECTING: Final = 5.0  # [s]


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
                f"{option('scheduler')}: found a client that is "
                f"{'asynchronous' if scheduler.asynchronous else scheduler.status}, needed one "
                "that is connected and synchronous, as distributed.Client(address) is"
            )
        yield scheduler
        return
    with _new_client(library, scheduler) as client:
        yield client


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


def lost(client: Client) -> RunError:
    """Return the error of a scheduler that has gone."""
    address = client.scheduler.address if client.scheduler is not None else "the scheduler"
    return RunError(
        f"the connection to {address} was lost; what came until then is in the dataset, and the "
        "same study goes on from there"
    )


def _new_client(library: Any, address: str) -> Client:
    try:
        # what differs is checked, and named, for each worker
        with ignored_warnings(r"\s*Mismatched versions"):
            client: Client = library.Client(address, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{option('scheduler')}: there is no scheduler of dask at {quoted(address)}; needed "
            "the address that 'dask scheduler' prints, such as tcp://host:8786"
        ) from error
    return client
