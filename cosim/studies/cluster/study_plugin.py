"""What a worker of dask keeps of a study: a plugin, which ends with the study or the worker."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from threading import Lock
from typing import Any, final

from distributed import Worker, WorkerPlugin

from cosim.digests import sha256_of
from cosim.errors import CosimError, RunError
from cosim.studies.cluster.cluster_study import ClusterStudy, DatasetProbe
from cosim.studies.cluster.file_copies import (
    has_all,
    moved,
    name_copies,
    place_copies,
    remove_copies,
    with_copies,
)
from cosim.studies.cluster.member_executor import MemberExecutor
from cosim.studies.contracts import MemberOutcome, StudyMember, StudySubject
from cosim.studies.dataset.storage import open_storage
from cosim.studies.dataset import StudyDataset


@final
class StudyPlugin(WorkerPlugin):  # type: ignore[misc]
    """What a worker keeps of a study.

    Parameters
    ----------
    study : ClusterStudy
    """

    def __init__(self, study: ClusterStudy) -> None:
        self._study = study
        self._lock = Lock()
        self._idle: list[MemberExecutor] = []
        self._all: list[MemberExecutor] = []
        self._is_closed = False
        self._root: str | None = None
        self._folder = Path()
        self._dataset: StudyDataset | None = None
        self.writes = False

    async def setup(self, worker: Worker) -> None:
        """Place the files, and see whether the dataset is in reach."""
        self._folder = Path(worker.local_directory)
        await asyncio.to_thread(self._prepare)

    def _prepare(self) -> None:
        study = self._study
        if not has_all(study.files):
            root = str(place_copies(self._folder, study.name, study.files))
            if study.named:
                name_copies(Path(moved(study.subject.scenario, root)), study.named, root)
            self._root = root
        self.writes = _reaches(study.place, study.probe)

    async def teardown(self, worker: Worker) -> None:
        """End the children; those that run members end after these, or with the worker."""
        with self._lock:
            self._is_closed = True
        for executor in self._all:
            executor.shutdown()
        if self._root is not None:
            await asyncio.to_thread(remove_copies, self._folder, self._study.name)

    async def try_member(self) -> str:
        """Build the member that is tried; return what is wrong here, or nothing."""
        executor = self._take()
        try:
            member = self._local(self._study.trial)
            (outcome,) = await asyncio.wrap_future(executor.submit([member]))
        except CosimError as error:
            return self._planned(str(error))
        finally:
            self._give_back(executor)
        return self._planned(outcome.reason)

    def run(self, members: Sequence[StudyMember]) -> list[MemberOutcome]:
        """Return the outcomes of members.

        Raises
        ------
        CosimError
            If the study cannot be run here.
        """
        executor = self._take()
        try:
            outcomes = executor.submit([self._local(member) for member in members]).result()
        finally:
            self._give_back(executor)
        if self._root is None:
            return outcomes
        return [replace(outcome, reason=self._planned(outcome.reason)) for outcome in outcomes]

    def write(
        self, first: int, members: Sequence[StudyMember], outcomes: Sequence[MemberOutcome]
    ) -> None:
        """Write a part of the dataset.

        Raises
        ------
        DatasetError
            If the dataset is another one's by now.
        DatasetWriteError
            If it cannot be written.
        """
        # what was run here has paths of this machine: the part has the members as planned
        by_number = {outcome.number: outcome for outcome in outcomes}
        pairs = [(member, by_number[member.number]) for member in members]
        with self._lock:
            if self._dataset is None:
                study = self._study
                self._dataset = StudyDataset.open(study.place, sha256=study.sha256)
        self._dataset.write_part(first, pairs)

    def _take(self) -> MemberExecutor:
        with self._lock:
            if self._is_closed:
                raise RunError("the study has ended")
            if self._idle:
                return self._idle.pop()
            study = self._study
            executor = MemberExecutor(study.opener, self._subject(), timeout=study.timeout)
            self._all.append(executor)
            return executor

    def _give_back(self, executor: MemberExecutor) -> None:
        with self._lock:
            self._idle.append(executor)

    def _subject(self) -> StudySubject:
        """Return the subject with the paths of this machine."""
        planned = self._study.subject
        if self._root is None:
            return planned
        subject = StudySubject(**self._moved(planned.to_dict()))
        if not self._study.named:
            return subject
        own = {subject.scenario: sha256_of(subject.scenario)}  # the copy names other copies
        return replace(subject, digests={**subject.digests, **own})

    def _local(self, member: StudyMember) -> StudyMember:
        """Return a member with the paths of this machine."""
        return member if self._root is None else StudyMember(**self._moved(asdict(member)))

    def _moved(self, values: Mapping[str, Any]) -> dict[str, Any]:
        assert self._root is not None, "paths are moved where there are copies"
        files = self._study.files
        return {name: with_copies(value, files, self._root) for name, value in values.items()}

    def _planned(self, text: str) -> str:
        """Return a text with the paths of where the study was planned."""
        return text if self._root is None else text.replace(self._root, "")


def _reaches(place: str, probe: DatasetProbe) -> bool:
    """Return whether this machine reads in a dataset what the planner wrote, and can write."""
    try:
        storage = open_storage(place)
        if storage.read(probe.name) != probe.content:
            return False
        storage.write(probe.name, probe.content)
    except CosimError:
        return False
    return True
