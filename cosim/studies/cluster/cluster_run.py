"""Run the missing members of a study on a cluster.

::

    until every member has its outcome:
        now and then: begin to admit workers that came; take back the tasks of those that went
        submit tasks to the workers that are admitted, until each thread has two
        take what came into the dataset

A worker is checked, gets the files and opens the study while the others run members.

The scheduler knows the submitted tasks only, however many members there are. A task whose worker
died is given to another by dask. Dask gives up a task with which several workers died
(``distributed.scheduler.allowed-failures``): the others go on, and the error at the end names it.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, final

from cosim.errors import CosimError, RunError, listing
from cosim.interrupts import uninterrupted
from cosim.studies.cluster.cluster_study import ClusterStudy
from cosim.studies.cluster.connection import check_scheduler, connect, distributed, lost
from cosim.studies.cluster.opening import OPENER
from cosim.studies.cluster.planned_members import OutcomeSink, PlannedMembers
from cosim.studies.cluster.tasks import MemberTask, RemainingTasks
from cosim.studies.contracts import MemberOutcome, StudyMember, StudySubject
from cosim.studies.dataset.storage import open_storage
from cosim.studies.dataset import StudyDataset
from cosim.studies.workers.messages import encode_member

if TYPE_CHECKING:
    from distributed import Client, Future

    from cosim.studies.cluster.cluster_workers import ClusterWorkers

TASKS_PER_THREAD: Final = 2  # the one that runs, and the next
LOOK: Final = 1.0  # [s] between looks at the workers
GIVING_UP: Final = 1.0  # [s] that dask may take to give up a task whose workers have gone
FETCHING: Final = 60.0  # [s] for a result; its worker may have died with it
RETRIES: Final = 1  # where a task raises: a full disk of one worker may be


def run_on_cluster(
    scheduler: str | Client,
    subject: StudySubject,
    design: PlannedMembers,
    dataset: StudyDataset,
    place: str,
    *,
    files: Mapping[str, str],
    timeout: float | None = None,
    progress: Callable[[int, int, int], None] | None = None,
    notice: Callable[[str], None] | None = None,
    opener: str = OPENER,
    trial: StudyMember | None = None,
) -> None:
    """Run the members of a study that have no outcome, as tasks of dask.distributed.

    Parameters
    ----------
    scheduler : str or Client
        An address such as ``tcp://host:8786``, or a client that is connected.
    subject : StudySubject
        With absolute paths.
    design : StudyDesign
        With absolute paths.
    dataset : StudyDataset
        Opened for writing.
    place : str
        Where it is. Workers that reach it write whole parts themselves.
    files : mapping of absolute path to SHA-256
        Of every file that the scenario and its members read: scenario, FMUs, tables, logs, modules
        of users. Workers without them are sent copies.
    timeout : float or None
        Wall time that a member may take [s], as of :class:`WorkerPool`.
    progress : callable, optional
        Takes how many members have an outcome, how many are planned, and how many of
        these failed.
    notice : callable, optional
        Takes a sentence for each worker that is not used.
    opener : str
        As of :class:`WorkerPool`; its runner completes a member of number -1, without running it,
        where the study can be run on that machine.
    trial : StudyMember, optional
        The values of the member that shows this; left out: the first without an outcome.

    Raises
    ------
    UsageError
        If there is no scheduler, or no worker that can run the study.
    RunError
        If workers or scheduler are lost, or dask gave up members.
    DatasetError, DatasetWriteError
        If the dataset cannot be written.
    """
    if len(dataset) == len(design):
        return
    first = dataset.missing(len(design))[0].start
    (member,) = design.members(first, first + 1)
    with (
        connect(scheduler) as client,
        open_cluster_run(
            client,
            subject,
            trial or member,
            dataset,
            place,
            files=files,
            timeout=timeout,
            notice=notice,
            opener=opener,
        ) as run,
    ):
        run.complete(design, progress or _ignore)


@contextmanager
def open_cluster_run(
    client: Client,
    subject: StudySubject,
    first: StudyMember,
    dataset: OutcomeSink,
    place: str,
    *,
    files: Mapping[str, str],
    timeout: float | None = None,
    notice: Callable[[str], None] | None = None,
    opener: str = OPENER,
) -> Iterator[ClusterRun]:
    """Open a study on a cluster; parameters and errors as of :func:`run_on_cluster`.

    Parameters
    ----------
    first : StudyMember
        That is built on each worker before it is used.
    """
    check_scheduler(client)
    study = ClusterStudy.planned(
        subject,
        first,
        files=files,
        timeout=timeout,
        place=place,
        sha256=dataset.sha256,
        opener=opener,
    )
    storage = open_storage(study.place)
    run = ClusterRun(client, study, dataset, notice=notice or _ignore)
    probe = study.probe
    storage.write(probe.name, probe.content)
    try:
        yield run
    finally:
        run.close()
        storage.remove([probe.name], [])


@final
class ClusterRun:
    """The tasks of a study that are submitted; made by :func:`open_cluster_run`."""

    def __init__(
        self,
        client: Client,
        study: ClusterStudy,
        dataset: OutcomeSink,
        *,
        notice: Callable[[str], None],
    ) -> None:
        from cosim.studies.cluster.cluster_workers import ClusterWorkers

        self._client = client
        self._dataset = dataset
        self._design: PlannedMembers | None = None
        self._name = study.name
        self._tasks = RemainingTasks((), ())
        self._submitted: dict[Future, tuple[MemberTask, frozenset[str]]] = {}
        self._stranded: dict[Future, float] = {}  # since when no worker is left for them
        self._done: SimpleQueue[Future | None] = SimpleQueue()  # None: a worker was admitted
        self._workers: ClusterWorkers = ClusterWorkers(
            client, study, notice=notice, admitted=lambda: self._done.put(None)
        )
        self._given_up: list[range] = []
        self._count = 0  # of tasks, which are named by it
        self._failed = dataset.failed
        self._next_look = 0.0

    def complete(self, design: PlannedMembers, progress: Callable[[int, int, int], None]) -> None:
        """Run until every member of a design has its outcome; it may have grown since."""
        self._design = design
        parts = [part for part in self._dataset.empty_parts() if part.stop <= len(design)]
        self._tasks = RemainingTasks(self._dataset.missing(len(design)), parts)
        while self._tasks or self._submitted:
            self._look()
            self._submit()
            for future in self._wait():
                self._take(future)
            progress(len(self._dataset), len(design), self._failed)
        if self._given_up:
            parts = sorted(self._given_up, key=lambda part: part.start)
            names = [f"{part.start}-{part.stop - 1}" for part in parts]
            raise RunError(
                f"dask gave up members {listing(names)}: every worker that ran them died; run the "
                "same study again to continue from its dataset"
            )

    def close(self) -> None:
        """Cancel what is submitted, and end the study on the workers."""
        with uninterrupted():
            try:
                if self._submitted:
                    self._client.cancel(list(self._submitted), force=True)
                self._submitted.clear()
                self._stranded.clear()
                self._workers.close()
            except _LOST:
                return

    def _look(self) -> None:
        """Take notice of workers that came and went."""
        if monotonic() < self._next_look:
            return
        try:
            self._workers.refresh()
        except _LOST as error:
            raise lost(self._client) from error
        self._take_back()
        self._next_look = monotonic() + LOOK

    def _take_back(self) -> None:
        """Take back tasks for which no worker is left, and which dask has not given up."""
        present = self._workers.threads.keys()
        now = monotonic()
        stranded: dict[Future, float] = {}
        for future, (task, workers) in list(self._submitted.items()):
            if workers & present or future.status == "error":
                continue
            since = self._stranded.get(future, now)
            if now - since < GIVING_UP:
                stranded[future] = since
                continue
            del self._submitted[future]
            self._client.cancel([future], force=True)
            self._tasks.give_back(task)
        self._stranded = stranded

    def _submit(self) -> None:
        """Submit tasks to the workers that are admitted."""
        from cosim.studies.cluster.worker_functions import run_members

        threads = sum(self._workers.threads.values())
        workers = sorted(self._workers.threads)
        while self._tasks and len(self._submitted) < TASKS_PER_THREAD * threads:
            task = self._tasks.take(threads)
            self._count += 1
            first = task.members.start
            is_written = task.is_part and self._workers.writes
            future = self._client.submit(
                run_members,
                self._name,
                self._lines(task.members),
                first if is_written else None,
                key=(self._name, self._count),
                workers=workers,
                retries=RETRIES,
                pure=False,
            )
            self._submitted[future] = (task, frozenset(workers))
            future.add_done_callback(self._done.put)

    def _planned(self, members: range) -> list[StudyMember]:
        assert self._design is not None, "members are submitted within complete()"
        return self._design.members(members.start, members.stop)

    def _lines(self, members: range) -> bytes:
        """Return members as the pool writes them, compressed.

        Dask searches what is not bytes for futures, and keeps the last 1000 messages of every
        connection.
        """
        planned = self._planned(members)
        return zlib.compress(b"".join(encode_member(member) for member in planned), 1)

    def _wait(self) -> list[Future]:
        """Return the tasks that are done, after a while also none."""
        try:
            done = [self._done.get(timeout=LOOK)]
        except Empty:
            return []
        while not self._done.empty():
            done.append(self._done.get())
        if None in done:
            self._next_look = 0.0
        return [future for future in done if future in self._submitted]

    def _take(self, future: Future) -> None:
        """Take what a task came to into the dataset."""
        task, _ = self._submitted[future]
        answer = self._answer(future, task)
        with uninterrupted():
            del self._submitted[future]
            if answer is None:
                return
            if not answer["is_open"]:
                self._workers.forget(answer["worker"])
                self._next_look = 0.0
                self._tasks.give_back(task)
                return
            self._tasks.note(answer["count"], answer["seconds"])
            self._record(task, answer["outcomes"])
            self._failed += answer["failed"]

    def _answer(self, future: Future, task: MemberTask) -> dict[str, Any] | None:
        """Return what a task answers; None: there is nothing, and its members are seen to.

        Raises
        ------
        CosimError
            As the task did.
        """
        library = distributed()
        try:
            answer: dict[str, Any] = future.result(timeout=FETCHING)
        except (Exception, library.CancelledError) as error:
            if self._client.status != "running":
                raise lost(self._client) from error
            if future.status != "error":  # its worker died with the result
                self._client.cancel([future], force=True)
                self._tasks.give_back(task)
            elif isinstance(error, library.KilledWorker):
                self._given_up.append(task.members)
            else:
                raise _error_of(task, error) from None
            return None
        return answer

    def _record(self, task: MemberTask, outcomes: list[tuple[Any, ...]] | None) -> None:
        """Record outcomes; None: a worker wrote them."""
        members = task.members
        if outcomes is None:
            self._dataset.note_part(members.start)
            return
        came = {values[0]: MemberOutcome(*values) for values in outcomes}
        planned = self._planned(members)
        pairs = [(member, came[member.number]) for member in planned]
        if task.is_part:
            self._dataset.write_part(members.start, pairs)
            return
        for member, outcome in pairs:
            self._dataset.add(member, outcome)


_LOST: Final = (OSError, RuntimeError)  # what dask raises where a connection has gone


def _error_of(task: MemberTask, error: BaseException) -> CosimError:
    """Return the error for what a task raised."""
    if isinstance(error, CosimError):
        return error
    members = task.members
    return RunError(f"members {members.start}-{members.stop - 1}: {type(error).__name__}: {error}")


def _ignore(*_: object) -> None:
    """Take no notice."""
