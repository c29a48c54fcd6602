"""A co-simulation unit as a component.

One communication step from t0 to t1, usually in one part, else in several (s0 to s1 in fractions of the step)::

    event at t0, where a discrete input is not as before and the unit has event mode
    until s0 = 1:
        s1 = 1, or the next time event
        interpolating unit:   set inputs u(s0); set_input_derivatives (u1 - u0)/h; do_step     its outputs belong to u_end = u(s1)
                              (an input that cannot follow its line there: as below)
        any other:            set inputs (u(s0) + u(s1))/2; do_step                            its outputs belong to u_end = that
                              (the same again after an early return, so that their integral up to s1 is right)
        (held and discrete:   u0, no slope                                                     u_end = u0)
        discarded:            back to s0, and in two halves from there to s1
        else:                 s0 = where it returned; event there, where the unit asks for it
    y <- outputs + D (u1 - u_end), where the unit gives D by directional derivatives at t1
         (outputs after an event with the inputs u1, where a discrete one changes at t1)
    (event:                   enter event mode, set inputs, update_discrete_states until settled, enter step mode)

The mean makes the states second order. FMI forbids setting inputs and then reading outputs without a step or an event between
(FMI 2.0.4 section 4.2.4), so that is never done: the correction asks for D alone.

What a discrete input does at t1 a loop may still correct, as in ``motion.py``: a unit that can go back shows its
outputs after the event and goes back; one that cannot is left behind it.

The end of the run that a unit asks for is remembered, and comes with the next ``advance`` at the latest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.errors import FmuError, RunError
from cosim.fmi.binary.messages import Message
from cosim.fmi.description import Description
from cosim.fmi.driving.direct import Direct
from cosim.fmi.driving.events import settle
from cosim.fmi.driving.inner_step import InnerStep
from cosim.fmi.driving.saved import SavedState, save
from cosim.fmi.driving.start import Start, Starts
from cosim.fmi.unit import TERMINATED, CoSimulationUnit, StepEnd

PARTS: Final = 1000  # of one communication step, by early returns and time events
HALVINGS: Final = 10  # of a step that is discarded
CLOSE: Final = 1e-9  # of a communication step: times that are the same


@dataclass(slots=True)
class _Ramp:
    """The inputs over one communication step; instants in it are fractions of it, so that its ends and halves are exact."""

    t: float  # [s]
    h: float  # [s]
    u0: Vector
    u1: Vector
    change: Vector

    def time(self, s: float) -> float:
        """Give the time [s]."""
        return self.t + s * self.h if s else self.t

    def at(self, s: float) -> Vector:
        """Give the inputs."""
        return self.u1 if s == 1.0 else self.u0 + s * self.change if s else self.u0

    def fraction(self, time: float) -> float:
        """Give the instant; the ends where it is close to them."""
        s = (time - self.t) / self.h
        return next((end for end in (0.0, 1.0) if abs(s - end) <= CLOSE), s)


@final
class CoSimulation:
    """A co-simulation unit.

    Parameters
    ----------
    unit : CoSimulationUnit
        Just instantiated.
    starts : mapping of variable name to StartValue
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If a start value is wrong.
    """

    def __init__(self, unit: CoSimulationUnit, *, starts: Starts | None = None) -> None:
        description = unit.description
        self._unit, self._name = unit, description.name
        self.interface = unit.interface
        self._start = Start(unit, starts or {})
        self._can = description.capabilities["cs"]
        self._outputs = description.references("output")
        discrete = description.discrete_inputs
        self._stepped = _Inputs(description, ~discrete if self._can.event_mode else np.ones_like(discrete))
        self._jumping = _Inputs(description, discrete & self._can.event_mode)
        self._inputs = description.references("input")
        self._lined = description.interpolated_inputs
        self._sloped, self._mixed = _Inputs(description, self._lined), bool((~discrete & ~self._lined).any())
        self._in_events = frozenset(s.name for s in self.interface.inputs if self._can.event_mode and s.variability == "discrete")
        self._direct = Direct(unit, self._in_events) if self._can.directional_derivatives else None
        self._goes_back = self._can.saves_state and self._can.variable_step and not description.undoes_discarded_steps
        self._kept: object | None = None  # the unit's state before the last part; its memory is used again
        self._before: object | None = None  # and before an event that is only shown
        self._inner_step = InnerStep(_watched(description))
        self._said: set[str] = set()  # what messages were about
        self._news: list[Message] = []
        self._hold(discrete)
        self._forget(np.zeros(len(discrete)), np.zeros(self._outputs.size))

    def _hold(self, held: Mask) -> None:
        self._held, self._holds = held, bool(held.any())

    def _forget(self, u: Vector, y: Vector) -> None:
        self._read, self._end = y, u
        self._given = self._jumping.of(u)  # discrete inputs, where they are set in events
        self._interpolates = self._can.interpolates_inputs and self._sloped.references.size > 0
        self._next_event: float | None = None
        self._ended = False  # the unit asked for the end of the run
        self._inner_step.reset()

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Learn which inputs are held; nothing is designed.

        Raises
        ------
        FmuError
            If the unit has a fixed inner step and ``h`` is not a whole number of them.
        """
        fixed = self._can.fixed_step
        if fixed and not self._can.variable_step and abs(round(h / fixed) * fixed - h) > 1e-9 * h:
            raise FmuError(
                f"{self._name}: the communication step {h} s is not a whole number of the unit's inner steps of {fixed} s; "
                f"nearest: {max(1, round(h / fixed)) * fixed} s"
            )
        self._hold(held | self._unit.description.discrete_inputs)
        return {}

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the results."""
        face = self.interface
        corrected = self._direct.corrected if self._direct else ()
        fed = [o.name for o in face.outputs if o.name not in corrected and not self._in_events.issuperset(face.feeds(o.name))]
        if not fed:
            return ()
        verb = "may depend" if not all(face.knows(name) for name in fed) else "depend" if len(fed) > 1 else "depends"
        where = (
            "where inputs are held, what is read belongs to their value"
            if self._interpolates
            else "what is read belongs to the inputs"
        )
        why = "directional derivatives are for real variables" if self._direct else "the unit has no directional derivatives"
        return (
            f"{self._name}: {', '.join(fed)} {verb} directly on inputs; {where} inside the step, not at its end (first order in "
            f"the step), as {why}",
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        u = np.array(u, np.float64)
        self._forget(u, self._start.enter(t, u))
        return self._read.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs last read, corrected to the inputs ``u`` where D is known; after an event where one is due."""
        self._leave_initialization(t)
        return self._look(t, np.array(u, np.float64)).copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        rows, k = list(np.array(u, np.float64, order="C")), 0
        y = np.empty((len(rows) - 1, self._outputs.size))
        try:
            instants = t.tolist()
            self._leave_initialization(instants[0])
            for k, t0 in enumerate(instants[:-1]):
                completed = self._step(t0, h, rows[k], rows[k + 1])
                if completed and k < len(y) - 1:
                    self._jump(instants[k + 1], rows[k + 1])
                if completed:
                    y[k] = self._look(instants[k + 1], rows[k + 1])
                if self._ended:
                    raise Stopped(y[: k + completed].copy(), TERMINATED, failed=False)
        except Stopped:
            raise
        except RunError as error:
            raise Stopped(y[:k].copy(), str(error)) from error
        return y

    def _leave_initialization(self, t: float) -> None:
        if self._start.leave() and self._can.event_mode:  # the unit is in it now
            self._settle(t)
            self._read = self._unit.get_float64(self._outputs)

    def _look(self, t: float, u: Vector) -> Vector:
        """Give the outputs at ``t``, the time reached, for inputs ``u``; goes back before an event, if the unit can."""
        if self._can.saves_state and self._jumps(u):
            self._before = self._unit.get_fmu_state(self._before)
            own = self._own()
            self._jump(t, u)
            y = self._outputs_for(u)
            if not self._ended:
                self._unit.set_fmu_state(self._before)
                self._set_own(own)
            return y
        self._jump(t, u)
        return self._outputs_for(u)

    def _outputs_for(self, u: Vector) -> Vector:
        """Give y + D (u - u_end)."""
        return self._read if self._direct is None or u is self._end else self._direct.add(self._read, u - self._end)

    # --- one communication step ---

    def _step(self, t: float, h: float, u0: Vector, u1: Vector) -> bool:
        """Do one communication step; False: the unit asked for the end of the run inside it."""
        change = u1 - u0
        if self._holds:
            change[self._held] = 0.0
            u1 = np.where(self._held, u0, u1)
        ramp = _Ramp(t, h, u0, u1, change)
        self._jump(t, u0)
        if self._cross(ramp, 0.0, 1.0, 0) < 1.0:
            return False
        self._read = self._unit.get_float64(self._outputs)
        if self._inner_step.seen is not None:
            self._look_for_an_inner_step(h)
        return True

    def _look_for_an_inner_step(self, h: float) -> None:
        n = self._inner_step.see(self._read, self._end)
        if n:
            self._say(
                "inner step",
                f"its outputs change at every {_ordinal(n)} communication step only: it seems to keep an inner step of "
                f"{n * h:.12g} s and to ignore the communication step of {h} s",
            )

    def _cross(self, ramp: _Ramp, s0: float, s1: float, halvings: int) -> float:
        """Go from ``s0`` to ``s1``, in halves where the unit discards the whole; give how far the unit came."""
        begin = goal = s0
        for _ in range(PARTS):
            if self._ended:
                return s0
            if goal != (goal := s1 if self._next_event is None else self._goal(ramp, s0, s1, self._next_event)):
                begin = s0
            end = self._part(ramp, s0, goal, 0.5 * (begin + goal))
            self._ended |= end.terminate
            if end.completed:
                s0 = goal
            elif end.discarded:
                s0 = self._halve(ramp, s0, goal, halvings)
            elif not end.terminate:
                s0 = self._returned(ramp, s0, goal, end.reached)
            if self._can.event_mode and not self._ended and (end.event or self._due(ramp, s0)):
                self._event(ramp.time(s0))
            if s0 >= s1:
                return s0
        raise RunError(
            f"{self._name}: {PARTS} returns did not reach the end of the step of {ramp.h} s from t = {ramp.t} s; the last was at "
            f"t = {ramp.time(s0)} s"
        )

    def _part(self, ramp: _Ramp, s0: float, s1: float, middle: float) -> StepEnd:
        """Set the inputs, on their lines from ``s0`` or as they are in the ``middle``, and call do_step once."""
        unit, t, h = self._unit, ramp.time(s0), (s1 - s0) * ramp.h
        if self._goes_back:
            self._kept = unit.get_fmu_state(self._kept)
        if not self._interpolates:
            self._end = ramp.at(middle)
            unit.set_float64(self._stepped.references, self._stepped.of(self._end))
            return unit.do_step(t, h)
        unit.set_float64(self._stepped.references, self._stepped.of(self._on_lines(ramp, s0, middle)))
        slopes = self._sloped.of(ramp.change) / ramp.h
        unit.set_input_derivatives(self._sloped.references, slopes)
        end = unit.do_step(t, h)
        if end.followed == -math.inf and slopes.any():
            self._stops_interpolating(t)
        followed = s1 if end.followed == math.inf else min(max(s0, ramp.fraction(end.followed)), s1)
        self._end = self._on_lines(ramp, followed, middle)
        return end

    def _on_lines(self, ramp: _Ramp, s: float, middle: float) -> Vector:
        """Give the inputs at ``s``; those that cannot follow their line as they are in the middle."""
        return np.where(self._lined, ramp.at(s), ramp.at(middle)) if self._mixed else ramp.at(s)

    def _stops_interpolating(self, t: float) -> None:
        self._interpolates = False
        self._say(
            "interpolation",
            f"asked for no inputs in the step from t = {t} s, though it says it can (providesIntermediateUpdate): they stayed at "
            "their start there; from then on it gets their mean, and what outputs show of inputs directly belongs to that",
        )

    def _halve(self, ramp: _Ramp, s0: float, s1: float, halvings: int) -> float:
        """Go back before a step that was discarded, and from there in two halves."""
        undone = self._unit.description.undoes_discarded_steps
        if not self._can.variable_step:
            reason = "it takes steps of one size only (canHandleVariableCommunicationStepSize is false)"
        elif not (undone or self._can.saves_state):
            reason = "its state before the step cannot be restored (canGetAndSetFMUstate is false, or not true)"
        elif halvings == HALVINGS:
            reason = f"the communication step of {ramp.h} s was halved {HALVINGS} times"
        else:
            if not undone:
                self._unit.set_fmu_state(self._kept)
            middle = 0.5 * (s0 + s1)
            reached = self._cross(ramp, s0, middle, halvings + 1)
            return self._cross(ramp, middle, s1, halvings + 1) if reached >= middle else reached
        raise RunError(
            f"{self._name}: discarded the step of {(s1 - s0) * ramp.h} s from t = {ramp.time(s0)} s; no smaller one is tried, as "
            f"{reason}"
        )

    def _returned(self, ramp: _Ramp, s0: float, s1: float, reached: float) -> float:
        """Give where the unit returned early."""
        s = ramp.fraction(reached)
        if not s0 <= s <= s1:
            raise RunError(
                f"{self._name}: returned early at t = {reached} s from the step from {ramp.time(s0)} s to {ramp.time(s1)} s; "
                "needed a time in it"
            )
        return s

    # --- events ---

    def _goal(self, ramp: _Ramp, s0: float, s1: float, event: float) -> float:
        """Give the next time event, if the unit can stop there, else ``s1``."""
        s = ramp.fraction(event)
        if not s0 < s < s1:
            return s1
        if self._can.variable_step:
            return s
        self._say(
            "time event",
            f"the time event at t = {event} s is met at the end of the communication step only, as it takes steps of one size "
            "(canHandleVariableCommunicationStepSize is false)",
        )
        return s1

    def _due(self, ramp: _Ramp, s: float) -> bool:
        """Whether the next time event is not after ``s``."""
        return self._next_event is not None and ramp.fraction(self._next_event) <= s

    def _jumps(self, u: Vector) -> bool:
        """Whether a discrete input that is set in events is not as before."""
        return self._can.event_mode and not self._ended and self._jumping.of(u).tobytes() != self._given.tobytes()

    def _jump(self, t: float, u: Vector) -> None:
        """Set all inputs in an event, if a discrete one changes; the outputs then belong to them."""
        if self._jumps(u):
            self._event(t, u)
            self._read = self._unit.get_float64(self._outputs)

    def _event(self, t: float, u: Vector | None = None) -> None:
        self._unit.enter_event_mode()
        if u is not None:
            self._unit.set_float64(self._inputs, u)
            self._given, self._end = self._jumping.of(u), u
        self._settle(t)

    def _settle(self, t: float) -> None:
        """Let the discrete states settle, and leave event mode."""
        found = settle(self._unit, t)
        self._next_event, self._ended = found.next_event_time, found.terminate
        if not self._ended:
            self._unit.enter_step_mode()

    # --- messages, states ---

    def drain(self) -> list[Message]:
        """Give what the run showed about the unit since the last call; each kind is said once."""
        news, self._news = self._news, []
        return news

    def _say(self, about: str, text: str) -> None:
        if about not in self._said:
            self._said.add(about)
            self._news.append(Message("warning", "", f"{self._name}: {text}"))

    def save(self) -> SavedState:
        """Copy the state.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        return save(self._unit, self._can, self._own())

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._unit.set_fmu_state(state.unit)
        self._set_own(state.own)

    def _own(self) -> tuple[object, ...]:
        """Give what belongs to the state beside the unit's own; arrays are replaced, never written to."""
        own = (self._start.t, self._read, self._end, self._given, self._next_event, self._ended, self._interpolates)
        return (*own, self._inner_step.seen)

    def _set_own(self, state: tuple[object, ...]) -> None:
        self._start.t, self._read, self._end, self._given, *own = state  # type: ignore[assignment]
        self._next_event, self._ended, self._interpolates, self._inner_step.seen = own  # type: ignore[assignment]


@final
class _Inputs:
    """Some of the inputs: those that are set together."""

    def __init__(self, description: Description, chosen: Mask) -> None:
        variables = [v for _, group in description.ports("input") for v in group]
        firsts = np.cumsum([0, *(v.size for v in variables)])
        self.references = description.reference(v.name for v, i in zip(variables, firsts, strict=False) if chosen[i])
        self._columns = None if chosen.all() else np.flatnonzero(chosen)  # None: all

    def of(self, values: Vector) -> Vector:
        """Give their values."""
        return values if self._columns is None else values[self._columns]


def _watched(description: Description) -> NDArray[np.intp]:
    """Give the outputs that show whether time moves in the unit: real, continuous, if possible not fed directly by inputs."""
    face = description.interface
    moving = [output for output in face.outputs if output.kind == "real" and output.variability == "continuous"]
    chosen = {o.name for o in moving if not face.feeds(o.name)} or {o.name for o in moving}
    columns = face.output_columns()
    return np.array([i for name in columns if name in chosen for i in range(columns[name].start, columns[name].stop)], np.intp)


def _ordinal(n: int) -> str:
    ending = "th" if 10 <= n % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"
