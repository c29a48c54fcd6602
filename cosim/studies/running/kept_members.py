"""Which members' logs a study keeps, by columns: no object for each row of a million."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError, nearest, option
from cosim.studies.contracts import FAILED
from cosim.studies.dataset.columns import StudyColumn
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.document.keep import KeptLogs

_NUMBER: Final = "double"


def check_kept_metric(kept: KeptLogs, columns: Iterable[StudyColumn]) -> None:
    """Check that the metric by which members are chosen is a number of each.

    Raises
    ------
    UsageError
        If it is not.
    """
    if not kept.metric:
        return
    metrics = [column for column in columns if column.role == "metric"]
    numbers = [column.name for column in metrics if column.type == _NUMBER]
    if kept.metric not in numbers:
        raise UsageError(
            f"{option('keep')}: {kept.metric!r} is not a numeric metric of the members; "
            f"{nearest(kept.metric, numbers)}"
        )


def kept_count(kept: KeptLogs, members: int) -> int | None:
    """Return how many logs a study of so many members keeps; None: as many as fail."""
    match kept.which:
        case "none":
            return 0
        case "failed":
            return None
        case "all":
            return members
        case "numbers":
            return sum(number < members for number in kept.numbers)
        case _:
            return min(kept.count, members)


def chosen_members(kept: KeptLogs, dataset: StudyDataset) -> NDArray[np.int64]:
    """Return the members whose logs a study keeps, as far as they are done; in order.

    Raises
    ------
    DatasetError
        If a file is damaged.
    """
    match kept.which:
        case "none":
            return np.empty(0, np.int64)
        case "worst" | "best":
            return _extreme_members(kept, dataset)
    from pyarrow import compute

    found = [np.empty(0, np.int64)]
    for table in dataset.tables(["member", "status"]):
        numbers = table["member"].to_numpy()
        match kept.which:
            case "failed":
                numbers = numbers[compute.equal(table["status"], FAILED).to_numpy()]
            case "numbers":
                numbers = numbers[np.isin(numbers, kept.numbers)]
        found.append(numbers)
    return np.concatenate(found)


def _extreme_members(kept: KeptLogs, dataset: StudyDataset) -> NDArray[np.int64]:
    """Return the members with the largest or smallest values; of equal ones the first."""
    sign = -1.0 if kept.which == "worst" else 1.0
    members = np.empty(0, np.int64)
    keys = np.empty(0)
    for table in dataset.tables(["member", kept.metric]):
        values = table[kept.metric].to_numpy()  # NaN: there is none
        has_value = ~np.isnan(values)
        members = np.concatenate([members, table["member"].to_numpy()[has_value]])
        keys = np.concatenate([keys, sign * values[has_value]])
        order = np.lexsort((members, keys))[: kept.count]
        members = members[order]
        keys = keys[order]
    return np.sort(members)
