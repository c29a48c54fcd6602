"""A co-simulation unit moving through communication steps: its inputs, its parts, its events.

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

What a discrete input does at t1 a loop may still correct, as in ``motion.py``: a unit that can go back shows its outputs after
the event and goes back; one that cannot is left behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.errors import RunError
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.events import settle
from cosim.fmi.instance import CoSimulationInstance, StepEnd

PARTS: Final = 1000  # of one communication step, by early returns and time events
HALVINGS: Final = 10  # of a step that is discarded
CLOSE: Final = 1e-9  # of a communication step: times that are the same


@dataclass(slots=True)
class StepperState:
    """Where a unit is. Arrays are replaced, never written to, so that a shallow copy keeps the state."""

    read: Vector  # the outputs, as they were read last
    end: Vector  # the inputs that they belong to
    given: Vector  # the inputs that are set in events, as the unit has them
    interpolates: bool
    next_event: float | None = None  # [s]
    ended: bool = False  # the unit asked for the end of the run


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
class Stepper:
    """Where a unit is, and what moves it on.

    Parameters
    ----------
    unit : CoSimulationInstance
    remarks : Diagnostics
        Takes what the run shows about the unit.

    Attributes
    ----------
    now : Reached
    """

    def __init__(self, instance: CoSimulationInstance, remarks: Diagnostics) -> None:
        description = instance.description
        self._instance, self._name, self._remarks = instance, description.name, remarks
        self._can = can = description.capabilities["cs"]
        self._outputs, self._inputs = (
            description.references("output"),
            description.references("input"),
        )
        discrete = description.discrete_inputs
        self._stepped = self._inputs.select(~discrete if can.event_mode else np.ones_like(discrete))
        self._jumping = self._inputs.select(discrete & can.event_mode)
        self._lined = description.interpolated_inputs
        self._sloped, self._mixed = (
            self._inputs.select(self._lined),
            bool((~discrete & ~self._lined).any()),
        )
        self._goes_back = (
            can.saves_state and can.variable_step and not description.undoes_discarded_steps
        )
        self._kept: object | None = (
            None  # the unit's state before the last part; its memory is used again
        )
        self.hold(discrete)
        self.begin(np.zeros(len(discrete)), np.zeros(self._outputs.size))

    def hold(self, held: Mask) -> None:
        """Learn which inputs keep their value over a step; discrete ones do."""
        self._held = held | self._instance.description.discrete_inputs
        self._holds = bool(self._held.any())

    def begin(self, u: Vector, y: Vector) -> None:
        """Forget the past: the unit is in initialization mode, with these inputs and outputs."""
        able = self._can.interpolates_inputs and self._sloped.size > 0
        self.now = StepperState(read=y, end=u, given=self._jumping.take(u), interpolates=able)

    def leave_initialization(self, t: float) -> None:
        """Settle what the initialization left, if the unit is in event mode now."""
        if self._can.event_mode:
            self._settle(t)
            self.now.read = self._instance.get_float64(self._outputs)

    def save(self) -> StepperState:
        """Copy everything but the unit's own state."""
        return replace(self.now)

    def restore(self, state: StepperState) -> None:
        """Go back to a saved state, after the unit."""
        self.now = replace(state)

    def step(self, t: float, h: float, u0: Vector, u1: Vector) -> bool:
        """Do one communication step; False: the unit asked for the end of the run inside it."""
        change = u1 - u0
        if self._holds:
            change[self._held] = 0.0
            u1 = np.where(self._held, u0, u1)
        ramp = _Ramp(t, h, u0, u1, change)
        self.jump(t, u0)
        if self._cross(ramp, 0.0, 1.0, 0) < 1.0:
            return False
        self.now.read = self._instance.get_float64(self._outputs)
        return True

    def _cross(self, ramp: _Ramp, s0: float, s1: float, halvings: int) -> float:
        """Go from ``s0`` to ``s1``, in halves where the unit discards the whole; give how far the unit came."""
        begin, goal, now = s0, s0, self.now
        for _ in range(PARTS):
            if now.ended:
                return s0
            if goal != (
                goal := s1 if now.next_event is None else self._goal(ramp, s0, s1, now.next_event)
            ):
                begin = s0
            end = self._part(ramp, s0, goal, 0.5 * (begin + goal))
            now.ended |= end.terminate
            if end.completed:
                s0 = goal
            elif end.discarded:
                s0 = self._halve(ramp, s0, goal, halvings)
            elif not end.terminate:
                s0 = self._returned(ramp, s0, goal, end.last_successful_time)
            if self._can.event_mode and not now.ended and (end.event_needed or self._due(ramp, s0)):
                self._event(ramp.time(s0))
            if s0 >= s1:
                return s0
        raise RunError(
            f"{self._name}: {PARTS} returns did not reach the end of the step of {ramp.h} s from t = {ramp.t} s; the last was at "
            f"t = {ramp.time(s0)} s"
        )

    def _part(self, ramp: _Ramp, s0: float, s1: float, middle: float) -> StepEnd:
        """Set the inputs, on their lines from ``s0`` or as they are in the ``middle``, and call do_step once."""
        instance, t, h = self._instance, ramp.time(s0), (s1 - s0) * ramp.h
        if self._goes_back:
            self._kept = instance.get_fmu_state(self._kept)
        if not self.now.interpolates:
            self.now.end = ramp.at(middle)
            instance.set_float64(self._stepped, self._stepped.take(self.now.end))
            return instance.do_step(t, h)
        instance.set_float64(self._stepped, self._stepped.take(self._on_lines(ramp, s0, middle)))
        slopes = self._sloped.take(ramp.change) / ramp.h
        instance.set_input_derivatives(self._sloped, slopes)
        end = instance.do_step(t, h)
        if end.interpolated_until == -math.inf and slopes.any():
            self._stops_interpolating(t)
        followed = s1 if end.interpolated_until == math.inf else min(max(s0, ramp.fraction(end.interpolated_until)), s1)
        self.now.end = self._on_lines(ramp, followed, middle)
        return end

    def _on_lines(self, ramp: _Ramp, s: float, middle: float) -> Vector:
        """Give the inputs at ``s``; those that cannot follow their line as they are in the middle."""
        return np.where(self._lined, ramp.at(s), ramp.at(middle)) if self._mixed else ramp.at(s)

    def _stops_interpolating(self, t: float) -> None:
        self.now.interpolates = False
        self._remarks.add(
            t,
            "interpolation",
            f"asked for no inputs in the step from t = {t} s, though it says it can (providesIntermediateUpdate): they stayed at "
            "their start there; from then on it gets their mean, and what outputs show of inputs directly belongs to that",
        )

    def _halve(self, ramp: _Ramp, s0: float, s1: float, halvings: int) -> float:
        """Go back before a step that was discarded, and from there in two halves."""
        undone = self._instance.description.undoes_discarded_steps
        if not self._can.variable_step:
            reason = (
                "it takes steps of one size only (canHandleVariableCommunicationStepSize is false)"
            )
        elif not (undone or self._can.saves_state):
            reason = "its state before the step cannot be restored (canGetAndSetFMUstate is false, or not true)"
        elif halvings == HALVINGS:
            reason = f"the communication step of {ramp.h} s was halved {HALVINGS} times"
        else:
            if not undone:
                self._instance.set_fmu_state(self._kept)
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
        self._remarks.add(
            ramp.time(s0),
            "time event",
            f"the time event at t = {event} s is met at the end of the communication step only, as it takes steps of one size "
            "(canHandleVariableCommunicationStepSize is false)",
        )
        return s1

    def _due(self, ramp: _Ramp, s: float) -> bool:
        """Whether the next time event is not after ``s``."""
        return self.now.next_event is not None and ramp.fraction(self.now.next_event) <= s

    def jumps(self, u: Vector) -> bool:
        """Whether a discrete input that is set in events is not as before."""
        return (
            self._can.event_mode
            and not self.now.ended
            and self._jumping.take(u).tobytes() != self.now.given.tobytes()
        )

    def jump(self, t: float, u: Vector) -> None:
        """Set all inputs in an event, if a discrete one changes; the outputs then belong to them."""
        if self.jumps(u):
            self._event(t, u)
            self.now.read = self._instance.get_float64(self._outputs)

    def _event(self, t: float, u: Vector | None = None) -> None:
        self._instance.enter_event_mode()
        if u is not None:
            self._instance.set_float64(self._inputs, u)
            self.now.given, self.now.end = self._jumping.take(u), u
        self._settle(t)

    def _settle(self, t: float) -> None:
        """Let the discrete states settle, and leave event mode."""
        found = settle(self._instance, t)
        self.now.next_event, self.now.ended = found.next_event_time, found.terminate
        if not found.terminate:
            self._instance.enter_step_mode()
