"""Run members of a dataset again, each in a process of its own, and compare bit for bit."""

from __future__ import annotations

import platform
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.errors import DatasetError, UsageError, option
from cosim.studies.dataset import StudyDataset
from cosim.studies.identity import differences
from cosim.studies.kept_logs import different, limit_again
from cosim.studies.plan import RecordedStudy, own_environment, plan_study
from cosim.studies.study import Study
from cosim.studies.workers import LocalExecutor

SAMPLE: Final = 10  # members, spread over all


@dataclass(frozen=True, slots=True)
class VerifiedDifference:
    """What is otherwise now than it is recorded: a metric, a result, status, reason or steps."""

    member: int
    name: str
    recorded: Any
    now: Any


@dataclass(frozen=True)
class StudyVerification:
    """What came of running members again.

    Parameters
    ----------
    name : str
        Of the study.
    members : tuple of int
        That ran again.
    done : int
        Members that have an outcome.
    values : tuple of str
        The names of what was compared.
    differences : tuple of VerifiedDifference
    elsewhere : tuple of str
        The machines on which these members ran, other than this one.
    environment : mapping of str to (str, str)
        What is recorded of versions and processor, and what there is now, where these differ.
    is_searched : bool
        A search chose the members; that it would choose these again is not verified.
    """

    name: str
    members: tuple[int, ...]
    done: int
    values: tuple[str, ...]
    differences: tuple[VerifiedDifference, ...]
    elsewhere: tuple[str, ...]
    environment: Mapping[str, tuple[str, str]]
    is_searched: bool

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def verify_study(
    place: str | Path,
    *,
    members: Collection[int] = (),
    sample: int | None = None,
    workers: int = 1,
    progress: Callable[[int, int, int], None] | None = None,
) -> StudyVerification:
    """Run members of a dataset again, and compare.

    Parameters
    ----------
    place : str or Path
        A folder, or a URL of fsspec.
    members : collection of int
        These; and, if ``sample`` is given or there are none of these, others spread over all.
    sample : int, optional
        How many of those.
    workers : int
        Processes at a time.
    progress : callable, optional
        Called with how many have run, of how many, and how many of these differ.

    Raises
    ------
    UsageError
        If there is no such member, or none at all.
    DatasetError
        If what members are made of has changed, or the dataset is damaged.
    """
    dataset = StudyDataset.open(place)
    recorded = RecordedStudy.read(dataset.identity.text)
    study = Study(dataset)
    numbers = _chosen(study, members, sample)
    _check_unchanged(dataset, recorded)
    rows = {row["member"]: row for row in study.table(members=numbers).to_pylist()}
    found: list[VerifiedDifference] = []
    limit = limit_again(dataset, recorded.study.settings.timeout)
    subject = recorded.study.subject
    count = min(workers, len(numbers))
    with LocalExecutor(subject, count, timeout=limit, members_per_worker=1) as executor:
        for done, (member, outcome) in enumerate(executor.run(study.members(numbers)), 1):
            for item in different(dataset, rows[member.number], member, outcome):
                found.append(VerifiedDifference(member.number, *item))
            if progress is not None:
                progress(done, len(numbers), len({item.member for item in found}))
    if found:
        _check_unchanged(dataset, recorded)  # what changed meanwhile would be the cause
    machines = {(row["worker"] or "").rpartition(":")[0] for row in rows.values()}
    now = own_environment()
    return StudyVerification(
        study.name,
        tuple(numbers),
        len(dataset),
        ("status", "steps", *study.metrics),
        tuple(sorted(found, key=lambda item: item.member)),
        tuple(sorted(machines - {"", platform.node()})),
        {n: (v, now.get(n, "")) for n, v in recorded.environment.items() if now.get(n, "") != v},
        is_searched=recorded.search is not None,
    )


def _chosen(study: Study, members: Collection[int], sample: int | None) -> list[int]:
    """Return the members that run again, in order."""
    there = study.table(["member"])["member"].to_numpy()
    if not len(there):
        raise UsageError(f"{study.name}: no member has run yet; run the study first")
    for number in members:
        study.member(number)  # UsageError: there is none
    count = SAMPLE if sample is None and not members else sample
    chosen = set(members)
    if count is not None:
        if count < 1:
            raise UsageError(f"{option('sample')}: expected 1 or more, got {count}")
        places = np.linspace(0, len(there) - 1, min(count, len(there)))
        chosen.update(there[np.round(places).astype(np.int64)].tolist())
    return sorted(chosen)


def _check_unchanged(dataset: StudyDataset, recorded: RecordedStudy) -> None:
    """Check that members are made of what they were made of."""
    if recorded.search is None:
        planned = plan_study(recorded.study).identity({})
    else:
        from cosim.studies.tuning import plan_tuning

        planned = plan_tuning(recorded.study, recorded.search).identity()
    found = differences(dataset.identity, planned)
    if found:
        raise DatasetError(
            f"{dataset.storage.label()}: {found} (by SHA-256), so its members cannot be rerun; "
            "restore what they were run with"
        )
