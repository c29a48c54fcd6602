"""Logs that are made on the workers of a cluster: each is put where the dataset is.

A log never goes through the scheduler. In a shared folder it is written under a temporary name,
which who planned the study changes; to other storage the worker puts it whole under its own.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final, final

from cosim.errors import CosimError, UsageError
from cosim.studies.cluster.opening import TRIAL, TryingRunner
from cosim.studies.contracts import FAILED, MemberOutcome, MemberRunner, StudyMember, StudySubject
from cosim.studies.dataset import LOG
from cosim.studies.dataset.log_files import LOGS, log_name, unfinished_name
from cosim.studies.dataset.storage import Storage, open_storage
from cosim.studies.dataset import StudyDataset
from cosim.studies.members.left_log import readable_log
from cosim.studies.members.logging_runner import LoggingRunner
from cosim.temporary import TemporaryFolder

STORING_OPENER: Final = "cosim.studies.cluster.storing:open_storing_runner"
_MARK: Final = "#"  # between the place of a dataset and what tells it from others


def kept_place(place: str, sha256: str) -> str:
    """Return what the subject of :class:`StoringRunner` has as its logs."""
    path = place if "://" in place else os.path.abspath(place)
    return f"{path}{_MARK}{sha256}"


def reaches_dataset(logs: str) -> bool:
    """Return whether the dataset that a text of :func:`kept_place` is about is in reach here."""
    place, _, sha256 = logs.rpartition(_MARK)
    try:
        StudyDataset.open(place, sha256=sha256)
    except CosimError:
        return False
    return True


def open_storing_runner(subject: StudySubject) -> TryingRunner:
    """Return what runs members with logs, and can be tried first.

    Raises
    ------
    UsageError
        If the dataset is out of reach here.
    """
    if not reaches_dataset(subject.logs):
        place = subject.logs.rpartition(_MARK)[0]
        raise UsageError(f"{place}, where logs are kept, cannot be reached")
    return TryingRunner(subject, StoringRunner(subject))


@final
class StoringRunner(MemberRunner):
    """Runs members, and puts their logs where the dataset is.

    The details of an outcome say, as ``log``, whether its log was put; nothing of that where who
    planned the study finds it in a folder.

    Parameters
    ----------
    subject : StudySubject
        Its logs are as of :func:`kept_place`.
    """

    def __init__(self, subject: StudySubject) -> None:
        self._resources = ExitStack()
        self._storage: Storage = open_storage(subject.logs.rpartition(_MARK)[0])
        shared = self._storage.folder(LOGS)
        self._is_shared = shared is not None
        self._folder = shared or self._resources.enter_context(TemporaryFolder("logs"))
        self._runner = LoggingRunner(replace(subject, logs=str(self._folder)))

    def close(self) -> None:
        """Close the runner, and remove its folder."""
        with self._resources:
            self._runner.close()

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member with a log."""
        assert member.number != TRIAL
        outcome = self._runner.run(member)
        if self._is_shared:
            return outcome
        log = self._log_of(outcome)
        if log is not None:
            self._storage.put(log_name(member.number), log)
        return replace(outcome, details={**outcome.details, LOG: log is not None})

    def _log_of(self, outcome: MemberOutcome) -> Path | None:
        path = self._folder / unfinished_name(outcome.number)
        if not path.exists():
            return None
        return readable_log(path) if outcome.status == FAILED else path
