"""The input elements at which a loop is torn: solved for where it iterates, kept with Jacobi.

Components that advance together (Jacobi) take inputs that are all gathered before any of them
advances, from the outputs that are known then: those of the start of the step for the components of
the loop, those of its end for all others. What feeds through is evaluated again with inputs that
are gathered again. Of those that are *kept* nothing better is known: they close algebraic loops,
which are not solved. They stay as they were before the step, so that nothing depends on who is
evaluated first.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Stopped
from cosim.core.recorded.run import RecordedRun
from cosim.core.stages.input_elements import InputElements
from cosim.core.stages.member import Member
from cosim.core.structure.feedthrough import Edge
from cosim.core.structure.ports import Ports
from cosim.errors import listing
from cosim.native.stages.loop_solver import INVALID, UNDECIDED, LoopSolver


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
        elements = InputElements(connections, members, ports)
        self._elements = elements
        self.columns = elements.columns
        self.solver = LoopSolver(len(elements), iterations)
        self._of_loop = np.concatenate([member.column_numbers for member in members])
        self._jumping = [
            f"{member.name}.{name}"
            for member in members
            for name in member.channel.interface.jumping
        ]
        self.answer = np.empty(len(elements))

    @property
    def labels(self) -> list[str]:
        """The names of the elements."""
        return self._elements.labels

    def take(self, recording: RecordedRun) -> None:
        """Take the values that a run has recorded from now on, and solve for nothing.

        Where it did not record every row of them, they are solved for.
        """
        if any(recording.channels[member.name].period != 1 for member in self._elements.members):
            return
        parts = []
        for member in self._elements.members:
            columns, _ = self._elements.of(member)
            blocks = [rows for _, rows in recording.blocks(member.name)]
            parts.append(np.concatenate(blocks)[:, columns - member.columns.start])
        grid = recording.grid
        times = grid.time(grid.number(recording.time_ns(self._elements.members[0].name)))
        self.solver.take(times, np.hstack(parts))

    def begin(self, t1: float, rows: Matrix) -> None:
        """Begin a step that ends at ``t1`` [s].

        The guess is what the inputs have at its start; with a fixed number of iterations what
        their sources have there, which row 1 has so far.
        """
        if self.solver.iterations:
            self._elements.driven(rows[1], self.answer)
            self.solver.begin(t1, self.answer)
        else:
            self.solver.begin(t1, rows[0, list(self.columns)])

    def inputs_of(self, member: Member) -> tuple[NDArray[np.intp], Vector]:
        """Return the columns of a component's elements, and what is tried for them, to be read."""
        columns, places = self._elements.of(member)
        return columns, self.solver.v[places]

    def put(self, rows: Matrix, member: Member) -> None:
        """Set inputs of a component, at the end of the step, to what is tried for them."""
        self._elements.put(rows[1], member, self.solver.v)

    def next(self, rows: Matrix) -> int:
        """Look at what a sweep gave; return what is next: ``SOLVED``, ``SWEEP``, ..."""
        self._elements.driven(rows[1], self.answer)
        values = np.abs(rows[1, self._of_loop])
        largest = float(np.fmax.reduce(values, initial=0.0))
        return self.solver.next(self.answer, largest)

    def stop(self, status: int, t: float) -> Stopped:
        """Return why there is no solution at ``t`` [s], the end of a step, as what stops it."""
        worst, residual, tolerance = self.solver.worst
        label = self.labels[worst]
        at = f"residual of {residual:.3g} at {label!r}, expected at most {tolerance:.3g}"
        if status == INVALID:
            reason = f"{label!r} becomes {self.answer[worst]}"
        elif status == UNDECIDED:
            reason = f"they have no solution, or more than one: 1 - dw/dv is singular, with a {at}"
        else:
            reason = f"Newton's method ended with a {at}"
        inputs = listing(self.labels)
        text = (
            f"the inputs {inputs} of an algebraic loop were not solved at t = {t} s: {reason}; "
            f"{self._way_out}"
        )
        return Stopped(np.empty((0, 0)), text)

    @property
    def _way_out(self) -> str:
        """What can be done about a loop that is not solved."""
        if not self._jumping:
            return (
                "use a smaller step, or break the loop with a component that has a state, such as "
                "a lag or a delay"
            )
        return (
            f"{listing(self._jumping)} may jump with inputs of the loop, and at a jump no step "
            "may have a solution; use an output that jumps only at communication points (discrete "
            '= true, or a period), or coupling = "gauss-seidel" or "jacobi", which solve no '
            "equations"
        )


@final
class KeptInputs:
    """The inputs of components that advance together.

    Parameters
    ----------
    connections : collection of (input Port, source Port)
        Those that are kept; there may be none.
    members : sequence of Member
        The components of the loop.
    ports : Ports
    """

    def __init__(
        self, connections: Collection[Edge], members: Sequence[Member], ports: Ports
    ) -> None:
        self._members = tuple(members)
        self._elements = InputElements(connections, members, ports)
        self._values = np.zeros(len(self._elements))

    @property
    def columns(self) -> tuple[int, ...]:
        """Of the elements that are kept, in the row; ascending by component."""
        return self._elements.columns

    def gather(self, rows: Matrix) -> None:
        """Gather all inputs, before the first component advances."""
        for member in self._members:
            member.gather_left(rows)
        self._values[:] = rows[1, list(self.columns)]

    def put(self, rows: Matrix, member: Member) -> None:
        """Set inputs of a component that are kept to what they were before the step."""
        self._elements.put(rows[1], member, self._values)

    def inputs_of(self, member: Member) -> tuple[NDArray[np.intp], Vector]:
        """Return the columns of a component's elements that are kept, and their values."""
        columns, places = self._elements.of(member)
        return columns, self._values[places]
