"""Run members of a dataset again, each on its own, and compare bit for bit what they come to.

::

    refuse a dataset whose scenario, FMUs, tables or metrics have changed
    take the parameters of members from their rows
    run each in a process of its own, built afresh, with nothing that the study computed before
    compare status, steps, metrics and results with the row
"""

from __future__ import annotations

import platform
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import DatasetError, UsageError, option
from cosim.studies.contracts import MemberResult, StudyMember
from cosim.studies.dataset.identity import StudyIdentity, differences
from cosim.studies.dataset.study import Study
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.running.comparing import same_reason, same_value
from cosim.studies.running.local import MembersDone
from cosim.studies.running.plan import plan_study
from cosim.studies.running.recorded_study import RecordedStudy, own_environment
from cosim.studies.running.time_limits import limit_again
from cosim.studies.tuning.planning import plan_recorded
from cosim.studies.verification.study_verification import StudyVerification, VerifiedDifference
from cosim.studies.workers.pool import WorkerPool

LONE_RUNNER: Final = "cosim.studies.members.lone_runner:open_lone_runner"
SAMPLE: Final = 10  # members, spread over all
_COMPARED: Final = ("status", "reason", "steps", "other_results")  # beside metrics


def verify_study(
    place: str | Path,
    *,
    members: Collection[int] = (),
    sample: int | None = None,
    workers: int = 1,
    progress: MembersDone | None = None,
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
    numbers = _chosen(dataset, members, sample)
    _check_unchanged(dataset, recorded)
    rows: dict[int, dict[str, Any]] = {}
    for row in dataset.read(members=numbers).to_pylist():
        rows[row["member"]] = row
    study = Study(dataset)
    names = [column.name for column in dataset.columns if column.role == "metric"]
    found: list[VerifiedDifference] = []
    limit = limit_again(dataset, recorded.study.settings.timeout)
    results = _results(recorded, study.members(numbers), workers, limit)
    for count, (member, outcome) in enumerate(results, 1):
        now = dataset.row_of(member, outcome)
        found += _differences(rows[member.number], now, [*names, *_COMPARED])
        if progress is not None:
            progress(count, len(numbers), len({item.member for item in found}))
    if found:
        _check_unchanged(dataset, recorded)  # what changed meanwhile would be the cause
    return StudyVerification(
        study.name,
        tuple(numbers),
        len(dataset),
        ("status", "steps", *names),
        tuple(sorted(found, key=lambda item: item.member)),
        _other_machines(rows.values()),
        _other_environment(recorded.environment),
        is_searched=recorded.search is not None,
    )


def _chosen(dataset: StudyDataset, members: Collection[int], sample: int | None) -> list[int]:
    """Return the members that run again, in order.

    Raises
    ------
    UsageError
        If one is not there.
    """
    there = _recorded_members(dataset)
    if not len(there):
        raise UsageError(f"{dataset.label}: no member has run yet; run the study first")
    for number in members:
        if number not in there:
            raise UsageError(
                f"{option('member')}: no outcome of member {number}; available: {len(there)} of "
                f"{dataset.layout.total} members, numbered from 0"
            )
    chosen = set(members)
    count = sample
    if count is None and not chosen:
        count = SAMPLE
    if count is not None:
        if count < 1:
            raise UsageError(f"{option('sample')}: expected 1 or more, got {count}")
        places = np.linspace(0, len(there) - 1, min(count, len(there)))
        chosen.update(there[np.round(places).astype(np.int64)].tolist())
    return sorted(chosen)


def _recorded_members(dataset: StudyDataset) -> NDArray[np.int64]:
    numbers = [table["member"].to_numpy() for table in dataset.tables(["member"])]
    return np.concatenate([np.empty(0, np.int64), *numbers])


def _check_unchanged(dataset: StudyDataset, recorded: RecordedStudy) -> None:
    """Check that members are made of what they were made of.

    Raises
    ------
    DatasetError
        If something has changed; names all of it.
    """
    found = differences(dataset.identity, _planned_again(recorded))
    if found:
        raise DatasetError(
            f"{dataset.label}: {found} (by SHA-256), so its members cannot be rerun; restore what "
            "they were run with"
        )


def _planned_again(recorded: RecordedStudy) -> StudyIdentity:
    """Return whose dataset it would be now."""
    if recorded.search is None:
        return plan_study(recorded.study).identity({})
    return plan_recorded(recorded.study, recorded.search).identity()


def _results(
    recorded: RecordedStudy, members: Sequence[StudyMember], workers: int, limit: float
) -> Iterator[MemberResult]:
    """Yield members with their outcomes, each of a process of its own."""
    subject = recorded.study.subject
    count = min(workers, len(members))
    with WorkerPool(LONE_RUNNER, subject, count, timeout=limit, members_per_worker=1) as pool:
        yield from pool.run(members)


def _differences(
    recorded: Mapping[str, Any], now: Mapping[str, Any], names: Sequence[str]
) -> list[VerifiedDifference]:
    number = recorded["member"]
    found = []
    for name in names:
        before = recorded[name]
        if same_value(before, now[name]):
            continue
        if name == "reason" and same_reason(before or "", now[name] or ""):
            continue
        found.append(VerifiedDifference(number, name, before, now[name]))
    return found


def _other_machines(rows: Collection[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the names of the machines on which members ran, without this one."""
    names = {(row["worker"] or "").rpartition(":")[0] for row in rows}
    return tuple(sorted(names - {"", platform.node()}))


def _other_environment(recorded: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return what is otherwise here than where the study was planned last."""
    now = own_environment()
    found = {}
    for name, value in recorded.items():
        if now.get(name, "") != value:
            found[name] = (value, now.get(name, ""))
    return found
