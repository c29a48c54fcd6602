"""Members, parameters and metrics as arrays, with what has no value."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Vector
from cosim.errors import UsageError, nearest

NumberColumn: TypeAlias = NDArray[np.int64]  # of members, shape (N,)
VariedValues: TypeAlias = NDArray[Any]  # float64, or object; shape (N,)

_SMALLEST: Final = 1e-60  # its fourth power, and the sum of many of those of the largest, is normal
_LARGEST: Final = 1e60
_ROUNDING: Final = 1e-12  # relative


@dataclass(frozen=True)
class MetricColumn:
    """A metric of the members that are done, split into what can be computed with and what not.

    Parameters
    ----------
    name : str
    values : Vector, shape (n,)
        Finite numbers, in the order of the members.
    numbers : NumberColumn, shape (n,)
        The members that have them.
    failed : NumberColumn
        Members that failed: they have no metric, whatever is written there.
    without_value : NumberColumn
        Members that were completed and have None or NaN: there is none, as of a time at which
        something happened that did not.
    infinite : NumberColumn
        Members for which it is infinite.
    texts : mapping of str to int
        How often each text occurs, where it is a text; the most frequent first.
    """

    name: str
    values: Vector
    numbers: NumberColumn
    failed: NumberColumn
    without_value: NumberColumn
    infinite: NumberColumn
    texts: Mapping[str, int]

    @property
    def is_text(self) -> bool:
        """Whether it is a text wherever it has a value."""
        return bool(self.texts) and not len(self.values)


@dataclass(frozen=True)
class MemberColumns:
    """The members of a study that are done, as columns.

    Parameters
    ----------
    numbers : NumberColumn, shape (N,)
        Ascending.
    failed : Mask, shape (N,)
    reasons : sequence of str, length N
        Why a member failed, or ended before its stop; empty: it did not.
    parameters : mapping of key to VariedValues
        What was varied.
    raw_metrics : mapping of name to array, shape (N,)
        float64, or object with numbers, texts and None.
    warnings : sequence of str, length N
        What a member warns of, a line each; empty: nothing.
    """

    numbers: NumberColumn
    failed: Mask
    reasons: Sequence[str]
    parameters: Mapping[str, VariedValues]
    raw_metrics: Mapping[str, NDArray[Any]]
    warnings: Sequence[str]

    @cached_property
    def metrics(self) -> dict[str, MetricColumn]:
        """The metrics by name."""
        return {name: self._split(name) for name in self.raw_metrics}

    def metric(self, name: str) -> MetricColumn:
        """Return a metric that has numbers.

        Raises
        ------
        UsageError
            If there is no such metric, or it is a text.
        """
        self.check_metric(name)
        column = self.metrics[name]
        if column.is_text:
            raise UsageError(f"metric {name!r}: expected numbers, got texts")
        return column

    def check_metric(self, name: str) -> None:
        """Raise UsageError if there is no such metric."""
        if name not in self.raw_metrics:
            raise UsageError(f"the study has no metric {name!r}; {nearest(name, self.raw_metrics)}")

    def rows_of(self, numbers: NumberColumn) -> NDArray[np.intp]:
        """Return the rows of members that are done."""
        return np.searchsorted(self.numbers, numbers)

    def only(self, rows: Mask) -> MemberColumns:
        """Return some of the members."""
        return MemberColumns(
            numbers=self.numbers[rows],
            failed=self.failed[rows],
            reasons=[self.reasons[row] for row in np.flatnonzero(rows).tolist()],
            parameters={key: values[rows] for key, values in self.parameters.items()},
            raw_metrics={name: raw[rows] for name, raw in self.raw_metrics.items()},
            warnings=[self.warnings[row] for row in np.flatnonzero(rows).tolist()],
        )

    def numeric(self, name: str) -> Vector:
        """Return a metric of every member, shape (N,); NaN where there is no number."""
        raw = self.raw_metrics[name]
        if raw.dtype == object:
            is_text = self.is_text(name)
            raw = raw.copy()
            raw[is_text] = None  # which becomes NaN
        floats: Vector = raw.astype(np.float64)
        return np.where(self.failed, np.nan, floats)

    def is_text(self, name: str) -> Mask:
        """Return which members have a text for a metric."""
        raw = self.raw_metrics[name]
        if raw.dtype != object:
            return np.zeros(len(raw), np.bool_)
        return np.fromiter((isinstance(value, str) for value in raw), np.bool_, len(raw))

    def _split(self, name: str) -> MetricColumn:
        floats = self.numeric(name)
        is_text = self.is_text(name) & ~self.failed
        finite = np.isfinite(floats)
        texts = Counter(self.raw_metrics[name][is_text])
        return MetricColumn(
            name=name,
            values=floats[finite],
            numbers=self.numbers[finite],
            failed=self.numbers[self.failed],
            without_value=self.numbers[np.isnan(floats) & ~is_text & ~self.failed],
            infinite=self.numbers[np.isinf(floats)],
            texts=dict(texts.most_common()),
        )


def count_text(count: int, noun: str = "member") -> str:
    """Return how many there are: ``1 member``, ``2 members``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def is_constant(values: Vector) -> bool:
    """Return whether values are one, but for what rounding may add to it over a run."""
    if not len(values):
        return True
    low = float(values.min())
    high = float(values.max())
    return high - low <= _ROUNDING * max(abs(low), abs(high))


def exact_scale(values: Vector) -> float:
    """Return a power of two; over it the squares and sums of values are numbers.

    1.0 but for values so large, or so small, that theirs are not.
    """
    largest = float(np.abs(values).max(initial=0.0))
    if not largest or _SMALLEST < largest < _LARGEST:
        return 1.0
    return 2.0 ** (math.frexp(largest)[1] - 1)


def numbers_of(values: VariedValues) -> Vector | None:
    """Return the values of a parameter as numbers; None: some are none, such as a path or a list.

    Truth values are no numbers.
    """
    if values.dtype != object:
        is_number = np.issubdtype(values.dtype, np.number)
        return values.astype(np.float64) if is_number else None
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return values.astype(np.float64)
    return None
