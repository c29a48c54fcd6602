"""Keep logs of chosen members: they run again, with a log, when the study is done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from cosim.errors import UsageError, option
from cosim.studies.contracts import FAILED, MemberOutcome
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.document.keep import KeptLogs
from cosim.studies.document.study_file import StudyFile
from cosim.studies.members.logging_runner import unfinished_name
from cosim.studies.running.plan import StudyPlan
from cosim.studies.workers.pool import WorkerPool

LOGGING_RUNNER: Final = "cosim.studies.members.logging_runner:open_logging_runner"


def check_kept_place(file: StudyFile, place: str | Path) -> None:
    """Check that logs can be kept where the dataset is.

    Raises
    ------
    UsageError
        If some are to be, and it is no folder of this machine.
    """
    text = str(place)
    is_folder = "://" not in text or text.startswith(("file://", "local://"))
    if file.kept_logs.which != "none" and not is_folder:
        raise UsageError(
            f"{option('keep')}: {text} is no folder, and logs are written to folders; needed a "
            "folder, or no kept logs"
        )


def keep_logs(
    plan: StudyPlan, dataset: StudyDataset, *, workers: int, notice: Callable[[str], None]
) -> None:
    """Log the members that a study keeps, if they have no log yet.

    Parameters
    ----------
    plan : StudyPlan
    dataset : StudyDataset
        Where all members are done.
    workers : int
    notice : callable
        Called with what is noteworthy: a member that came to something else this time.

    """
    kept = plan.study.kept_logs
    if kept.which == "none":
        return
    logged = dataset.logs()
    numbers = [number for number in chosen_members(kept, dataset) if number not in logged]
    if not numbers:
        return
    folder = Path(dataset.log_place(numbers[0])).parent
    folder.mkdir(exist_ok=True)
    recorded = {row["member"]: row for row in dataset.read(members=numbers).to_pylist()}
    subject = replace(plan.subject, logs=str(folder))
    members = []
    for number in numbers:
        designs = recorded[number]["designs"] or ""
        members.append(replace(plan.design.member(number), designs=designs))
    timeout = plan.study.settings.timeout
    with WorkerPool(LOGGING_RUNNER, subject, min(workers, len(members)), timeout=timeout) as pool:
        for outcome in pool.run(members):
            unfinished = folder / unfinished_name(outcome.number)
            if unfinished.exists():
                unfinished.replace(dataset.log_place(outcome.number))
            text = difference(outcome, recorded[outcome.number], list(plan.study.metrics))
            if text:
                notice(f"member {outcome.number} ran again for its log: {text}")


def chosen_members(kept: KeptLogs, dataset: StudyDataset) -> list[int]:
    """Return the members whose logs a study keeps, as far as they are done.

    Raises
    ------
    DatasetError
        If a file is damaged.
    """
    columns = ["member", "status", *([kept.metric] if kept.metric else [])]
    rows = dataset.read(columns).to_pylist()
    match kept.which:
        case "all":
            return [row["member"] for row in rows]
        case "failed":
            return [row["member"] for row in rows if row["status"] == FAILED]
        case "numbers":
            wanted = set(kept.numbers)
            return [row["member"] for row in rows if row["member"] in wanted]
        case "worst" | "best":
            valued = [row for row in rows if row[kept.metric] is not None]
            sign = -1 if kept.which == "worst" else 1
            valued.sort(key=lambda row: (sign * row[kept.metric], row["member"]))
            return [row["member"] for row in valued[: kept.count]]
    return []


def difference(outcome: MemberOutcome, recorded: dict[str, Any], metrics: Sequence[str]) -> str:
    """Return how a member came to something else than what is recorded; empty: it did not."""
    if outcome.status != recorded["status"]:
        before = recorded["reason"] or recorded["status"]
        return f"it came to {outcome.reason or outcome.status!r}, and to {before!r} before"
    for name in metrics:
        if outcome.metrics.get(name) != recorded[name] and outcome.status != FAILED:
            now = outcome.metrics.get(name)
            return (
                f"{name} = {now!r}, and {recorded[name]!r} before; what it runs gives other "
                "results each time"
            )
    return ""
