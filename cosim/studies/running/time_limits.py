"""How long members may take that run again: by what they took in the study."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from cosim.arrays import Mask
from cosim.studies.contracts import FAILED, HANGS
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.workers.member_times import FACTOR, LEAST, UNTIL_TIMED


def limit_again(dataset: StudyDataset, timeout: float | None) -> float:
    """Return the wall time after which a member hangs that is built afresh [s].

    Where none was given, that follows from the slowest member that ended by itself; and one that
    hung has at least the time that it had.
    """
    if timeout:
        return max(LEAST, timeout)
    limit = LEAST
    for table in dataset.tables(["reason", "wall_time"]):
        times = table["wall_time"].to_numpy()
        hung = _has_hung(table)
        limit = max(limit, times[hung].max(initial=0.0), FACTOR * times[~hung].max(initial=0.0))
    return limit


def limits_with_log(
    dataset: StudyDataset, numbers: Sequence[int], timeout: float | None
) -> Iterator[tuple[list[int], float]]:
    """Yield members with the wall time after which they hang when they run with a log [s].

    Those that failed may hang again, and have the time that they had at least. The others have much
    more: the end of a log says what was identified, which takes longer than some runs.
    """
    table = dataset.read(["member", "status"], numbers)
    members = table["member"].to_numpy()
    has_failed = table["status"].to_numpy() == FAILED
    failed = members[has_failed].tolist()
    if failed:
        yield failed, timeout or limit_again(dataset, None)
    others = members[~has_failed].tolist()
    if others:
        yield others, max(UNTIL_TIMED, timeout or 0.0)


def _has_hung(table: Any) -> Mask:
    from pyarrow import compute

    hung: Mask = compute.starts_with(table["reason"], HANGS).fill_null(False).to_numpy()
    return hung
