"""How the components of one stage advance over a block.

A cascade is one component: one call. The components of a loop advance step by step, by operations
whose order is fixed before the run (:mod:`cosim.core.order`). At each step the input of a component
from one that has not reached the end of the step yet is *extrapolated*: it keeps its value from the
start of the step (first order). Outputs that feed through from it are evaluated again as soon as it
is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.connections import Connection, Source
from cosim.core.contracts import Block, Component, Stopped
from cosim.core.order import OperationKind
from cosim.errors import RunError
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
    sources: Sequence[Source],
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


def _joined(sources: Sequence[Source]) -> Columns:
    if len(sources) == 1:
        return sources[0].columns
    ranges = [np.arange(source.columns.start, source.columns.stop) for source in sources]
    return np.concatenate(ranges)


@dataclass(frozen=True, slots=True)
class Member:
    """A component with its columns and the wires that feed its inputs."""

    name: str
    component: Component
    inputs: slice
    outputs: slice
    wires: tuple[Wire, ...]

    def gather(self, signals: Matrix, rows: slice) -> None:
        """Bring the inputs of some rows up to date."""
        for wire in self.wires:
            wire.copy(signals, rows)

    def perform(self, kind: OperationKind, time: Vector, h: float, rows: Matrix) -> None:
        """Carry out one operation of a loop over one step, from row 0 to row 1."""
        if kind == "advance":
            rows[1:, self.outputs] = self.advance(time, h, rows)
        else:
            end = float(time[1])
            rows[1, self.outputs] = self.component.outputs(end, rows[1, self.inputs])

    def advance(self, time: Vector, h: float, rows: Matrix) -> Matrix:
        """Advance the component.

        Raises
        ------
        RunError
            If its rows do not have the shape that its interface promises.
        """
        y = self.component.advance(time, h, rows[:, self.inputs])
        needed = (len(time) - 1, self.outputs.stop - self.outputs.start)
        if np.shape(y) != needed:
            shape = np.shape(y)
            raise RunError(f"advance gave an array of shape {shape}, its interface needs {needed}")
        return y


class Stage(Protocol):
    """Advances its components over a block."""

    @property
    def names(self) -> tuple[str, ...]:
        """The components of the stage."""
        ...

    @property
    def extrapolated(self) -> Mapping[str, frozenset[str]]:
        """Inputs by component that are known only after the component has advanced."""
        ...

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """What was assumed, as (component, text)."""
        ...

    @property
    def description(self) -> str:
        """The components and the order of their operations, for the log."""
        ...

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns.

        Raises
        ------
        Stopped
            With the number of rows that are filled.
        """
        ...


@dataclass(frozen=True, slots=True)
class Cascade:
    """One component outside every loop."""

    member: Member
    extrapolated: Mapping[str, frozenset[str]] = field(default_factory=dict)
    warnings: tuple[tuple[str, str], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The component."""
        return (self.member.name,)

    @property
    def description(self) -> str:
        """The component, for the log."""
        return f"cascade {self.member.name}"

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance the whole block in one call."""
        member = self.member
        # Row 0 is the last row of the block before: its inputs are there.
        member.gather(signals, slice(1, None))
        try:
            signals[1:, member.outputs] = member.advance(block.time, block.h, signals)
        except RunError as error:
            stop = _as_stop(error)
            filled = slice(1, stop.steps + 1)
            if stop.steps:
                signals[filled, member.outputs] = stop.outputs
            reached = float(block.time[stop.steps])
            raise stop.at(member.name, reached) from error


@dataclass(frozen=True, slots=True)
class Loop:
    """Components of a cycle of the graph, advanced step by step in a fixed order of operations."""

    coupling: str
    members: tuple[Member, ...]
    operations: tuple[tuple[OperationKind, Member], ...]
    extrapolated: Mapping[str, frozenset[str]]
    warnings: tuple[tuple[str, str], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The components, in the order in which they advance."""
        return tuple(member.name for kind, member in self.operations if kind == "advance")

    @property
    def description(self) -> str:
        """The operations in order, for the log; in parentheses: outputs are evaluated again."""
        words = [self.coupling]
        for kind, member in self.operations:
            words.append(member.name if kind == "advance" else f"({member.name})")
        return " ".join(words)

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance step by step."""
        for k in range(block.steps):
            step = slice(k, k + 2)
            stop = self._step(block.time[step], block.h, signals[step])
            if stop is not None:
                filled = np.empty((k + stop.steps, 0))
                raise Stopped(filled, str(stop), failed=stop.failed)

    def _step(self, time: Vector, h: float, rows: Matrix) -> Stopped | None:
        """Fill row 1; return what stopped it, with a row of outputs if the step is complete."""
        end = slice(1, 2)
        stopped: Stopped | None = None
        # Extrapolated inputs read row 1 before their source has written it: first, it is row 0.
        for member in self.members:
            rows[1, member.outputs] = rows[0, member.outputs]
        for kind, member in self.operations:
            member.gather(rows, end)
            try:
                member.perform(kind, time, h, rows)
            except RunError as error:
                stop = _as_stop(error)
                stopped = stop.at(member.name, float(time[stop.steps]))
                if not stopped.steps:
                    return stopped
                rows[1, member.outputs] = stopped.outputs[0]
        # What is recorded as applied at the end of the step is what the sources gave there at last.
        for member in self.members:
            member.gather(rows, end)
        return stopped


def _as_stop(error: RunError) -> Stopped:
    """Return an error as a stop; one that does not say how far it came stopped before any step."""
    return error if isinstance(error, Stopped) else Stopped(np.empty((0, 0)), str(error))
