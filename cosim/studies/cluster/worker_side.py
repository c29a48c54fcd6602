"""What the workers of dask do: answer what they are, take files, open a study, run its members.

These functions go to the workers by name, and their arguments are plain values. What a worker keeps
of a study is a plugin of dask: it ends with the study, or with the worker.
"""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from threading import Lock
from typing import Any, Final, final

from distributed import Worker, WorkerPlugin, get_worker

from cosim.errors import CosimError
from cosim.studies.cluster.environment import describe_environment
from cosim.studies.cluster.file_copies import (
    has_all,
    missing_content,
    place_copies,
    remove_copies,
    store_content,
    with_copies,
)
from cosim.studies.cluster.station import MemberStation
from cosim.studies.contracts import FAILED, MemberOutcome, StudyMember, StudySubject
from cosim.studies.dataset.storage import open_storage
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.workers.messages import decode_member

WORKER_KEY: Final = "worker"


def describe() -> dict[str, str]:
    """Return what this worker computes with."""
    return describe_environment()


async def find_missing(files: Mapping[str, str], *, dask_worker: Worker) -> list[str]:
    """Return the hashes of the files that this worker has to be sent."""
    if await asyncio.to_thread(has_all, files):  # a worker that does not answer counts as dead
        return []
    return missing_content(_folder(dask_worker), files)


def take_file(content: bytes, *, dask_worker: Worker) -> None:
    """Keep the content of a file."""
    store_content(_folder(dask_worker), content)


async def open_study(settings: Mapping[str, Any], *, dask_worker: Worker) -> dict[str, Any]:
    """Open a study on this worker, and build its first member.

    Returns
    -------
    dict
        ``problem``: why that cannot be, or empty; ``writes``: whether it writes the dataset.
    """
    study = WorkerStudy(settings)
    await dask_worker.plugin_add(plugin=study, name=settings["name"], catch_errors=False)
    problem = await study.try_first()
    if problem:
        await dask_worker.plugin_remove(name=settings["name"])
    return {"problem": problem, "writes": study.writes}


async def close_study(name: str, *, dask_worker: Worker) -> None:
    """End the children of a study, and remove its copies."""
    if name in dask_worker.plugins:
        await dask_worker.plugin_remove(name=name)


def run_members(name: str, lines: bytes, first: int | None) -> dict[str, Any]:
    """Run members of a study; the task.

    Parameters
    ----------
    name : str
    lines : bytes
        The members, a line each, as a pool writes them to its workers; compressed.
    first : int or None
        They are the part of the dataset that begins here, to be written if this worker can.

    Returns
    -------
    dict
        ``worker``; ``count``, ``seconds`` and ``failed`` of its members; ``outcomes``, or None:
        they are written. ``is_open`` is False where the study is not open here: a worker that was
        started again under its address.
    """
    worker = get_worker()
    study = worker.plugins.get(name)
    if study is None:
        return {WORKER_KEY: worker.address, "is_open": False}
    assert isinstance(study, WorkerStudy)
    planned = [decode_member(line) for line in zlib.decompress(lines).splitlines()]
    outcomes = study.run(planned)
    answer = {
        WORKER_KEY: worker.address,
        "is_open": True,
        "count": len(outcomes),
        "seconds": sum(outcome.wall_time for outcome in outcomes),
        "failed": sum(outcome.status == FAILED for outcome in outcomes),
        "outcomes": None,
    }
    if first is not None and study.writes:
        study.write(first, planned, outcomes)
    else:
        answer["outcomes"] = [plain_outcome(outcome) for outcome in outcomes]
    return answer


def plain_outcome(outcome: MemberOutcome) -> tuple[Any, ...]:
    """Return the values of an outcome in order."""
    return (
        outcome.number,
        outcome.status,
        outcome.reason,
        outcome.steps,
        dict(outcome.metrics),
        outcome.wall_time,
        outcome.designs,
        outcome.worker,
    )


@final
class WorkerStudy(WorkerPlugin):  # type: ignore[misc]
    """What a worker keeps of a study.

    Parameters
    ----------
    settings : mapping
        Plain values: ``name``, ``subject``, ``files``, ``first`` (values of the member that is
        tried, or None), ``timeout``, ``place``, ``sha256``, ``probe`` (name and content of a file
        in the dataset) and ``opener``.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._settings = settings
        self._lock = Lock()
        self._idle: list[MemberStation] = []
        self._all: list[MemberStation] = []
        self._root: str | None = None
        self._folder = Path()
        self._dataset: StudyDataset | None = None
        self.writes = False

    async def setup(self, worker: Worker) -> None:
        """Place the files, and see whether the dataset is in reach."""
        self._folder = _folder(worker)
        await asyncio.to_thread(self._prepare)

    def _prepare(self) -> None:
        files = self._settings["files"]
        if not has_all(files):
            root = place_copies(self._folder, self._settings["name"], files)
            self._root = str(root)
        self.writes = _reaches(self._settings["place"], self._settings["probe"])

    def teardown(self, worker: Worker) -> None:
        """End the children; those that run members end after these, or with the worker."""
        with self._lock:
            stations = list(self._all)
        for station in stations:
            station.close()
        if self._root is not None:
            remove_copies(self._folder, self._settings["name"])

    async def try_first(self) -> str:
        """Build the first member; return what is wrong here, or nothing."""
        if self._settings["first"] is None:
            return ""
        station = self._take()
        try:
            member = StudyMember(*self._settings["first"])
            (outcome,) = await asyncio.wrap_future(station.begin([self._local(member)]))
        except CosimError as error:
            return self._planned(str(error))
        finally:
            self._give_back(station)
        return self._planned(outcome.reason)

    def run(self, members: Sequence[StudyMember]) -> list[MemberOutcome]:
        """Return the outcomes of members.

        Raises
        ------
        CosimError
            If the study cannot be run here.
        """
        station = self._take()
        try:
            outcomes = station.run([self._local(member) for member in members])
        finally:
            self._give_back(station)
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
        by_number = {outcome.number: outcome for outcome in outcomes}
        pairs = [(member, by_number[member.number]) for member in members]
        with self._lock:
            if self._dataset is None:
                place = self._settings["place"]
                self._dataset = StudyDataset.open(place, sha256=self._settings["sha256"])
        self._dataset.write_part(first, pairs)

    def _take(self) -> MemberStation:
        with self._lock:
            if self._idle:
                return self._idle.pop()
            settings = self._settings
            station = MemberStation(
                settings["opener"],
                StudySubject(**self._moved(settings["subject"])),
                timeout=settings["timeout"],
            )
            self._all.append(station)
            return station

    def _give_back(self, station: MemberStation) -> None:
        with self._lock:
            self._idle.append(station)

    def _local(self, member: StudyMember) -> StudyMember:
        """Return a member with the paths of this machine."""
        return member if self._root is None else StudyMember(**self._moved(asdict(member)))

    def _moved(self, values: Mapping[str, Any]) -> dict[str, Any]:
        if self._root is None:
            return dict(values)
        files = self._settings["files"]
        return {name: with_copies(value, files, self._root) for name, value in values.items()}

    def _planned(self, text: str) -> str:
        """Return a text with the paths of where the study was planned."""
        return text if self._root is None else text.replace(self._root, "")


def _reaches(place: str, probe: tuple[str, bytes]) -> bool:
    """Return whether this machine reads in a dataset what the planner wrote, and can write."""
    name, content = probe
    try:
        storage = open_storage(place)
        if storage.read(name) != content:
            return False
        storage.write(name, content)
    except CosimError:
        return False
    return True


def _folder(worker: Worker) -> Path:
    return Path(worker.local_directory)
