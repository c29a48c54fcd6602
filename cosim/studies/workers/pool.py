"""Run the members of a study in guarded workers.

::

    give each worker the members of the next quarter of a second, at least one
    until every member has its outcome:
        wait until a worker replies, ends, or exceeds its time
        replace one that is lost: its first member failed, the others go to the next worker
        give members
        yield members with their outcomes

A worker runs its members in the order in which it was given them and hands over each outcome before
it begins the next, so the one that it is lost with is the first of those that it has. Members wait
in the pipe of a worker, so that it does not wait for this process; those that take long are given
one at a time, so that at the end no worker has two while another has none.

What a crash destroys may be the work of an earlier member of that worker. So a member with which a
worker crashes is run once more, as the first of a new worker; it failed only if that crashes, too.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from selectors import EVENT_READ, EVENT_WRITE, DefaultSelector
from time import monotonic
from types import TracebackType
from typing import Final, Self, final

from cosim.errors import ChangedFileError, CosimError, RunError, UsageError, option, quoted
from cosim.interrupts import uninterrupted
from cosim.studies.contracts import (
    COMPLETE,
    FAILED,
    HANGS,
    MemberOutcome,
    MemberResult,
    StudyMember,
    StudySubject,
)
from cosim.studies.workers.member_times import MemberTimes
from cosim.studies.workers.messages import (
    WorkerOpening,
    WorkerReady,
    WorkerRefusal,
    encode_opening,
)
from cosim.studies.workers.remaining_members import RemainingMembers
from cosim.studies.workers.worker_process import MemberAnswer, WorkerProcess
from cosim.temporary import TemporaryFolder

OPENING_LIMIT: Final = 300.0  # [s] to open a runner; models may be compiled
OPENINGS: Final = 3  # in a row that are lost: the next will be, too
ENDING_LIMIT: Final = 2.0  # [s] to free what was loaded
LOOK: Final = 0.25  # [s] between looks for workers that hang, or left their pipe to another


@final
class WorkerPool:
    """Child processes that run members of one study; a context manager that ends them.

    A member that crashes, hangs or ends its process is an outcome that says so; its worker is
    replaced, and no other member is lost. What members print is discarded. Each worker leads a
    session of its own, keeps temporary files in a folder of the pool, and ends with this process,
    however that ends; on Linux with the thread that started it, so that a pool belongs to one
    thread.

    Parameters
    ----------
    opener : str
        ``module:function``: called in each worker with the subject, it returns a MemberRunner.
    subject : StudySubject
    count : int
        Workers at a time.
    timeout : float or None
        Wall time that a member may take [s]; None: 10 times the longest of the first ten that were
        completed, at least 60 s.
    members_per_worker : int or None
        After so many a worker is replaced: a process grows with an FMU that leaves memory behind.
        None: never.

    Raises
    ------
    UsageError
        If a number is not positive, or this is Windows.
    """

    def __init__(
        self,
        opener: str,
        subject: StudySubject,
        count: int,
        *,
        timeout: float | None = None,
        members_per_worker: int | None = None,
    ) -> None:
        _check_platform()
        _check_positive("workers", count)
        _check_positive("timeout", timeout)
        _check_positive("members_per_worker", members_per_worker)
        self._most_members = members_per_worker or sys.maxsize
        import_paths = list(map(str, sys.path))
        opening = WorkerOpening(opener, subject, import_paths, self._most_members)
        self._opening = encode_opening(opening)
        self._scenario = subject.scenario
        self._count = count
        self._times = MemberTimes(timeout)
        self._refusal: CosimError | None = None
        self._lost_openings = 0  # in a row
        self._next_look = 0.0
        self._workers: dict[int, WorkerProcess] = {}  # by the pipe from them
        self._full: set[int] = set()  # the pipes to workers that are
        self._selector = DefaultSelector()
        self._folder: TemporaryFolder | None = None

    def __enter__(self) -> Self:
        self._folder = TemporaryFolder("workers")
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error_type is None:
                self._let_end()
        finally:
            with uninterrupted():
                for worker in list(self._workers.values()):
                    self._end(worker)
                self._selector.close()
                if self._folder is not None:
                    self._folder.remove()

    def run(self, members: Iterable[StudyMember]) -> Iterator[MemberResult]:
        """Yield members with their outcomes, as they come.

        Members are taken as workers need them. Where the iterator is closed before its end, members
        that were begun are lost.

        Raises
        ------
        UsageError
            If a worker refuses the subject: a scenario with an error.
        ChangedFileError
            If a member reads another file than the study began with.
        RunError
            If workers are lost one after the other while they open their runner.
        """
        self._refusal = None
        self._lost_openings = 0
        remaining = RemainingMembers(members)
        try:
            self._give(remaining)
            while not remaining.is_empty or any(worker.queue for worker in self._workers.values()):
                results = self._wait(remaining)
                if self._refusal is None:
                    self._give(remaining)  # first, as others take their time with the results
                yield from results
                if self._refusal is not None:
                    raise self._refusal
        finally:
            for worker in list(self._workers.values()):
                if worker.queue:
                    self._end(worker)

    def _give(self, remaining: RemainingMembers) -> None:
        """Hand members to workers, and start those that are missing."""
        for worker in self._workers.values():
            self._fill(worker, remaining)
        while len(self._workers) < self._count:
            first = remaining.take_first()
            if not first:
                return
            worker = self._start()
            worker.give(first)
            self._watch(worker)

    def _fill(self, worker: WorkerProcess, remaining: RemainingMembers) -> None:
        """Hand members to a worker if half of those that it should have are done."""
        ahead = self._times.ahead
        if worker.is_last or worker.is_full or 2 * len(worker.queue) > ahead:
            return
        wanted = min(ahead - len(worker.queue), self._most_members - worker.given)
        members = remaining.take(wanted)
        if members:
            worker.give(members)
            self._watch(worker)

    def _start(self) -> WorkerProcess:
        assert self._folder is not None, "a pool runs members within its 'with' block"
        with uninterrupted():
            worker = WorkerProcess(self._opening, self._folder.path)
            self._workers[worker.replies] = worker
            self._selector.register(worker.replies, EVENT_READ, worker)
        return worker

    def _watch(self, worker: WorkerProcess) -> None:
        """Wait for room in the pipe to a worker as long as that is full."""
        if worker.is_full and worker.members not in self._full:
            self._full.add(worker.members)
            self._selector.register(worker.members, EVENT_WRITE, worker)
        elif not worker.is_full and worker.members in self._full:
            self._full.remove(worker.members)
            self._selector.unregister(worker.members)

    def _wait(self, remaining: RemainingMembers) -> list[MemberResult]:
        """Wait until something happens to a worker; return the results that came with it."""
        results: list[MemberResult] = []
        silent = dict(self._workers)
        for key, _ in self._selector.select(LOOK):
            worker: WorkerProcess = key.data
            silent.pop(worker.replies, None)
            if key.fd == worker.replies:
                results += self._receive(worker, remaining)
            elif worker.replies in self._workers:
                worker.write_rest()
                self._watch(worker)
        # The others have nothing to say, though this process may come late to ask them.
        if monotonic() >= self._next_look:
            for worker in silent.values():
                results += self._look_at(worker, remaining)
            self._next_look = monotonic() + LOOK
        return results

    def _receive(self, worker: WorkerProcess, remaining: RemainingMembers) -> list[MemberResult]:
        """Take the replies of a worker; return results, also of a member that it is lost with."""
        results: list[MemberResult] = []
        replies, is_open = worker.receive()
        for reply in replies:
            match reply:
                case WorkerReady():
                    self._lost_openings = 0
                case WorkerRefusal():
                    self._refusal = self._refused(reply)
                    return results
                case MemberAnswer():
                    results.append((reply.member, reply.outcome))
                    is_complete = reply.outcome.status == COMPLETE
                    self._times.note(reply.seconds, is_complete=is_complete)
        if worker.is_last:
            remaining.give_back(worker.take_back())
        if not is_open:
            results += self._replace(worker, worker.wait_for_end(), remaining)
        return results

    def _look_at(self, worker: WorkerProcess, remaining: RemainingMembers) -> list[MemberResult]:
        """Replace a silent worker that hangs or has ended; return the result of its member."""
        if worker.has_ended():
            return self._replace(worker, worker.wait_for_end(), remaining)
        limit = self._time_limit(worker)
        if monotonic() - worker.since < limit:
            return []
        reason = f"{HANGS}did not end within {limit:g} s"
        if not worker.is_ready:
            self._refusal = RunError(f"the process that opens {quoted(self._scenario)} {reason}")
            return []
        if not worker.is_last:
            reason = f"{reason}{self._times.origin}"
        return self._replace(worker, reason, remaining, hangs=True)

    def _time_limit(self, worker: WorkerProcess) -> float:
        """Return how long a worker may take for what it does now [s]."""
        if not worker.is_ready:
            return OPENING_LIMIT
        if worker.is_last:
            return ENDING_LIMIT
        return self._times.limit if worker.queue else math.inf

    def _replace(
        self,
        worker: WorkerProcess,
        reason: str,
        remaining: RemainingMembers,
        *,
        hangs: bool = False,
    ) -> list[MemberResult]:
        """End a worker that is lost, so that another is started; return the result of its member.

        There is none where it ran no member, or where others may be the cause.
        """
        wall_time = monotonic() - worker.since
        self._end(worker)
        members = worker.take_back()
        if not worker.is_ready:
            remaining.give_back(members)
            self._count_opening(reason)
            return []
        if not members:
            return []
        member, *others = members
        remaining.give_back(others)
        if worker.answered and not hangs:
            remaining.retry(member)
            return []
        outcome = MemberOutcome(
            member.number, FAILED, reason=reason, wall_time=wall_time, worker=worker.name
        )
        return [(member, outcome)]

    def _count_opening(self, reason: str) -> None:
        """Refuse to go on where the last ones were lost while they opened their runner."""
        self._lost_openings += 1
        if self._lost_openings >= OPENINGS:
            self._refusal = RunError(
                f"the process that opens {quoted(self._scenario)} {reason}, {OPENINGS} times in a "
                "row; run 'cosim check' on its FMUs"
            )

    def _refused(self, refusal: WorkerRefusal) -> CosimError:
        """Return the error with which a worker refuses to go on."""
        if refusal.has_changed:
            return ChangedFileError(refusal.text)
        if refusal.exit_code == UsageError.exit_code:
            return UsageError(refusal.text)
        return RunError(f"{quoted(self._scenario)} cannot be opened: {refusal.text}")

    def _let_end(self) -> None:
        """End idle workers: they free what they hold, and end by themselves."""
        for worker in list(self._workers.values()):
            if worker.queue or not worker.is_ready:
                self._end(worker)
            elif not worker.is_last:
                worker.let_end()
        limit = monotonic() + ENDING_LIMIT
        while self._workers and monotonic() < limit:
            for key, _ in self._selector.select(LOOK):
                _, is_open = key.data.receive()
                if not is_open:
                    self._end(key.data)

    def _end(self, worker: WorkerProcess) -> None:
        """End a worker and what it started."""
        del self._workers[worker.replies]
        self._selector.unregister(worker.replies)
        if worker.members in self._full:
            self._full.remove(worker.members)
            self._selector.unregister(worker.members)
        worker.end()


def _check_platform() -> None:
    if sys.platform == "win32":
        raise UsageError(
            "a study runs its members in processes that it can end together with their children; "
            "expected Linux or macOS, got Windows"
        )


def _check_positive(name: str, value: float | None) -> None:
    if value is not None and not value > 0:
        raise UsageError(f"{option(name)}: expected a positive number, got {value!r}")
