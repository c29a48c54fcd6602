"""Stages that advance up to the row where a condition of the run is met, and no further.

::

    until the end of the block, or where something stopped or came true:
        states <- every component is saved
        every stage advances, by as many steps as make ``WORK``
        where a condition came true before the last of these:
            every component goes back to its state
            every stage advances again, up to that row
        yield the steps up to there

Where a component cannot go back, or would go on with other bits after it was saved, they advance by
one step at a time: then none passes the row.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any, Final, final

from cosim.arrays import Matrix
from cosim.core.conditions import RunConditions
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.stages.pacing import Pacer
from cosim.errors import RunError

WORK: Final = 5e-3  # s of wall time: to save many components takes a tenth of a millisecond
GROWTH: Final = 4  # steps of a part, at most, in units of those of the last


def bound_to_steps(graph: Graph) -> list[str]:
    """Return the components that keep a run with conditions from going ahead of them."""
    names = []
    for name, member in graph.members.items():
        interface = member.channel.interface
        if not interface.rollback or interface.restarts:
            names.append(name)
    return names


@final
class LookingAhead:
    """Advances stages over a block, and looks for conditions.

    Parameters
    ----------
    graph : Graph
    pacer : Pacer
        Of its stages.
    conditions : RunConditions
    steps : int or None
        That stages go ahead, where they can go back; None: as many as make ``WORK``.
    """

    def __init__(
        self, graph: Graph, pacer: Pacer, conditions: RunConditions, steps: int | None
    ) -> None:
        self._members = tuple(graph.members.values())
        self._kept_by_loops = graph.kept_by_loops
        self._controls = graph.substep_controls
        self._pacer = pacer
        self._conditions = conditions
        is_bound = bool(bound_to_steps(graph))
        self._is_fixed = is_bound or steps is not None
        self._steps = 1 if is_bound else steps or 1
        self._goes_back = not is_bound
        self._has_saved = False

    def advance(self, rest: Block, signals: Matrix) -> int:
        """Advance all stages over some steps of the rest of a block; return how many.

        None is ahead of the row that is reached: where a condition came true, or something stopped.

        Raises
        ------
        RunError
            If a component cannot go back to what it was.
        """
        part = rest.part(0, min(self._steps, rest.steps))
        began = perf_counter()
        # at the first save FMUs are told that they may have to go back: before the first step
        is_needed = part.steps > 1 or not self._has_saved
        states = self._save() if self._goes_back and is_needed else []
        self._fill(part, signals[: part.steps + 1])
        filled = slice(1, self._pacer.end + 1)
        end = self._conditions.pass_over(part.time[filled], signals[filled])
        if end < part.steps and self._conditions.came_true:
            has_failed = self._pacer.error is not None
            try:
                self._go_back(states, part.part(0, end), signals[: end + 1])
            except RunError:
                # What failed behind the row may not be able to, and need not where the run ends.
                if not (has_failed and self._conditions.is_over):
                    raise
        self._adapt(part.steps, perf_counter() - began)
        return end

    def _fill(self, part: Block, rows: Matrix) -> None:
        self._pacer.begin(part)
        while self._pacer.advance(part, rows) < self._pacer.end:
            pass

    def _save(self) -> list[Any]:
        """Save every component, and what loops keep beside them."""
        self._has_saved = True
        states = [member.component.save() for member in self._members]
        return states + [kept.memory.copy() for kept in self._kept_by_loops]

    def _restore(self, states: list[Any]) -> None:
        n = len(self._members)
        for member, state in zip(self._members, states[:n], strict=True):
            member.component.restore(state)
        for kept, memory in zip(self._kept_by_loops, states[n:], strict=True):
            kept.memory[:] = memory

    def _go_back(self, states: list[Any], part: Block, rows: Matrix) -> None:
        """Bring every component to the last row of a part, behind which some of them are.

        Raises
        ------
        RunError
            If one cannot go back, or does other steps then.
        """
        self._restore(states)
        for control in self._controls:
            control.forget_from(int(part.time_ns[0]))
        again = rows.copy()
        again[1:] = 0.0
        self._fill(part, again)
        for member in self._members:
            own = (rows[:, member.columns], again[:, member.columns])
            if own[0].tobytes() != own[1].tobytes():
                differs = (own[0] != own[1]).any(axis=1)
                raise RunError(
                    f"{member.name!r} went back to t = {part.time[0]} s and repeated the same "
                    "steps with different values, first at t = "
                    f"{part.time[int(differs.argmax())]} s; its save() and restore() must be "
                    "complete, or its interface must not declare rollback"
                )

    def _adapt(self, steps: int, elapsed: float) -> None:
        if not self._is_fixed and steps == self._steps:
            fitting = int(steps * WORK / max(elapsed, 1e-9))
            self._steps = max(1, min(GROWTH * steps, fitting))
