"""The parameters that are recorded, beside those that are planned for the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from cosim.errors import DatasetError, flag, quoted
from cosim.studies.dataset.columns import MEMBER, StudyColumn, planned_array


class PlannedColumns(Protocol):
    """The values that members are planned to have, such as a design's."""

    def column(self, name: str, begin: int = 0, end: int | None = None) -> Any:
        """Return an array or a list of a parameter's values, from one member to another."""
        ...


def check_part(
    label: str,
    parameters: Sequence[StudyColumn],
    recorded: Any,
    design: PlannedColumns,
) -> None:
    """Check that recorded members have the planned parameters, bit for bit.

    Parameters
    ----------
    label : str
        Place of the dataset.
    parameters : sequence of StudyColumn
    recorded : pyarrow.Table
        Of some members, in order.
    design : PlannedColumns

    Raises
    ------
    DatasetError
        If one has others; names the first member, and its parameter.
    """
    members = recorded[MEMBER].to_numpy()
    if not len(members):
        return
    begin = int(members[0])
    end = int(members[-1]) + 1
    first: tuple[int, str, Any, Any] | None = None
    for column in parameters:
        values = design.column(column.name, begin, end)
        planned = planned_array(column, _taken(values, members - begin))
        found = recorded[column.name].combine_chunks()
        row = _first_difference(found, planned)
        if row is not None and (first is None or members[row] < first[0]):
            first = (int(members[row]), column.name, found[row].as_py(), planned[row].as_py())
    if first is not None:
        number, name, was, now = first
        raise DatasetError(
            f"{label}: member {number} was {name} = {quoted(was)}, is {quoted(now)}; members keep "
            "their numbers where random or Sobol samples, or cases, are appended; without these, "
            "seeds; without seeds, values at the end of the first key of the grid: do that, "
            f"choose another folder, or use {flag('new')} to delete the dataset and start over"
        )


def _taken(values: Any, rows: Any) -> Any:
    if isinstance(values, np.ndarray):
        return values[rows]
    return [values[row] for row in rows.tolist()]


def _first_difference(found: Any, planned: Any) -> int | None:
    """Return the first row in which two arrays of one type differ; None: there is none."""
    if found.equals(planned) and str(found.type) != "double":
        return None
    if str(found.type) == "double" and not (found.null_count or planned.null_count):
        bits = found.to_numpy().view(np.int64) != planned.to_numpy().view(np.int64)
        rows = np.flatnonzero(bits)
        return int(rows[0]) if len(rows) else None
    pairs = zip(found.to_pylist(), planned.to_pylist(), strict=True)
    # repr tells zeros of either sign apart, and finds NaN equal to itself
    return next((row for row, (a, b) in enumerate(pairs) if repr(a) != repr(b)), None)
