"""Substeps: a loop divides its communication steps where the estimated error asks for it.

::

    interval <- the communication step, or the part of it that the last step ended with
    until the end of the communication step:
        coarse <- the loop takes the interval at once, and goes back
        fine   <- the loop takes it in two halves
        where a component had an event inside the interval:
            the loop goes back; interval <- what is before the event, then what is behind it
        where fine differs from coarse by more than is tolerated, and the halves can be halved:
            the loop goes back; interval <- the first half, which is known to be its coarse
        else:
            row <- fine; interval <- the next one, twice as long where the error is small

Between communication points what drives the loop from outside is interpolated linearly, or holds.

The difference of one step and two halves estimates the error of the latter by Richardson's
extrapolation (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
section II.4): ``(fine - coarse) / (2**p - 1)`` for a loop of order p, of all continuous outputs
except those that lag and that nothing in the loop reads.

What is before an event is taken again with other inputs at its end, so that the event may then come
a little earlier, where the interval is divided again, or a little later, in the next one.

A jump that the loop follows may have no solution there: with the event inside the interval the
inputs put it off until behind the end, without it they do not. How far these two are apart goes
with the square of the interval. So the last part of it, where the event is, is taken for itself,
until they are the same. What is compared of an output that jumps are its left limits: at the end
of an interval fine may have had an event that coarse has not had yet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.clock import REPETITIONS
from cosim.core.contracts import Block, Stopped
from cosim.core.recording import Substep
from cosim.core.stages.coupling import Advancing, Cut, Stage, stop_of
from cosim.core.stages.divided_step import DividedStep, kept_columns
from cosim.core.stages.followed_loop import FollowedLoop
from cosim.core.stages.spans import Span, StepPart
from cosim.core.stages.substep_control import SubstepControl
from cosim.errors import RunError


class _Event(NamedTuple):
    """An event inside a part."""

    time: float  # [s]
    component: str


class _Taken(NamedTuple):
    """A part that was taken at once or in two halves, as far as the loop came."""

    end: Vector | None  # the row at its end; None: the loop does not come there
    event: _Event | None = None  # the first one inside
    cut: Cut | None = None  # why the loop does not come to the end
    middle: Vector | None = None  # the row where the halves meet
    error: float | None = None  # in units of what is tolerated; None: there are no halves


@final
class SubsteppedLoop:
    """Advances a loop in substeps.

    Parameters
    ----------
    loop : Stage
    control : SubstepControl
    advancing : Advancing
        Advances its components over communication steps, and so over parts of one.
    """

    def __init__(self, loop: Stage, control: SubstepControl, advancing: Advancing) -> None:
        members = loop.members
        self._control = control
        self._members = members
        self._locating = [m for m in members if m.channel.interface.locates_events]
        self._advancing = advancing
        self._columns = kept_columns(members)
        self._following = FollowedLoop(loop, control)

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns; see :class:`cosim.core.stages.coupling.Advancing`."""
        for k in range(block.steps):
            step = DividedStep(block.part(k, k + 1), signals[k : k + 2])
            try:
                if self._control.recorded is None:
                    self._advance(step)
                else:
                    self._following.advance(step, self._control.recorded)
            except Cut as cut:
                raise Cut(k, cut.error, cut.component) from cut

    def _advance(self, step: DividedStep) -> None:
        control = self._control
        waiting = [control.first(step.span)]  # the next one last
        row = step.signals[0].copy()
        coarse: Vector | None = None
        while waiting:
            part = waiting.pop()
            states = self._save()
            taken = self._attempt(step, part, row, coarse, states)
            coarse = None
            if taken.event is not None:
                self._restore(states)
                self._divide(step, part, taken.event, waiting)
            elif taken.end is None and part.event and part.has_halves:
                self._restore(states)
                self._add(part, error=math.inf)
                waiting += part.last_and_rest
            elif taken.error is not None and taken.error > 1.0 and control.can_refine(part):
                self._restore(states)
                self._add(part, error=taken.error)
                waiting.append(part.halves[0])
                coarse = taken.middle
            else:
                row = self._accept(part, taken)
                waiting += control.next(part, taken.error)
        step.signals[1, self._columns] = row[self._columns]

    def _attempt(
        self,
        step: DividedStep,
        part: StepPart,
        row: Vector,
        coarse: Vector | None,
        states: Sequence[Any],
    ) -> _Taken:
        """Take a part at once, unless ``coarse`` is its row already, and in two halves."""
        if coarse is None:
            whole = self._take(step, part, row)
            if whole.event is not None or not part.has_halves:
                return whole
            if whole.end is None and part.event:
                return whole
            coarse = whole.end
            self._restore(states)
        first, second = part.halves
        half = self._take(step, first, row)
        if half.end is None or half.event is not None:
            return half._replace(end=None, middle=half.end, error=math.inf)
        fine = self._take(step, second, half.end)
        return fine._replace(middle=half.end, error=self._error(row, coarse, fine.end))

    def _take(self, step: DividedStep, part: StepPart, row: Vector) -> _Taken:
        """Advance the loop over a part at once."""
        block, rows = step.rows(part.begin, part.end, row, self._control.outside)
        try:
            self._advancing.advance(block, rows)
        except Cut as cut:
            return _Taken(None, cut=cut)
        return _Taken(rows[1], self._event_inside(step, part))

    def _event_inside(self, step: DividedStep, part: StepPart) -> _Event | None:
        """Return the first event of a component inside a part that was taken, at neither end.

        Raises
        ------
        Cut
            If one does not tell it.
        """
        close = 2.0 * math.ulp(step.end)  # to an end: what is between could not be taken
        events = []
        for member in self._locating:
            try:
                time = member.component.first_event()
            except RunError as error:
                stop = stop_of(error, member, np.array([part.begin]))
                raise Cut(0, stop, member.name) from error
            events.append(_Event(time, member.name))
        inside = [event for event in events if part.begin + close < event.time < part.end - close]
        return min(inside, default=None)

    def _divide(
        self, step: DividedStep, part: StepPart, event: _Event, waiting: list[StepPart]
    ) -> None:
        """Put what is before an event inside a part, and what is behind it, in the place of it.

        Raises
        ------
        Cut
            If there are too many.
        """
        if step.standstill.lasts(part.begin):
            reason = (
                f"{REPETITIONS} events at t = {part.begin} s, the last at {event.time} s, do not "
                "advance time"
            )
            stop = Stopped(np.empty((0, 0)), reason).at(event.component, event.time)
            raise Cut(0, stop, event.component)
        self._add(part, event=event.component)
        # A part that ends at an event ended where this one seemed to be: that is no end any more.
        end = waiting.pop().end if part.event else part.end
        waiting += self._control.next(part, None)
        waiting.append(Span.between(event.time, end).whole)
        waiting.append(Span.between(part.begin, event.time, event.component).whole)

    def _accept(self, part: StepPart, taken: _Taken) -> Vector:
        """Keep a part that was taken; return the row at its end.

        Raises
        ------
        Cut
            If the loop does not come to its end.
        """
        if taken.cut is not None:
            raise taken.cut
        assert taken.end is not None
        if taken.middle is None:
            self._add(part, event=part.event, row=taken.end)
            return taken.end
        first, second = part.halves
        self._add(first, error=taken.error, row=taken.middle)
        self._add(second, error=taken.error, event=part.event, row=taken.end)
        return taken.end

    def _error(self, row: Vector, coarse: Vector | None, fine: Vector | None) -> float:
        """Return the error that is estimated of the two halves, in units of what is tolerated."""
        if coarse is None or fine is None:
            return math.inf
        compared = self._control.compared
        size = np.fmax(np.abs(row[compared]), np.abs(fine[compared]))
        tolerated = self._control.tolerated(size)
        difference = np.abs(fine[compared] - coarse[compared])
        difference[np.isnan(fine[compared]) & np.isnan(coarse[compared])] = 0.0
        differs = difference != 0.0
        ratios = difference[differs] / tolerated[differs]
        worst = float(ratios.max(initial=0.0))
        if math.isnan(worst):
            return math.inf
        return worst / (2.0**self._control.order - 1.0)

    def _add(
        self,
        part: StepPart,
        *,
        error: float | None = None,
        event: str = "",
        row: Vector | None = None,
    ) -> None:
        """Keep a part that was taken; one without a row was refused."""
        values = () if row is None else tuple(row[self._columns].tolist())
        loop = self._members[0].name
        self._control.add(
            Substep(part.begin, part.end, loop, error, row is not None, event, values)
        )

    def _save(self) -> list[Any]:
        return [member.component.save() for member in self._members]

    def _restore(self, states: Sequence[Any]) -> None:
        for member, state in zip(self._members, states, strict=True):
            member.component.restore(state)
