"""Inputs that are overridden, and the jumps at the communication point that is reached.

An override takes effect at that point, and so does a fault. Of the point there are two rows: the
left limits, which were recorded, and the right limits, from which the next step starts. What
follows an input at once is evaluated where somebody reads it, at the latest before the next step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import TypeAlias, final

import numpy as np

from cosim.arrays import Vector, read_only
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recording import EventCause
from cosim.core.stages.faults import Fault, FaultInstant
from cosim.core.stages.member import Member
from cosim.core.stages.overrides import ActiveFault, OverrideValue, checked_values
from cosim.core.stepping.right_limits import END, NOTHING_GIVEN, GivenOutputs, RightLimits
from cosim.core.structure.ports import ConnectionEnd
from cosim.errors import GraphError, RunError, listing

ParameterValues: TypeAlias = Mapping[str, tuple[float, ...]]  # of parameters of a component


class OverridableInput:
    """An input that can be overridden, or elements of it.

    Parameters
    ----------
    to : Port
        As it was named.
    end : ConnectionEnd
    member : Member
    of_whole : slice
        The columns of the whole input.
    follows : bool
        Whether something follows at once when it jumps.
    """

    __slots__ = (
        "columns",
        "end",
        "follows",
        "is_plain",
        "member",
        "name",
        "numbers",
        "of_whole",
        "whole",
    )

    def __init__(
        self, to: Port, end: ConnectionEnd, member: Member, *, of_whole: slice, follows: bool
    ) -> None:
        self.name = str(to)
        self.end = end
        self.whole = end.port
        self.member = member
        self.follows = follows
        self.columns = end.columns
        self.is_plain = end.size == 1 and end.signal.type == "real"
        self.numbers = range(end.columns.start, end.columns.stop)
        self.of_whole = range(of_whole.start, of_whole.stop)

    @property
    def overridden(self) -> list[str]:
        """The names of its elements that are overridden."""
        first = self.member.columns.start
        columns = [column for column in self.numbers if column in self.member.overrides]
        return [self.member.label(column - first) for column in columns]

    def checked(self, value: OverrideValue) -> list[float]:
        """Return the elements of a value to override it with.

        Raises
        ------
        GraphError
            If the value does not fit it.
        """
        if self.is_plain and type(value) is float and isfinite(value):
            return [value]  # as most are; any other is checked in full
        return checked_values(self.name, value, self.end)


@final
class Jumps:
    """The jumps of inputs at the communication point that is reached, and what follows them.

    Parameters
    ----------
    graph : Graph
    are_recorded : bool
        Whether events are made of them.

    Attributes
    ----------
    row : Vector, shape (width,)
        The right limits; what follows inputs, as of the last evaluation.
    waiting : set of Port
        Inputs that have jumped since then.
    changes : dict of OverridableInput to EventCause
        Inputs whose jumps are still to be recorded, the last change last.
    overridden_before : dict of Port to dict of column to ActiveFault or None
        Of the inputs that have jumped, the columns that were overridden before; None: with a value.
    settings : list of (EventCause, str, tuple of float)
        Parameters that were set, ``component.parameter``, and components that were swapped, which
        are still to be recorded.
    left_row : Vector, shape (width,)
        The left limits; the same array as the right ones where nothing has jumped.
    """

    def __init__(self, graph: Graph, *, are_recorded: bool) -> None:
        self._are_recorded = are_recorded
        self.waiting: set[Port] = set()
        self.changes: dict[OverridableInput, EventCause] = {}
        self.settings: list[tuple[EventCause, str, tuple[float, ...]]] = []
        self.overridden_before: dict[Port, dict[int, ActiveFault | None]] = {}
        self._graph = graph
        self._inputs: dict[str | Port, OverridableInput] = {}
        self._right_limits = RightLimits(graph)
        self.stand_at(np.zeros(graph.layout.row_width))

    def stand_at(self, row: Vector) -> None:
        """Take a row as that of the point that is reached, without jumps so far."""
        self.row = row
        self.left_row = row
        self._is_evaluated = False  # what follows jumps at this point, once at least
        self.waiting.clear()
        self.clear_changes()

    def clear_changes(self) -> None:
        """Forget the jumps that were recorded."""
        self.changes.clear()
        self.settings.clear()
        self.overridden_before.clear()

    @property
    def are_pending(self) -> bool:
        """Whether something is to be evaluated, or recorded, before the next step."""
        return bool(self.changes or self.waiting or self.settings)

    @property
    def are_there(self) -> bool:
        """Whether inputs have jumped at this point: the right limits have a row of their own."""
        return self.row is not self.left_row

    def input(self, to: str) -> OverridableInput:
        """Return an input, or elements of it.

        Raises
        ------
        GraphError
            If there is no such input.
        """
        try:
            return self._inputs[to]
        except (KeyError, TypeError):  # not asked for before, or no input at all
            port = to if isinstance(to, Port) else Port.parse(to)
        end = self._graph.ports.input(port)
        member = self._graph.members[port.component]
        follows = self._right_limits.reach_more(end.port)
        of_whole = self._graph.ports.input(end.port).columns
        self._inputs[to] = OverridableInput(port, end, member, of_whole=of_whole, follows=follows)
        return self._inputs[to]

    def override(self, overridden: OverridableInput, values: Sequence[float]) -> None:
        """Override an input with values that were checked."""
        self._start(overridden, "override")
        overrides = overridden.member.overrides
        for column, element in zip(overridden.numbers, values, strict=True):
            overrides[column] = element
            self.row[column] = element
        if overridden.follows:
            self._let_follow(overridden)

    def inject(
        self, overridden: OverridableInput, faults: Sequence[Fault], *, index: int, h: float
    ) -> None:
        """Override an input by faults of its elements, from the communication point reached on.

        Parameters
        ----------
        overridden : OverridableInput
        faults : sequence of Fault
            Of one kind, one for each element.
        index : int
            Number of the communication point.
        h : float
            Communication step [s].
        """
        self._start(overridden, faults[0].kind)
        member = overridden.member
        driven = member.driven(self.left_row)
        for column, fault in zip(overridden.numbers, faults, strict=True):
            kept = float(self.left_row[column])
            instant = FaultInstant(0, h, float(driven[column]), kept)
            member.overrides.add_fault(column, ActiveFault(fault, index), instant)
        with np.errstate(over="ignore", invalid="ignore"):  # the check of the next row names it
            member.gather(self.row[np.newaxis], END)
        if overridden.follows:
            self._let_follow(overridden)

    def release(self, released: OverridableInput) -> None:
        """Release an override: the connection of the input drives it again.

        Raises
        ------
        GraphError
            If it is not overridden.
        """
        overrides = released.member.overrides
        if not all(column in overrides for column in released.numbers):
            names = listing(list(self.overrides)) or "nothing is"
            raise GraphError(
                f"release: '{released.name}' is not overridden as a whole; overridden: {names}"
            )
        self._start(released, "release")
        for column in released.numbers:
            del overrides[column]
        released.member.gather(self.row[np.newaxis], END)
        if released.follows:
            self._let_follow(released)

    def change(self, name: str, t: float, settings: ParameterValues, cause: EventCause) -> None:
        """Evaluate the outputs of a component, whose parameters were set; mark what jumps.

        Parameters
        ----------
        name : str
        t : float
            The time reached [s].
        settings : mapping of parameter to values
        cause : {"set", "swap"}

        Raises
        ------
        NonFiniteError, Stopped
            If the outputs cannot be evaluated.
        """
        member = self._graph.members[name]
        self._part_rows()
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                y = member.component.outputs(t, read_only(self.row)[member.inputs])
        except RunError as error:
            raise Stopped(np.empty((0, 0)), str(error)).at(name, t) from error
        bad = member.first_non_finite_output(y)
        if bad is not None:
            raise bad.error(t)
        self.take_outputs(name, settings, [(member.outputs, y)], cause)

    def take_outputs(
        self,
        name: str,
        settings: ParameterValues,
        given: Sequence[tuple[slice, Vector]],
        cause: EventCause,
    ) -> None:
        """Set outputs of a component, whose parameters were set, to right limits that are known.

        Parameters
        ----------
        name : str
        settings : mapping of parameter to values
        given : sequence of (slice, Vector)
            Columns of outputs, and their values.
        cause : {"set", "swap"}
        """
        self._part_rows()
        if self._are_recorded:
            for key, numbers in settings.items():
                self.settings.append((cause, f"{name}.{key}", numbers))
        before = self.row.copy()
        for columns, values in given:
            self.row[columns] = values
        channel = self._graph.layout[name]
        for signal in channel.interface.outputs:
            columns = channel.signal_columns[signal.name]
            if self.row[columns].tobytes() != before[columns].tobytes():
                self.waiting.add(Port(name, signal.name))

    @property
    def overrides(self) -> dict[str, float]:
        """The elements of inputs that are overridden, and their values."""
        values: dict[str, float] = {}
        for member in self._graph.members.values():
            for column, value in member.overrides.values().items():
                values[member.label(column - member.columns.start)] = value
        return values

    def _start(self, changed: OverridableInput, cause: EventCause) -> None:
        """Note that an input jumps; the row before the jump is kept."""
        self._part_rows()
        if self._are_recorded:
            if changed.whole not in self.overridden_before:
                self.overridden_before[changed.whole] = overridden_columns(changed)
            self.changes.pop(changed, None)  # the last change of an input comes last
            self.changes[changed] = cause

    def _part_rows(self) -> None:
        """Keep the row before the jumps apart from the one behind them."""
        if self.row is self.left_row:
            self.row = self.left_row.copy()

    def _let_follow(self, changed: OverridableInput) -> None:
        """Note that followers of an input wait, unless it is what it was before all jumps."""
        columns = slice(changed.of_whole.start, changed.of_whole.stop)
        is_as_before = self.row[columns].tobytes() == self.left_row[columns].tobytes()
        if is_as_before and not self._is_evaluated:
            self.waiting.discard(changed.whole)
        else:
            self.waiting.add(changed.whole)

    def evaluate(self, t: float, given: GivenOutputs = NOTHING_GIVEN) -> None:
        """Evaluate at ``t`` [s] what follows the inputs that have jumped.

        Parameters
        ----------
        t : float
        given : mapping of component name to columns with their values
            Right limits that are known, of components that are not evaluated.

        Raises
        ------
        NonFiniteError, Stopped
            If it cannot be evaluated.
        RunError
            If values keep changing.
        """
        jumped = frozenset(self.waiting)
        self.waiting.clear()
        self._is_evaluated = True
        self._right_limits.evaluate(t, self.row, jumped, given)


def overridden_columns(changed: OverridableInput) -> dict[int, ActiveFault | None]:
    """Return the columns of the whole input that are overridden; None: with a value."""
    overrides = changed.member.overrides
    columns = [column for column in changed.of_whole if column in overrides]
    return {column: overrides.faults.get(column) for column in columns}
