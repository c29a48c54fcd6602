"""The admission of a worker: it is checked, gets the files that it lacks, and opens the study.

::

    what the worker computes with must be what this process does
    its platform must have a binary in every FMU
    send it the contents that it has nowhere, each once
    open the study there, and build its first member

All of it is done in the event loop of the client, for any number of workers at a time, while the
others run members.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, final

from cosim.errors import CosimError, UsageError, listing
from cosim.studies.cluster.cluster_study import ClusterStudy
from cosim.studies.cluster.environment import (
    binary_folders,
    describe_environment,
    lacks,
    without_binary,
)
from cosim.studies.cluster.member_executor import MemberExecutor
from cosim.studies.cluster.worker_functions import (
    close_study,
    describe_worker,
    open_study,
    store_file,
)

if TYPE_CHECKING:
    from distributed import Client

MOST_RELAYED: Final = 100_000_000  # [bytes] of a file that passes through the scheduler
CONNECTING: Final = 2.0  # [s] to a worker
SENDING: Final = 4  # workers that are sent files at a time: each file is in memory meanwhile


@dataclass(frozen=True, slots=True)
class Admitted:
    """What came of the admission of a worker.

    Parameters
    ----------
    problem : str
        Why the worker is excluded; empty: it is not.
    writes : bool
        It writes the dataset.
    """

    problem: str
    writes: bool = False


@final
class Admission:
    """Admits workers to one study.

    Parameters
    ----------
    client : Client
    study : ClusterStudy
    """

    def __init__(self, client: Client, study: ClusterStudy) -> None:
        self._client = client
        self._study = study
        self._own = describe_environment()
        self._folders = binary_folders(study.files)
        self._sending = asyncio.Semaphore(SENDING)
        self._lock = Lock()
        self._own_problem: str | None = None

    def submit(self, address: str) -> Future[Admitted]:
        """Begin with a worker; the future raises nothing of its own."""
        loop = self._client.loop.asyncio_loop
        return asyncio.run_coroutine_threadsafe(self._admit(address), loop)

    async def _admit(self, address: str) -> Admitted:
        try:
            return await self._admitted(address)
        except Exception as error:  # whatever a worker of another version raises
            text = (
                str(error) if isinstance(error, CosimError) else f"{type(error).__name__}: {error}"
            )
            return Admitted(text)

    async def _admitted(self, address: str) -> Admitted:
        found = await self._run(describe_worker, self._study.files, worker=address)
        problem = self._unfit(found["environment"])
        if problem:
            return Admitted(problem)
        for digest in found["missing"]:
            async with self._sending:
                await self._send(address, digest)
        answer = await self._run(open_study, self._study.to_dict(), worker=address)
        problem = answer["problem"]
        if problem and problem != await asyncio.to_thread(self._problem_here):
            await self._run(close_study, self._study.name, worker=address)
            return Admitted(problem)
        return Admitted("", answer["writes"])

    async def _run(self, function: Callable[..., Any], *values: Any, worker: str) -> Any:
        """Return what a worker answers.

        Raises
        ------
        Exception
            As the function did there.
        """
        answers = await self._client.run(function, *values, workers=[worker], asynchronous=True)
        return answers[worker]

    def _unfit(self, found: Mapping[str, str]) -> str:
        """Return why a worker with some environment cannot run the study; empty: it can."""
        reason = lacks(self._own, found)
        if reason:
            return reason
        missing = without_binary(self._folders, found["system"], found["architecture"])
        needed = f"{found['architecture']}-{found['system']}"
        for path, folders in missing.items():
            return f"{Path(path).name} has no binary for {needed}; available: {listing(folders)}"
        return ""

    async def _send(self, address: str, digest: str) -> None:
        """Send a worker the content of a file: directly, or, where it is out of reach, relayed.

        Raises
        ------
        UsageError
            If the file has changed, or is too large to pass through the scheduler.
        """
        path = next(path for path, other in self._study.files.items() if other == digest)
        is_direct = await self._reaches(address)
        size = Path(path).stat().st_size
        if not is_direct and size > MOST_RELAYED:
            raise UsageError(
                f"{path} has {size / 1e6:.0f} MB, and this machine cannot connect to the "
                f"worker directly; through the scheduler at most {MOST_RELAYED / 1e6:.0f} "
                "MB are sent; put a copy of the file at the same path on the worker, for example "
                "on shared storage"
            )
        content = await asyncio.to_thread(_content, path, digest)
        data = await self._client.scatter(
            content, workers=[address], direct=is_direct, hash=False, asynchronous=True
        )
        try:
            await self._run(store_file, data.key, worker=address)
        finally:
            data.release()

    async def _reaches(self, address: str) -> bool:
        """Return whether this process can connect to a worker."""
        from distributed.comm import connect

        try:
            found = await connect(address, timeout=CONNECTING, **self._client.connection_args)
        except (OSError, ValueError):
            return False
        found.abort()
        return True

    def _problem_here(self) -> str:
        """Return what is wrong with the first member where the study is planned."""
        with self._lock:
            if self._own_problem is None:
                self._own_problem = _problem(self._study)
            return self._own_problem


def _problem(study: ClusterStudy) -> str:
    executor = MemberExecutor(study.opener, study.subject, timeout=study.timeout)
    try:
        (outcome,) = executor.submit([study.trial]).result()
    except CosimError as error:
        return str(error)
    finally:
        executor.shutdown()
    return outcome.reason


def _content(path: str, digest: str) -> bytes:
    """Return the content of a file that must not have changed."""
    content = Path(path).read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise UsageError(f"{path} changed while the study ran; run it again")
    return content
