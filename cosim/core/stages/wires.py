"""Wires: connections as columns of the row, with gain, offset and conversion."""

from __future__ import annotations

from collections.abc import Sequence
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
    """Return the wires of a connection: one for each source, or one for all under a matrix."""
    gain = connection.matrix
    if gain.ndim == 2:
        # Every source reaches the same unit (checked), so one conversion is that of all of them.
        return (Wire(to, _joined(sources), gain, connection.offset, conversions[0]),)
    identity = gain == 1.0 and connection.offset == 0.0
    wires = []
    start = to.start
    for source, conversion in zip(sources, conversions, strict=True):
        stop = start + source.size
        scaled = None if identity else gain * np.eye(source.size)
        wire = Wire(slice(start, stop), source.columns, scaled, connection.offset, conversion)
        wires.append(wire)
        start = stop
    return tuple(wires)


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
