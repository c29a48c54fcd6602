"""How the components of one stage advance over a block.

A cascade is one component: one call. The components of a loop advance step by step, by operations that are fixed before the run
(:mod:`cosim.core.order`). At each step a component's input from a component that has not reached the end of the step yet is
*late*: it keeps its value from the start of the step (first order), and outputs that feed through from it are evaluated again as
soon as it is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block, Component, Stopped
from cosim.core.order import OperationKind
from cosim.errors import RunError
from cosim.units import Conversion


@dataclass(frozen=True, slots=True)
class Wire:
    """Copies source columns into input columns, through a gain and an offset where there are any, then from unit to unit."""

    to: slice
    source: slice
    gain: Matrix | None
    offset: float
    conversion: Conversion

    @staticmethod
    def of(
        to: slice, source: slice, gain: NDArray[np.float64], offset: float, conversion: Conversion
    ) -> Wire:
        """Build a wire from a number or a matrix; no map where the gain is 1 and the offset 0."""
        if gain.ndim == 2:
            return Wire(to, source, gain, offset, conversion)
        plain = gain == 1.0 and offset == 0.0
        return Wire(
            to, source, None if plain else gain * np.eye(to.stop - to.start), offset, conversion
        )

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the input columns of some rows; sums run in a fixed order, without BLAS."""
        if self.gain is None:
            signals[rows, self.to] = self.conversion(signals[rows, self.source])
            return
        source = signals[rows, self.source]
        for i, gains in enumerate(self.gain):
            total = np.full(len(source), self.offset)
            for j, gain in enumerate(gains):
                if gain != 0.0:
                    total += gain * source[:, j]
            signals[rows, self.to.start + i] = self.conversion(total)


@dataclass(frozen=True, slots=True)
class Member:
    """A component with its columns and the wires that feed it."""

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
            rows[1, self.outputs] = self.component.outputs(float(time[1]), rows[1, self.inputs])

    def advance(self, time: Vector, h: float, rows: Matrix) -> Matrix:
        """Let the component advance; its rows must have the shape that its interface promises."""
        y = self.component.advance(time, h, rows[:, self.inputs])
        needed = (len(time) - 1, self.outputs.stop - self.outputs.start)
        if np.shape(y) != needed:
            raise RunError(
                f"advance gave an array of shape {np.shape(y)}, its interface needs {needed}"
            )
        return y


class Stage(Protocol):
    """Advances its components over a block."""

    @property
    def names(self) -> tuple[str, ...]:
        """The components of the stage."""
        ...

    @property
    def late(self) -> Mapping[str, frozenset[str]]:
        """Inputs by component that are known only after the component has advanced."""
        ...

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """What was taken to be so, as (component, text)."""
        ...

    @property
    def description(self) -> str:
        """For the log."""
        ...

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns. Raises Stopped with the number of rows that are filled."""
        ...


@dataclass(frozen=True, slots=True)
class Cascade:
    """One component outside every loop."""

    member: Member
    late: Mapping[str, frozenset[str]] = field(default_factory=dict)
    warnings: tuple[tuple[str, str], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The component."""
        return (self.member.name,)

    @property
    def description(self) -> str:
        """For the log."""
        return f"cascade {self.member.name}"

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance the whole block in one call."""
        member = self.member
        member.gather(signals, slice(1, None))
        try:
            signals[1:, member.outputs] = member.advance(block.time, block.h, signals)
        except RunError as error:
            stop = _stop(error)
            if stop.steps:
                signals[1 : stop.steps + 1, member.outputs] = stop.outputs
            raise stop.at(member.name, float(block.time[stop.steps])) from error


@dataclass(frozen=True, slots=True)
class Loop:
    """Components that influence each other in a circle, advanced step by step in a fixed order of operations."""

    coupling: str
    members: tuple[Member, ...]
    operations: tuple[tuple[OperationKind, Member], ...]
    late: Mapping[str, frozenset[str]]
    warnings: tuple[tuple[str, str], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The components, in the order they advance."""
        return tuple(member.name for kind, member in self.operations if kind == "advance")

    @property
    def description(self) -> str:
        """For the log."""
        return " ".join(
            [
                self.coupling,
                *(m.name if kind == "advance" else f"({m.name})" for kind, m in self.operations),
            ]
        )

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance step by step."""
        for k in range(block.steps):
            ended = self._step(block.time[k : k + 2], block.h, signals[k : k + 2])
            if ended is not None:
                raise Stopped(np.empty((k + ended.steps, 0)), str(ended), failed=ended.failed)

    def _step(self, time: Vector, h: float, rows: Matrix) -> Stopped | None:
        """Fill row 1; give what ended the run there, with a row of outputs if the step was completed all the same."""
        end = slice(1, 2)
        ended: Stopped | None = None
        for member in self.members:
            rows[1, member.outputs] = rows[0, member.outputs]
        for kind, member in self.operations:
            member.gather(rows, end)
            try:
                member.perform(kind, time, h, rows)
            except RunError as error:
                stop = _stop(error)
                ended = stop.at(member.name, float(time[stop.steps]))
                if not ended.steps:
                    return ended
                rows[1, member.outputs] = ended.outputs[0]
        for member in self.members:
            member.gather(rows, end)
        return ended


def _stop(error: RunError) -> Stopped:
    """Take an error of a component that does not say how far it came as a stop before the first step."""
    return error if isinstance(error, Stopped) else Stopped(np.empty((0, 0)), str(error))
