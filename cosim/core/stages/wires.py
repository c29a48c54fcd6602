"""Wires: connections as columns of the row, with gain, offset and conversion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.core.connections import Connection
from cosim.core.structure.ports import ConnectionEnd
from cosim.units import Conversion

Columns: TypeAlias = slice | NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Wire:
    """Copies columns of outputs into columns of an input: gain and offset, then the conversion."""

    to: slice
    source: Columns
    gain: Matrix | None  # None: plain values
    offset: float
    conversion: Conversion

    @property
    def source_columns(self) -> list[int]:
        """The numbers of the columns that it copies from."""
        if isinstance(self.source, slice):
            return list(range(self.source.start, self.source.stop))
        numbers: list[int] = self.source.tolist()
        return numbers

    @property
    def sources_by_column(self) -> dict[int, set[int]]:
        """The columns that each column of the input follows."""
        sources = self.source_columns
        by_column: dict[int, set[int]] = {}
        for i, column in enumerate(range(self.to.start, self.to.stop)):
            if self.gain is None:
                by_column[column] = {sources[i]}
                continue
            weighted = zip(sources, self.gain[i], strict=True)
            by_column[column] = {source for source, gain in weighted if gain != 0.0}
        return by_column

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the input columns of some rows."""
        source = signals[rows, self.source]
        if self.gain is None:
            signals[rows, self.to] = self.conversion(source)
            return
        for i, gains in enumerate(self.gain):
            # Sums run in a fixed order, without BLAS, which gives other bits on other processors.
            total = np.full(len(source), self.offset)
            for j, gain in enumerate(gains):
                if gain != 0.0:
                    total += gain * source[:, j]
            signals[rows, self.to.start + i] = self.conversion(total)


def wires_of(
    to: slice,
    connection: Connection,
    sources: Sequence[ConnectionEnd],
    conversions: Sequence[Conversion],
) -> tuple[Wire, ...]:
    """Return the wires of a connection: one for each source, or one for all under a matrix.

    Where ``conversions``, of the elements of the input, differ, one for each part with the same.
    """
    gain = connection.matrix
    offset = connection.offset
    wires = []
    if gain.ndim == 2:
        joined = _joined(sources)
        for rows in _alike(conversions, 0, len(conversions)):
            part = slice(to.start + rows.start, to.start + rows.stop)
            wires.append(Wire(part, joined, gain[rows], offset, conversions[rows.start]))
        return tuple(wires)
    identity = gain == 1.0 and offset == 0.0
    start = 0
    for source in sources:
        first = source.columns.start - start
        for rows in _alike(conversions, start, start + source.size):
            part = slice(to.start + rows.start, to.start + rows.stop)
            columns = slice(first + rows.start, first + rows.stop)
            scaled = None if identity else gain * np.eye(rows.stop - rows.start)
            wires.append(Wire(part, columns, scaled, offset, conversions[rows.start]))
        start += source.size
    return tuple(wires)


def _alike(conversions: Sequence[Conversion], start: int, stop: int) -> Iterator[slice]:
    """Yield the parts of a range with the same conversion."""
    first = start
    for i in range(start + 1, stop + 1):
        if i == stop or conversions[i] != conversions[first]:
            yield slice(first, i)
            first = i


def constant_wires(to: slice, values: Sequence[float]) -> tuple[Wire, ...]:
    """Return the wires of an input that nothing drives: sums of no sources, and an offset."""
    wires = []
    for column, value in zip(range(to.start, to.stop), values, strict=True):
        element = slice(column, column + 1)
        wires.append(Wire(element, slice(0, 0), np.zeros((1, 0)), value, Conversion()))
    return tuple(wires)


def _joined(sources: Sequence[ConnectionEnd]) -> Columns:
    if len(sources) == 1:
        return sources[0].columns
    ranges = [np.arange(source.columns.start, source.columns.stop) for source in sources]
    return np.concatenate(ranges)
