"""The members with the largest, or smallest, values of a metric."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Vector
from cosim.studies.analysis.columns import MemberColumns, NumberColumn


def worst_members(columns: MemberColumns, metric: str, count: int) -> NumberColumn:
    """Return the members with the largest values of a metric, the largest first.

    Infinity is the largest; of equal values the smaller number is first. Members that failed, or
    have no value, are none of them.

    Raises
    ------
    UsageError
        If there is no such metric, or it is a text.
    """
    columns.metric(metric)
    return _smallest(columns, -columns.numeric(metric), count)


def best_members(columns: MemberColumns, metric: str, count: int) -> NumberColumn:
    """Return the members with the smallest values of a metric, the smallest first.

    Otherwise as :func:`worst_members`.
    """
    columns.metric(metric)
    return _smallest(columns, columns.numeric(metric), count)


def _smallest(columns: MemberColumns, values: Vector, count: int) -> NumberColumn:
    rows = np.flatnonzero(~np.isnan(values))
    order = np.argsort(values[rows], kind="stable")
    return columns.numbers[rows[order[:count]]]
