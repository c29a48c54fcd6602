"""The unknowns of a loop that iterates: the input elements at which it is torn."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Recording, Stopped
from cosim.core.stages.member import Member
from cosim.core.structure.feedthrough import Edge
from cosim.core.structure.ports import Ports
from cosim.errors import listing
from cosim.native.stages.loop_solver import INVALID, UNDECIDED, LoopSolver

END: Final = slice(1, 2)  # of the two rows of a step
NOTHING_TORN: Final = (np.empty(0, np.intp), slice(0, 0))


@final
class TornInputs:
    """Input elements whose values at the end of a step are solved for.

    Parameters
    ----------
    connections : collection of (input Port, source Port)
        At least one.
    members : sequence of Member
        The components of the loop.
    ports : Ports
    iterations : int
        Sweeps of a step; 0: as many as Newton's method takes.

    Attributes
    ----------
    columns : tuple of int
        Of the elements, in the row; ascending by component.
    members : tuple of Member
        The components that have some.
    solver : LoopSolver
    answer : Vector, shape (n,)
        What the last sweep gave for the elements.
    """

    def __init__(
        self,
        connections: Collection[Edge],
        members: Sequence[Member],
        ports: Ports,
        iterations: int = 0,
    ) -> None:
        columns: list[int] = []
        self._own: dict[str, tuple[NDArray[np.intp], slice]] = {}
        with_some = []
        for member in members:
            own = _torn_columns(connections, member, ports)
            if not own:
                continue
            with_some.append(member)
            places = slice(len(columns), len(columns) + len(own))
            self._own[member.name] = (np.array(own), places)
            columns += own
        self.members = tuple(with_some)
        self.columns = tuple(columns)
        self.solver = LoopSolver(len(columns), iterations)
        of_members = [np.arange(m.columns.start, m.columns.stop) for m in members]
        self._of_loop = np.concatenate(of_members)
        self.answer = np.empty(len(columns))

    @property
    def labels(self) -> list[str]:
        """The names of the elements."""
        labels = []
        for member in self.members:
            columns, _ = self._own[member.name]
            labels += [member.label(int(column) - member.columns.start) for column in columns]
        return labels

    def take(self, recording: Recording) -> None:
        """Take the values that a run has recorded from now on, and solve for nothing.

        Where it did not record every row of them, they are solved for.
        """
        if any(recording.channels[member.name].period != 1 for member in self.members):
            return
        parts = []
        for member in self.members:
            columns, _ = self._own[member.name]
            blocks = [rows for _, rows in recording.blocks(member.name)]
            parts.append(np.concatenate(blocks)[:, columns - member.columns.start])
        times = recording.time_ns(self.members[0].name) / 1e9
        self.solver.take(times, np.hstack(parts))

    def begin(self, t1: float, rows: Matrix) -> None:
        """Begin a step that ends at ``t1`` [s].

        The guess is what the inputs have at its start; with a fixed number of iterations what
        their sources have there, which row 1 has so far.
        """
        if self.solver.iterations:
            self._gather(rows)
            self.solver.begin(t1, self.answer)
        else:
            self.solver.begin(t1, rows[0, list(self.columns)])

    def inputs_of(self, member: Member) -> tuple[NDArray[np.intp], Vector]:
        """Return the columns of a component's elements, and what is tried for them, to be read."""
        columns, places = self._own.get(member.name, NOTHING_TORN)
        return columns, self.solver.v[places]

    def put(self, rows: Matrix, member: Member) -> None:
        """Set inputs of a component, at the end of the step, to what is tried for them."""
        own = self._own.get(member.name)
        if own is not None:
            columns, places = own
            rows[1, columns] = self.solver.v[places]

    def next(self, rows: Matrix) -> int:
        """Look at what a sweep gave; return what is next: ``SOLVED``, ``SWEEP``, ..."""
        self._gather(rows)
        values = np.abs(rows[1, self._of_loop])
        largest = float(np.fmax.reduce(values))
        return self.solver.next(self.answer, largest)

    def _gather(self, rows: Matrix) -> None:
        """Bring the answer up to date: what row 1 gives for the elements."""
        gathered = rows[1:].copy()
        for member in self.members:
            columns, places = self._own[member.name]
            member.gather(gathered, slice(0, 1))
            self.answer[places] = gathered[0, columns]

    def stop(self, status: int, t: float) -> Stopped:
        """Return why there is no solution at ``t`` [s], the end of a step, as what stops it."""
        worst, residual, tolerance = self.solver.worst
        label = self.labels[worst]
        at = f"residual of {residual:.3g} at {label!r}, needed at most {tolerance:.3g}"
        if status == INVALID:
            reason = f"{label!r} becomes {self.answer[worst]}, which nothing can solve for"
        elif status == UNDECIDED:
            reason = f"they have no solution, or more than one: 1 - dw/dv is singular, with a {at}"
        else:
            reason = f"Newton's method ended with a {at}"
        inputs = listing(self.labels)
        text = (
            f"the inputs {inputs} of a loop, which depend on each other, were not solved at t = "
            f"{t} s: {reason}; needed a smaller step, or a component with a state of its own "
            "between, such as a lag or a delay"
        )
        return Stopped(np.empty((0, 0)), text)


def _torn_columns(connections: Collection[Edge], member: Member, ports: Ports) -> list[int]:
    """Return the columns of a component's inputs that torn connections feed."""
    sources: dict[str, set[int]] = {}
    for to, source in connections:
        if to.component == member.name:
            columns = ports.output(source).columns
            sources.setdefault(to.signal, set()).update(range(columns.start, columns.stop))
    torn: set[int] = set()
    for signal, torn_sources in sources.items():
        of_input = member.channel.signal_columns[signal]
        for wire in member.wires:
            if of_input.start <= wire.to.start < of_input.stop:
                for column, own_sources in wire.sources_by_column.items():
                    if own_sources & torn_sources:
                        torn.add(column)
    return sorted(torn)
