"""The logs of members that are kept: they run again when the study is done, with a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import LogError, UsageError, listing, nearest, option
from cosim.log import open_log
from cosim.log.recovering import recover
from cosim.studies.contracts import (
    COMPLETE,
    FAILED,
    HANGS,
    MemberOutcome,
    StudyMember,
    StudySubject,
)
from cosim.studies.dataset import LOGS, StudyDataset
from cosim.studies.identity import StudyColumn
from cosim.studies.members import run_member
from cosim.studies.plan import StudyPlan
from cosim.studies.study_file import KeptLogs
from cosim.studies.workers import FACTOR, LEAST, UNTIL_TIMED, LocalExecutor
from cosim.temporary import TemporaryFolder

MembersDone = Callable[[int, int, int], None]


def keep_logs(
    plan: StudyPlan,
    dataset: StudyDataset,
    *,
    workers: int,
    notice: Callable[[str], None],
    progress: MembersDone | None = None,
) -> None:
    """Write the logs of the members that are chosen and have none yet.

    Parameters
    ----------
    plan : StudyPlan
    dataset : StudyDataset
        Complete.
    workers : int
        Processes at a time.
    notice : callable
        Takes what is noteworthy.
    progress : callable, optional
        Called with how many logs are there, of how many, and how many members have none.
    """
    timeout = plan.study.settings.timeout
    chosen = chosen_members(plan.study.settings.keep, dataset).tolist()
    settled = {name.partition(".")[0] for name in dataset.storage.names(LOGS)}
    missing = [number for number in chosen if str(number) not in settled]
    rows = {row["member"]: row for row in dataset.read(members=missing).to_pylist()}
    done = len(chosen) - len(missing)
    without: list[str] = []
    limits = {
        FAILED: timeout or limit_again(dataset, None),
        # the end of a log says what was identified, which may take longer than the run
        COMPLETE: max(UNTIL_TIMED, timeout or 0.0),
    }
    for status, limit in limits.items():
        numbers = [number for number in missing if rows[number]["status"] == status]
        if not numbers:
            continue
        with (
            TemporaryFolder("logs") as folder,
            LocalExecutor(plan.subject, min(workers, len(numbers)), timeout=limit) as executor,
        ):
            members = map(plan.design.member, numbers)
            for member, outcome in executor.run(members, partial(log_member, folder)):
                reason = _keep(dataset, folder, outcome, status)
                if reason:
                    without.append(f"{member.number} ({reason})")
                for name, was, now in different(dataset, rows[member.number], member, outcome):
                    notice(
                        f"member {member.number} was rerun for its log: {name} = {now!r}; "
                        f"recorded: {was!r}; the model is not deterministic, or it ran on another "
                        "machine"
                    )
                done += 1
                if progress is not None:
                    progress(done, len(chosen), len(without))
    if without:
        notice(f"no log of members that failed: {listing(without, 3)}")


def log_member(folder: Path, subject: StudySubject, member: StudyMember) -> MemberOutcome:
    """Run a member with a log in a folder."""
    return run_member(subject, member, folder / f"{member.number}.mcap")


def _keep(dataset: StudyDataset, folder: Path, outcome: MemberOutcome, recorded: str) -> str:
    """Put a log to the others, or what is intact in it; return why there is none.

    One that failed before, and has no log, is not tried again.
    """
    log = folder / f"{outcome.number}.mcap"
    if outcome.status == FAILED:
        try:
            open_log(log)
        except LogError:
            recovered = log.with_suffix(".recovered.mcap")
            try:
                recover(log, recovered, force=True)
            except LogError:
                reason = f"{outcome.reason}, before a row of its log was written"
                if recorded == FAILED:
                    dataset.storage.write(f"{LOGS}/{outcome.number}.txt", f"{reason}\n".encode())
                return reason
            log = recovered
    dataset.storage.write(f"{LOGS}/{outcome.number}.mcap", log)
    return ""


def chosen_members(kept: KeptLogs, dataset: StudyDataset) -> NDArray[np.int64]:
    """Return the members whose logs are kept, of those that are done."""
    if kept.which == "none":
        return np.empty(0, np.int64)
    columns = ["member", "status", *([kept.metric] if kept.metric else [])]
    table = dataset.read(columns)
    members: NDArray[np.int64] = table["member"].to_numpy()
    match kept.which:
        case "failed":
            members = members[np.array(table["status"].to_pylist(), object) == FAILED]
        case "numbers":
            members = members[np.isin(members, kept.numbers)]
        case "worst" | "best":
            values = table[kept.metric].to_numpy()  # NaN: there is none
            order = np.lexsort((members, -values if kept.which == "worst" else values))
            members = np.sort(members[order[~np.isnan(values[order])][: kept.count]])
    return members


def check_kept_metric(kept: KeptLogs, columns: Iterable[StudyColumn]) -> None:
    """Check that logs are kept by a metric that is a number."""
    numbers = [c.name for c in columns if c.role == "metric" and c.type == "double"]
    if kept.metric and kept.metric not in numbers:
        raise UsageError(
            f"{option('keep')}: {kept.metric!r} is not a numeric metric of the members; "
            f"{nearest(kept.metric, numbers)}"
        )


def limit_again(dataset: StudyDataset, timeout: float | None) -> float:
    """Return the wall time after which a member hangs that runs again [s].

    One that hung has at least the time that it had; the others ten times the slowest one's.
    """
    if timeout:
        return max(LEAST, timeout)
    limit = LEAST
    for table in dataset.tables(["reason", "wall_time"]):
        for row in table.to_pylist():
            hung = (row["reason"] or "").startswith(HANGS)
            limit = max(limit, row["wall_time"] * (1.0 if hung else FACTOR))
    return limit


def different(
    dataset: StudyDataset, recorded: Mapping[str, Any], member: StudyMember, outcome: MemberOutcome
) -> list[tuple[str, Any, Any]]:
    """Return what is otherwise now than it is recorded: name, recorded, now; bit for bit."""
    row = dataset.row_of(member, outcome)
    metrics = [column.name for column in dataset.columns if column.role == "metric"]
    found = []
    for name in (*metrics, "status", "reason", "steps", "other_results"):
        was, now = recorded[name], row[name]
        both_hang = name == "reason" and all((r or "").startswith(HANGS) for r in (was, now))
        if repr(was) != repr(now) and not both_hang:
            found.append((name, was, now))
    return found


def kept_count(kept: KeptLogs, members: int) -> int | None:
    """Return of how many of the members the logs are kept; None: that shows later."""
    if kept.which == "failed":
        return None
    if kept.which == "all":
        return members
    return min(kept.count, members) + sum(number < members for number in kept.numbers)
