"""Keep logs of chosen members: they run again, with a log, when the study is done.

::

    choose members by what is recorded of all
    run those again whose log is missing, or has other signals than logs are to have now
    remove the logs of others, if the run with the log came to what is recorded

A log that differs from the run that is recorded is the only one of its kind, as is what a crash
left of one: such logs stay, whichever members are chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from cosim.digests import digest_of
from cosim.errors import listing
from cosim.studies.contracts import FAILED, MemberOutcome, StudyMember
from cosim.studies.dataset.columns import LOG
from cosim.studies.dataset.log_files import LogFiles, LogRecord, unfinished_name
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.members.left_log import is_ended, readable_log
from cosim.studies.running.comparing import difference, same_reason
from cosim.studies.running.keeping_on_cluster import any_reaches, log_on_cluster
from cosim.studies.running.kept_members import chosen_members
from cosim.studies.running.local import MembersDone
from cosim.studies.running.plan import RECORD, StudyPlan
from cosim.studies.running.time_limits import limits_with_log
from cosim.studies.workers.pool import WorkerPool
from cosim.temporary import TemporaryFolder

if TYPE_CHECKING:
    from distributed import Client

LOGGING_RUNNER: Final = "cosim.studies.members.logging_runner:open_logging_runner"


def keep_logs(
    plan: StudyPlan,
    dataset: StudyDataset,
    *,
    workers: int,
    notice: Callable[[str], None],
    progress: MembersDone | None = None,
    client: Client | None = None,
) -> None:
    """Make the logs that a study keeps and that are not there; remove those it no longer keeps.

    Where a study says nothing of logs, those that are there stay.

    Parameters
    ----------
    plan : StudyPlan
    dataset : StudyDataset
        Where all members are done.
    workers : int
    notice : callable
        Called with what is noteworthy: a member that came to something else this time, members
        without a log, logs that are removed.
    progress : callable, optional
        Called with how many logs are there, of how many, and how many cannot be made.
    client : Client, optional
        Of a cluster, whose workers make the logs if one of them reaches the dataset; else this
        machine does: logs never go through the scheduler.

    Raises
    ------
    CosimError
        If a log cannot be written, or workers are lost.
    """
    if plan.study.kept_logs.which == "none":
        return
    with closing(dataset.log_files()) as logs:
        logs.clear_unfinished()
        chosen = chosen_members(plan.study.kept_logs, dataset).tolist()
        keeper = LogKeeper(plan, dataset, logs, notice=notice, progress=progress)
        missing = keeper.missing(chosen)
        if missing:
            is_here = client is None or not _can_log_on(client, dataset, notice)
            for numbers, limit in limits_with_log(dataset, missing, plan.study.settings.timeout):
                if client is None or is_here:
                    _log_here(plan, dataset, keeper, numbers, limit=limit, workers=workers)
                    continue
                log_on_cluster(
                    client, plan, dataset, numbers, limit=limit, take=keeper.take, notice=notice
                )
            logs.clear_unfinished()
        _remove_others(logs, set(chosen), notice)
        _name_missing(logs, chosen, notice)


@final
class LogKeeper:
    """Names logs, and records how they came to be.

    Parameters
    ----------
    plan : StudyPlan
    dataset : StudyDataset
    logs : LogFiles
    notice, progress : callable
        As of :func:`keep_logs`.

    Attributes
    ----------
    folder : Path or None
        Of this machine, in which logs are begun; None: they are elsewhere.
    """

    def __init__(
        self,
        plan: StudyPlan,
        dataset: StudyDataset,
        logs: LogFiles,
        *,
        notice: Callable[[str], None],
        progress: MembersDone | None,
    ) -> None:
        self._dataset = dataset
        self._logs = logs
        self._notice = notice
        self._metrics = [column.name for column in dataset.columns if column.role == "metric"]
        self._recording = _recording_of(plan)
        self.folder = logs.folder()
        self._progress = progress
        self._total = 0
        self._done = 0
        self._problems = 0

    def missing(self, chosen: Collection[int]) -> list[int]:
        """Return those of the chosen members whose logs are to be made, and count from there."""
        present = self._logs.present().difference(self._changed(chosen))
        missing = [number for number in chosen if not self._is_settled(number, present)]
        self._total = len(chosen)
        self._done = len(chosen) - len(missing)
        return missing

    def _changed(self, chosen: Collection[int]) -> set[int]:
        """Return those of the chosen members whose logs are no longer what was put there.

        A log that is the only one of its kind is left as it is.
        """
        changed = self._logs.changed().intersection(chosen)
        changed = {number for number in changed if self._logs.records[number].is_same}
        if changed:
            self._notice(
                f"the logs of {_members(sorted(changed))} were cut short or replaced since this "
                "study wrote them: they are written again"
            )
        return changed

    def _is_settled(self, number: int, present: Collection[int]) -> bool:
        record = self._logs.records.get(number)
        if record is None:
            return False
        if record.problem:
            return True
        if number not in present:
            return False
        return record.recording == self._recording or not record.is_same

    def take(
        self, outcome: MemberOutcome, recorded: dict[str, Any], folder: Path | None = None
    ) -> None:
        """Take the outcome of a run with a log, and give the log that it left its name.

        Parameters
        ----------
        outcome : MemberOutcome
        recorded : dict
            The row of the member.
        folder : Path, optional
            Of this machine, in which the log was begun; left out: that of the dataset.
        """
        number = outcome.number
        is_whole, problem = self._take_log(outcome, folder or self.folder)
        self._problems += bool(problem)
        now = self._dataset.row_of(StudyMember(number), outcome)
        text = difference(now, recorded, self._metrics)
        if text:
            self._notice(f"member {number} was rerun for its log: {text}")
        is_settled = outcome.status == recorded["status"]
        if problem:  # another one than that of the member may pass
            is_settled = is_settled and same_reason(outcome.reason, recorded["reason"] or "")
        if is_settled:  # else the same command tries it again
            is_same = is_whole and not text and bool(self._metrics)
            self._logs.note(LogRecord(number, self._recording, is_same, problem))
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total, self._problems)

    def _take_log(self, outcome: MemberOutcome, folder: Path | None) -> tuple[bool, str]:
        """Return whether a log has the end of its run, and why there is none."""
        if LOG in outcome.details:  # the worker has put what there was
            is_there = outcome.details[LOG] is True
            return is_there, "" if is_there else _without_row(outcome)
        if folder is None:
            return False, f"{outcome.reason}; its partial log is lost with its process"
        log, problem = _log_of(outcome, folder)
        if log is None:
            return False, problem
        is_whole = is_ended(log)
        self._logs.put(outcome.number, log)
        return is_whole, ""


def _can_log_on(client: Client, dataset: StudyDataset, notice: Callable[[str], None]) -> bool:
    """Return whether the workers of a cluster can put logs where the dataset is."""
    if any_reaches(client, dataset):
        return True
    notice(
        f"logs are written on this machine, as no worker of the cluster reaches {dataset.label}; "
        "with storage that workers reach, such as s3://, they write them"
    )
    return False


def _log_here(
    plan: StudyPlan,
    dataset: StudyDataset,
    keeper: LogKeeper,
    numbers: Sequence[int],
    *,
    limit: float,
    workers: int,
) -> None:
    """Run members with logs on this machine."""
    rows: dict[int, dict[str, Any]] = {}
    with ExitStack() as resources:
        folder = keeper.folder
        if folder is None:
            folder = resources.enter_context(TemporaryFolder("logs"))
        subject = replace(plan.subject, logs=str(folder))
        count = min(workers, len(numbers))
        pool = resources.enter_context(WorkerPool(LOGGING_RUNNER, subject, count, timeout=limit))
        for member, outcome in pool.run(_again(plan, dataset, numbers, rows)):
            keeper.take(outcome, rows.pop(member.number), folder)


def _again(
    plan: StudyPlan,
    dataset: StudyDataset,
    numbers: Sequence[int],
    rows: dict[int, dict[str, Any]],
) -> Iterator[StudyMember]:
    """Yield members as they are taken, and keep the rows of those whose outcome has not come."""
    for table in dataset.tables(members=numbers):
        for row in table.to_pylist():
            rows[row["member"]] = row
            yield replace(plan.design.member(row["member"]), designs=row["designs"] or "")


def _log_of(outcome: MemberOutcome, folder: Path) -> tuple[Path | None, str]:
    """Return the log that a run left, or None and why there is none."""
    path = folder / unfinished_name(outcome.number)
    if not path.exists():
        return None, _without_row(outcome)
    if outcome.status != FAILED:
        return path, ""
    readable = readable_log(path)
    if readable is None:
        return None, f"{outcome.reason}; no row of its log can be read"
    return readable, ""


def _without_row(outcome: MemberOutcome) -> str:
    return f"{outcome.reason} before a row of its log was written"


def _recording_of(plan: StudyPlan) -> str:
    """Return the SHA-256 of what logs have of a run: which signals, how often."""
    edits = {key: value for key, value in plan.subject.set.items() if key.startswith(f"{RECORD}.")}
    return digest_of([plan.scenario.tree.get(RECORD, {}), edits])


def _remove_others(logs: LogFiles, chosen: Collection[int], notice: Callable[[str], None]) -> None:
    """Remove the logs of members that are not chosen, if others can take their place."""
    others = sorted(logs.present().difference(chosen))
    removed = [n for n in others if n in logs.records and logs.records[n].is_same]
    if removed:
        logs.remove(removed)
        notice(
            f"removed the logs of {_members(removed)}, which keep no longer names; they can be "
            "reproduced: their recorded metrics were the same in both runs"
        )
    left = sorted(set(others).difference(removed))
    if left:
        notice(
            f"keep does not name {_members(left)}, whose logs are left in place: another run may "
            "give another result"
        )


def _name_missing(logs: LogFiles, chosen: Iterable[int], notice: Callable[[str], None]) -> None:
    """Notice which of the chosen members have no log, and why."""
    reasons = []
    for number in chosen:
        record = logs.records.get(number)
        if record is not None and record.problem:
            reasons.append(f"{number} ({record.problem})")
    if reasons:
        are = "member that is" if len(reasons) == 1 else "members that are"
        notice(f"no log of {len(reasons)} failed {are} kept: {listing(reasons, 3)}")


def _members(numbers: Sequence[int]) -> str:
    word = "member" if len(numbers) == 1 else f"{len(numbers)} members:"
    return f"{word} {listing([str(number) for number in numbers])}"
