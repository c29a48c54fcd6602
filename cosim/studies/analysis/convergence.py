"""How the mean of a metric converges with the number of members."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.studies.analysis.columns import MetricColumn, NumberColumn, exact_scale
from cosim.studies.analysis.independence import Independence
from cosim.studies.analysis.interval_quantiles import student_quantiles


@dataclass(frozen=True)
class RunningMean:
    """The mean of the first members, with its interval.

    Parameters
    ----------
    counts : NumberColumn, shape (m,)
        Members that were counted, ascending.
    means : Vector, shape (m,)
    half_widths : Vector, shape (m,)
        Of the 95 % interval; NaN: of one unit.
    """

    counts: NumberColumn
    means: Vector
    half_widths: Vector


def running_mean(column: MetricColumn, of_design: Independence) -> RunningMean:
    """Return the mean after each unit of members, in the order of their numbers.

    The mean of units, which differs from that of members where units have lost members.

    Raises
    ------
    UsageError
        If the members of the study were not drawn.
    """
    if not of_design.is_drawn:
        raise UsageError(
            f"the mean of {column.name!r} does not converge: the members of this study were "
            "chosen, not drawn; use samples or seeds"
        )
    scale = exact_scale(column.values)
    units = of_design.units_of(column.numbers)
    values, counts = _unit_means(column.values / scale, units)
    number = np.arange(1.0, len(values) + 1.0)
    origin = values[0] if len(values) else 0.0
    shifted = values - origin  # sums of squares about a value of the metric do not cancel
    mean = np.cumsum(shifted) / number
    squares = np.cumsum(shifted**2) - number * mean**2
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.maximum(squares, 0.0) / (number - 1.0)
        half_widths = student_quantiles(number) * np.sqrt(variance / number)
    if of_design.layout.kind == "latin-hypercube":
        with np.errstate(divide="ignore", invalid="ignore"):
            half_widths = half_widths * np.sqrt(number / (number - 1.0))
    return RunningMean(counts, scale * (mean + origin), scale * half_widths)


def _unit_means(values: Vector, units: NumberColumn | None) -> tuple[Vector, NumberColumn]:
    """Return the mean of each unit, and how many members it and those before it have."""
    if units is None:
        return values, np.arange(1, len(values) + 1)
    _, index = np.unique(units, return_inverse=True)
    sizes = np.bincount(index)
    return np.bincount(index, weights=values) / sizes, np.cumsum(sizes)
