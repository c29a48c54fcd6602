"""An executor of members in a guarded child process, for whichever thread asks.

On Linux a child process ends with the thread that started it, and the threads of dask's workers
come and go. So the pool is used in a thread of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from queue import SimpleQueue
from threading import Event, Thread
from typing import TypeAlias, final

from cosim.errors import CosimError, RunError
from cosim.studies.contracts import MemberOutcome, StudyMember, StudySubject
from cosim.studies.workers.pool import WorkerPool

Outcomes: TypeAlias = list[MemberOutcome]
MemberCall: TypeAlias = tuple[Sequence[StudyMember], "Future[Outcomes]"]


@final
class MemberExecutor:
    """Runs members of one study in a guarded child that stays open between calls.

    Parameters
    ----------
    opener : str
    subject : StudySubject
    timeout : float or None
        As of :class:`WorkerPool`.
    """

    def __init__(self, opener: str, subject: StudySubject, *, timeout: float | None) -> None:
        self._pool = WorkerPool(opener, subject, 1, timeout=timeout)
        self._calls: SimpleQueue[MemberCall | None] = SimpleQueue()
        self._is_shut_down = Event()
        self._thread = Thread(target=self._serve, name="cosim-members", daemon=True)
        self._thread.start()

    def submit(self, members: Sequence[StudyMember]) -> Future[Outcomes]:
        """Schedule members; the future has their outcomes.

        It raises UsageError if the child refuses the study, RunError if the child is lost whenever
        it opens it, or the executor is shut down meanwhile.
        """
        future: Future[Outcomes] = Future()
        if self._is_shut_down.is_set():
            future.set_exception(_shut_down())
        else:
            self._calls.put((members, future))
        return future

    def shutdown(self) -> None:
        """Have the child end after the member that it runs; returns at once."""
        self._is_shut_down.set()
        self._calls.put(None)

    def _serve(self) -> None:
        reason: BaseException = _shut_down()
        try:
            with self._pool as pool:
                while (call := self._calls.get()) is not None:
                    members, future = call
                    if not future.set_running_or_notify_cancel():
                        continue
                    try:
                        future.set_result(self._outcomes(pool, members))
                    except Exception as error:
                        future.set_exception(error)
        except OSError as error:  # no room for the folder of a pool
            reason = error
        self._is_shut_down.set()
        while not self._calls.empty():
            late = self._calls.get()
            if late is not None and late[1].set_running_or_notify_cancel():
                late[1].set_exception(reason)

    def _outcomes(self, pool: WorkerPool, members: Sequence[StudyMember]) -> Outcomes:
        outcomes = []
        for _, outcome in pool.run(members):
            outcomes.append(outcome)
            if self._is_shut_down.is_set() and len(outcomes) < len(members):
                raise _shut_down()
        return outcomes


def _shut_down() -> CosimError:
    return RunError("the study ended while its members were running")
