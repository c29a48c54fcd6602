"""Step a co-simulation FMU through communication steps: its inputs, its parts, its events.

One communication step from t0 to t1, usually in one part, else in several (s0 to s1 in fractions of
the step)::

    event at t0, where a discrete input is not as before and the FMU has event mode, or a clock
                 ticks
    until s0 = 1:
        s1 = 1, or the next time event or tick of a clock
        an FMU that interpolates: set inputs u(s0); set_input_derivatives (u1 - u0)/h; do_step
                                  its outputs belong to u_end = u(s1)
                                  (an input that cannot be interpolated there: as below)
        any other:                set inputs (u(s0) + u(s1))/2, or u1 where the mean would be none
                                  of the signal's values; do_step
                                  its outputs belong to u_end = that
                                  (the same again after an early return, so that their integral up
                                  to s1 is right)
        (held and discrete:       u0, no slope
                                  u_end = u0)
        discarded:                back to s0, and in two halves from there to s1
        else:                     s0 = where it returned; event there, where the FMU requests it
    y <- outputs + D (u1 - u_end), where the FMU gives D by directional derivatives at t1
         (outputs after an event with the inputs u1, where a discrete one changes at t1)
    (event: enter event mode, set inputs, update_discrete_states until no update is needed,
            enter step mode; with clocks, see ``clocks.py``)

The mean makes the states second order. FMI forbids setting inputs and then reading outputs without
a step or an event between (FMI 2.0.4 section 4.2.4, FMI 3.0 section 4.2.1), so that is never done:
the correction needs D alone.

The usual step, in one part, is compiled too (``co_simulation.c``): it leaves every other one to the
methods here, and notes what it has done of it.

What a discrete input does at t1 a loop may still correct, as in ``integrator.py``: an FMU that can
go back shows its outputs after the event and goes back; one that cannot is left behind it.
"""

from __future__ import annotations

import math
from ctypes import addressof
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Vector
from cosim.core.clock import REPETITIONS, Standstill
from cosim.errors import RunError
from cosim.fmi.description import Description
from cosim.fmi.driving.clocks import ClockState, Event, EventClocks
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.direct import DirectFeedthrough
from cosim.fmi.driving.inner_step import InnerStep, StepHistory
from cosim.fmi.driving.input_ramp import CLOSE, InputRamp
from cosim.fmi.driving.step_inputs import InputDerivativesFailed, StepInputs
from cosim.fmi.driving.tuning import TunedParameters
from cosim.fmi.instance import Addresses, CoSimulationInstance, StepEnd
from cosim.native.fmi.co_simulation import (
    COMPLETED,
    FAILED,
    NOTHING,
    SLOPES_FAILED,
    STEPPED,
    UNREAD,
    CoSimulationCopyStruct,
    CoSimulationStruct,
)
from cosim.native.library import address, pointer
from cosim.native.memory import place, place_struct
from cosim.native.step import NativeStep, RollbackStruct

HALVINGS: Final = 10  # of a step that is discarded


@dataclass(frozen=True, slots=True)
class StepperState:
    """A copy of the state of an FMU at one time."""

    outputs: Vector  # as they were read last
    inputs: Vector  # that those outputs belong to
    event_inputs: Vector  # those that are set in events, as the FMU has them
    initialized: bool  # the initialization was left
    interpolates: bool
    stepped: bool  # a communication step was completed
    next_event: float  # [s]; infinity: none
    ended: bool  # the FMU requested the end of the run
    step_history: StepHistory | None
    clocks: ClockState


@final
class Stepper:
    """Steps an FMU and handles its events.

    Parameters
    ----------
    instance : CoSimulationInstance
    diagnostics : Diagnostics
        Takes what the run shows about the FMU.
    clocks : EventClocks
        Its clocks.
    feedthrough : DirectFeedthrough or None
        Its D, where it gives one.

    Attributes
    ----------
    outputs : Vector, shape (n_y,)
        As they were read last.
    inputs : Vector, shape (n_u,)
        That those outputs belong to.
    inner_steps : float
        The inner step of the FMU, in communication steps, where the last step showed it; else 0.
    keeps_left : bool
        Whether the outputs before an event at the end of a step are read.
    left : Vector or None
        Those of the last step; None: it had no such event.
    """

    def __init__(
        self,
        instance: CoSimulationInstance,
        diagnostics: Diagnostics,
        clocks: EventClocks,
        feedthrough: DirectFeedthrough | None,
    ) -> None:
        description = instance.description
        capabilities = description.capabilities["cs"]
        discrete = description.discrete_inputs
        self._instance = instance
        self._name = description.name
        self._capabilities = capabilities
        self._diagnostics = diagnostics
        self._clocks = clocks
        self._feedthrough = feedthrough
        self._outputs = description.references("output")
        inputs = description.references("input")
        # Inputs that belong to a clock are set where it ticks, and clocks by calls of their own.
        self._unclocked_inputs = description.unclocked("input")
        unclocked = np.zeros_like(discrete)
        unclocked[self._unclocked_inputs.columns] = True
        set_in_steps = ~discrete if capabilities.event_mode else np.ones_like(discrete)
        self._event_inputs = inputs.select(discrete & unclocked & capabilities.event_mode)
        self._struct = place_struct(CoSimulationStruct)
        self._step_inputs = StepInputs(
            instance, diagnostics, inputs.select(set_in_steps & unclocked), self._struct
        )
        self._saves_before_steps = (
            capabilities.saves_state
            and capabilities.variable_step
            and not description.undoes_discarded_steps
        )
        self._fmu_state: object | None = None  # before the last part; its memory is used again
        self._addresses: Addresses | None = None
        self._copy: tuple[object, ...] | None = None  # the memory behind that of compiled code
        n_u = len(discrete)
        self._inner_step = InnerStep(_watched(description), n_u)
        self.inner_steps = 0.0
        self.keeps_left = False
        self.left: Vector | None = None
        self._share_state(n_u)
        self.hold(discrete)
        self.begin(np.zeros(n_u), np.zeros(self._outputs.size))

    def _share_state(self, n_u: int) -> None:
        """Put the state where compiled steps find it."""
        n_y = self._outputs.size
        state = place(np.zeros(n_y + n_u + self._event_inputs.size))
        self.outputs, self.inputs, self._event_values = np.split(state, (n_y, n_y + n_u))
        self._held = place(np.zeros(n_u, np.bool_))
        self._latest = place(np.zeros(n_u, np.bool_))
        self._scratch = place(np.zeros(4 * n_u + n_y))
        struct = self._struct
        struct.n_u = n_u
        struct.n_y = n_y
        struct.n_event = self._event_inputs.size
        struct.held = self._held.ctypes.data
        struct.latest = self._latest.ctypes.data
        struct.ramped = self._step_inputs.ramped.ctypes.data
        struct.event_columns = self._event_inputs.columns.ctypes.data
        struct.inner_step = self._inner_step.address
        struct.outputs = self.outputs.ctypes.data
        struct.inputs = self.inputs.ctypes.data
        struct.event_inputs = self._event_values.ctypes.data
        struct.scratch = self._scratch.ctypes.data
        struct.first_event = math.inf

    def native(self) -> NativeStep | None:
        """Return the compiled step; None: the FMU is none of a binary, or has clocks."""
        addresses = self._instance.addresses()
        if addresses is None or self._instance.description.drives_clocks:
            return None
        struct = self._struct
        struct.fmu = addresses.fmu
        struct.step_inputs = addresses.variables(self._step_inputs.references)
        struct.outputs_read = addresses.variables(self._outputs)
        struct.do_step = addresses.step()
        if self._step_inputs.can_interpolate:
            struct.slopes = addresses.slopes(self._step_inputs.interpolated)
        if self._saves_before_steps:
            struct.get_state = addresses.call("GetFMUState")
        if self._feedthrough is not None:
            self._feedthrough.native(addresses, struct)
        struct.plain = (
            struct.step_inputs.is_direct
            and struct.outputs_read.is_direct
            and not struct.n_event
            and not struct.get_state
            and not struct.feedthrough.n_unknowns
        )
        self._addresses = addresses
        self._keep_fmu_state(self._fmu_state)
        return NativeStep(
            address("cosim_co_simulation_step"),
            struct,
            n_y=self._outputs.size,
            memory=np.zeros(0),
            keep=(self, addresses, self._feedthrough),
            outputs=address("cosim_co_simulation_outputs"),
            own_rollback=self._rollback if self._capabilities.saves_state else None,
            left_outputs=self._left_outputs(),
        )

    def _left_outputs(self) -> tuple[int, int] | None:
        """Return where compiled steps tell left limits; None: nobody asks for them.

        They have no events, so none is ever told.
        """
        if not self.keeps_left:
            return None
        offset = CoSimulationStruct.has_left.offset
        return addressof(self._struct) + offset, self.outputs.ctypes.data

    def _rollback(self) -> RollbackStruct:
        """Return how compiled code goes back; the memory of its copy is kept here."""
        addresses = self._addresses
        assert addresses is not None
        self._instance.may_go_back = True
        state = self._instance.get_fmu_state()
        n_inner = 2 * len(self._inner_step.columns) + len(self.inputs)
        values = np.zeros(len(self.outputs) + len(self.inputs) + len(self._event_values) + n_inner)
        calls = (addresses.call("GetFMUState"), addresses.call("SetFMUState"))
        copy = CoSimulationCopyStruct(*calls, addresses.state(state), pointer(values))
        self._struct.copy = addressof(copy)
        self._copy = (copy, state, values)
        functions = ("cosim_co_simulation_save", "cosim_co_simulation_restore")
        return RollbackStruct(*map(address, functions))

    def _keep_fmu_state(self, state: object | None) -> None:
        """Keep a state of the FMU whose memory is used again."""
        self._fmu_state = state
        if self._addresses is not None:
            self._struct.fmu_state = None if state is None else self._addresses.state(state)

    @property
    def ended(self) -> bool:
        """Whether the FMU requested the end of the run."""
        return bool(self._struct.ended)

    @property
    def stepped(self) -> bool:
        """Whether a communication step was completed."""
        return bool(self._struct.stepped)

    @property
    def first_event(self) -> float:
        """Time of the first event inside the last step [s]; infinity: there was none."""
        first: float = self._struct.first_event
        return first

    @property
    def interpolates(self) -> bool:
        """Whether the FMU gets slopes of its inputs."""
        return self._step_inputs.interpolates

    def hold(self, held: Mask) -> None:
        """Set which inputs keep their value over a step, beside the discrete ones."""
        self._held[:] = held | self._instance.description.discrete_inputs

    @property
    def shares_inner_step(self) -> bool:
        """Whether the inner step that showed may be another one's of its loop."""
        return self._inner_step.is_shared

    def take_wiring(self, latest: Mask, in_loop: Mask) -> None:
        """Set which inputs, where they have one value over a step, have that at its end.

        ``in_loop``: which come from a loop of its own without any discrete output.
        """
        self._latest[:] = latest & ~self._instance.description.discrete_inputs
        self._inner_step.in_loop[:] = in_loop

    def begin(self, u: Vector, y: Vector) -> None:
        """Begin anew, with these inputs and outputs; the FMU is in initialization mode."""
        self._clocks.begin(y)
        self.restore(
            StepperState(
                outputs=y,
                inputs=u,
                event_inputs=self._event_inputs.take(u),
                initialized=False,
                interpolates=self._step_inputs.can_interpolate,
                stepped=False,
                next_event=math.inf,
                ended=False,
                step_history=None,
                clocks=self._clocks.state,
            )
        )
        self._inner_step.reset()

    def begin_without_slopes(self, t: float, u: Vector, y: Vector, reason: str) -> None:
        """Begin anew with an FMU that was instantiated anew, which gets no slopes any more."""
        self._diagnostics.add(
            t,
            "interpolation",
            f"{reason}, though it says that it interpolates inputs (canInterpolateInputs): the run "
            "began again with a new instance, which gets one value of its inputs over a step, and "
            "the direct feedthrough to outputs belongs to that",
        )
        self._step_inputs.can_interpolate = False
        self._keep_fmu_state(None)
        if self._copy is not None:
            self._rollback()  # with a state of the new instance
        self.begin(u, y)

    def leave_initialization(self, t: float) -> None:
        """Handle the event that the initialization ends with; read the outputs after it.

        exit_initialization_mode leads to event mode where the FMU has it (FMI 3.0 section 2.3.3),
        else to step mode, and may change outputs.
        """
        if self._capabilities.event_mode:
            self._iterate_event(Event(t, self.inputs))
        self.outputs[:] = self._clocks.outputs()
        self._struct.initialized = True

    def save(self) -> StepperState:
        """Copy everything but the FMU's own state."""
        struct = self._struct
        return StepperState(
            outputs=self.outputs.copy(),
            inputs=self.inputs.copy(),
            event_inputs=self._event_values.copy(),
            initialized=bool(struct.initialized),
            interpolates=self.interpolates,
            stepped=self.stepped,
            next_event=struct.next_event,
            ended=self.ended,
            step_history=self._inner_step.history,
            clocks=self._clocks.state,
        )

    def restore(self, state: StepperState) -> None:
        """Go back to a saved state, after the FMU."""
        struct = self._struct
        self.outputs[:] = state.outputs
        self.inputs[:] = state.inputs
        self._event_values[:] = state.event_inputs
        struct.initialized = state.initialized
        struct.interpolates = state.interpolates
        struct.stepped = state.stepped
        struct.next_event = state.next_event
        struct.ended = state.ended
        self._inner_step.history = state.step_history
        self._clocks.restore(state.clocks)

    def check_compiled(self) -> None:
        """Raise what failed in a compiled step, or in compiled outputs, that was left to be done.

        Raises
        ------
        InputDerivativesFailed
            If that was a call for slopes of inputs.
        RunError
            If it was another call.
        """
        note = self._struct.note
        if note not in (FAILED, SLOPES_FAILED):
            return
        self._struct.note = NOTHING
        assert self._addresses is not None
        error = self._addresses.failure()
        assert error is not None
        if note == SLOPES_FAILED:
            raise InputDerivativesFailed(str(error)) from error
        raise error

    def step(self, t: float, h: float, u0: Vector, u1: Vector) -> bool:
        """Do one communication step; return False where the FMU requests the end inside it.

        Of a step that compiled code has begun, what is left of it.
        """
        self.check_compiled()
        begun = self._struct.note
        self._struct.note = NOTHING
        self._struct.first_event = math.inf
        self.left = None
        if begun == COMPLETED:
            self.inner_steps = self._struct.inner_steps
            return True
        if begun != UNREAD:
            end: StepEnd | None = None
            if begun == STEPPED:
                end = self._instance.end_of_step(t, h, self._struct.do_step.status)
            else:
                self.handle_point_event(Event(t, u0))
            self._clocks.begin_step()
            if self._advance(self._ramp(t, h, u0, u1), 0.0, 1.0, 0, end) < 1.0:
                return False
        self.outputs[:] = self._clocks.outputs()
        self._struct.stepped = True
        self.inner_steps = self._inner_step.observe(self.outputs, self.inputs)
        return True

    def _ramp(self, t: float, h: float, u0: Vector, u1: Vector) -> InputRamp:
        """Return the inputs over a step from ``u0`` to ``u1``, as far as they move."""
        latest = self._latest & ~self._step_inputs.ramped if self.interpolates else self._latest
        change = np.where(self._held | latest, 0.0, u1 - u0)
        return InputRamp(t, h, np.where(latest, u1, u0), np.where(self._held, u0, u1), change)

    def _advance(
        self,
        ramp: InputRamp,
        s0: float,
        s1: float,
        halvings: int,
        end: StepEnd | None = None,
    ) -> float:
        """Advance from ``s0`` to ``s1``, in halves where the FMU discards the whole.

        ``end`` is how the first part ended, if do_step was called already.

        Returns
        -------
        float
            How far the FMU came: less than ``s1`` where it requests the end of the run.
        """
        s = s0
        part_begin = s0
        part_end = s0
        standstill = Standstill(ramp.time(s0))
        while True:
            if self.ended:
                return s
            stop = self._next_stop(ramp, s, s1)
            if stop != part_end:
                part_begin = s
                part_end = stop
            # The mean over the whole part, also for what is left of it after an early return: the
            # beginning of the part had it, and only so the integral of the inputs is right.
            mean = 0.5 * (part_begin + part_end)
            if end is None:
                self._save_before_step()
                self._step_inputs.set(ramp, s, mean)
                end = self._instance.do_step(ramp.time(s), ramp.duration(s, part_end))
            self.inputs[:] = self._step_inputs.applied(ramp, s, part_end, mean, end)
            if end.terminate:
                self._struct.ended = True
            s = self._reached(ramp, s, part_end, end, halvings)
            is_event_due = self._is_event_due(ramp, s, end)
            if s < 1.0 and (is_event_due or end.returned_early):
                self._note_event(ramp, s, end)
            if is_event_due and s == 1.0 and self.keeps_left:
                self.left = self.corrected(self._clocks.outputs(), ramp.u1)
            if is_event_due:
                # What ticks at the end of the communication step waits for the inputs there.
                event = Event(ramp.time(s), ramp.at(s), ticks=s < 1.0, triggers=False)
                self._handle_event(event)
            if s >= s1:
                return s
            end = None
            self._check_progress(standstill, ramp, s)

    def _check_progress(self, standstill: Standstill, ramp: InputRamp, s: float) -> None:
        if standstill.lasts(ramp.time(s)):
            raise RunError(
                f"{self._name}: {REPETITIONS} returns at t = {standstill.since} s do not advance "
                f"time in the step of {ramp.h} s from t = {ramp.t} s"
            )

    def _save_before_step(self) -> None:
        """Copy the state of the FMU before the inputs are set, where it may be needed.

        A discarded step can be repeated from a state that was copied at its beginning only (FMI
        2.0.4 section 4.2.2).
        """
        if self._saves_before_steps:
            self._keep_fmu_state(self._instance.get_fmu_state(self._fmu_state))

    def _reached(self, ramp: InputRamp, s0: float, s1: float, end: StepEnd, halvings: int) -> float:
        """Return how far a call of do_step from ``s0`` to ``s1`` came, in the end."""
        if end.completed:
            return s1
        if end.discarded:
            return self._repeat_in_halves(ramp, s0, s1, halvings)
        if end.terminate:
            return s0
        s = ramp.fraction(end.last_successful_time)
        if not s0 <= s <= s1:
            raise RunError(
                f"{self._name}: early return: expected a time within the step from "
                f"{ramp.time(s0)} s to {ramp.time(s1)} s, got {end.last_successful_time} s"
            )
        return s

    def _repeat_in_halves(self, ramp: InputRamp, s0: float, s1: float, halvings: int) -> float:
        """Go back before a step that was discarded, and from there in two halves."""
        problem = self._problem_of_halving(ramp, halvings)
        if problem:
            size = (s1 - s0) * ramp.h
            raise RunError(
                f"{self._name}: discarded the step of {size} s from t = {ramp.time(s0)} s; "
                f"no smaller one is tried, as {problem}"
            )
        if not self._instance.description.undoes_discarded_steps:
            # FMI 2 may have computed a part of the step (FMI 2.0.4 section 4.2.2).
            self._instance.set_fmu_state(self._fmu_state)
        middle = 0.5 * (s0 + s1)
        reached = self._advance(ramp, s0, middle, halvings + 1)
        if reached < middle:
            return reached
        return self._advance(ramp, middle, s1, halvings + 1)

    def _problem_of_halving(self, ramp: InputRamp, halvings: int) -> str:
        """Return why a discarded step cannot be repeated in halves; empty: it can."""
        undone = self._instance.description.undoes_discarded_steps
        if not self._capabilities.variable_step:
            return (
                "it takes steps of one size only (canHandleVariableCommunicationStepSize is false)"
            )
        if not (undone or self._capabilities.saves_state):
            return (
                "its state before the step cannot be restored (canGetAndSetFMUstate is false, or "
                "not true)"
            )
        if halvings == HALVINGS:
            return f"the communication step of {ramp.h} s was halved {HALVINGS} times"
        return ""

    # --- events ---

    def _next_stop(self, ramp: InputRamp, s0: float, s1: float) -> float:
        """Return the next time event or tick of a clock, if the FMU can stop there, else ``s1``."""
        stop = self._next_time_event(ramp, s0, s1)
        tick = self._clocks.fraction(ramp.t, ramp.h)
        if not s0 < tick < s1 or tick - stop > CLOSE:
            return stop
        self._check_variable_step(ramp)
        ramp.ticks[tick] = self._clocks.next_time
        if abs(tick - stop) <= CLOSE < s1 - stop:
            return max(tick, stop)  # of a tick and an event that are one, the later
        return tick

    def _check_variable_step(self, ramp: InputRamp) -> None:
        """Refuse a tick inside a communication step of an FMU that takes steps of one size."""
        if self._capabilities.variable_step:
            return
        raise RunError(
            f"{self._name}: a clock ticks at t = {self._clocks.next_time} s, inside the "
            f"communication step of {ramp.h} s from t = {ramp.t} s, which the FMU cannot divide "
            "(canHandleVariableCommunicationStepSize is false); choose a communication step that "
            "divides the intervals and shifts of its clocks"
        )

    def _next_time_event(self, ramp: InputRamp, s0: float, s1: float) -> float:
        """Return the next time event, if the FMU can stop there, else ``s1``."""
        next_event = self._struct.next_event
        if next_event == math.inf:
            return s1
        s = ramp.fraction(next_event)
        if not s0 < s < s1:
            return s1
        if self._capabilities.variable_step:
            return s
        self._diagnostics.add(
            ramp.time(s0),
            "time event",
            f"the time event at t = {next_event} s is met at the end of the communication step "
            "only, as it takes steps of one size (canHandleVariableCommunicationStepSize is false)",
        )
        return s1

    def _is_event_due(self, ramp: InputRamp, s: float, end: StepEnd) -> bool:
        """Return whether an event is to be handled at ``s``: a requested one or a time event."""
        if self.ended or not self._capabilities.event_mode:
            return False
        if end.event_needed:
            return True
        if s < 1.0 and self._clocks.ticks_by(ramp.time(s)):
            return True
        next_event = self._struct.next_event
        return next_event != math.inf and ramp.fraction(next_event) <= s

    def _note_event(self, ramp: InputRamp, s: float, end: StepEnd) -> None:
        """Keep the time of an event at ``s``, inside the step, if it is the first one."""
        time = ramp.time(s)
        if end.returned_early:
            time = end.last_successful_time
        elif ramp.fraction(self._struct.next_event) == s:
            time = self._struct.next_event
        self._struct.first_event = min(self._struct.first_event, time)

    def corrected(self, y: Vector, u: Vector) -> Vector:
        """Return outputs of the FMU as it is now, corrected to inputs ``u`` where D is known."""
        return y if self._feedthrough is None else self._feedthrough.add(y, u - self.inputs)

    def has_point_event(self, event: Event) -> bool:
        """Return whether an event is due at a communication point.

        It is where a discrete input that is set in events is not as before, or a clock ticks.
        """
        if self.ended or not self._capabilities.event_mode:
            return False
        event_inputs = self._event_inputs.take(event.u)
        # By their bits: NaN as before is no change.
        if event_inputs.tobytes() != self._event_values.tobytes():
            return True
        return self._clocks.is_due(event.t, event.u)

    def handle_point_event(self, event: Event) -> bool:
        """Set all inputs in an event, if one is due for them, and read the outputs.

        Returns
        -------
        bool
            Whether there was an event.
        """
        if not self.has_point_event(event):
            return False
        self._handle_event(event)
        self.outputs[:] = self._clocks.outputs()
        return True

    def tune(self, t: float, parameters: TunedParameters) -> None:
        """Set tunable parameters: in event mode, where the FMU has it, else between two steps.

        Without event mode the outputs stay what they are: they may be read behind a step only.
        """
        if self.ended:
            return
        if not self._capabilities.event_mode:
            self._instance.set_float64(parameters.references, parameters.values)
            return
        self._instance.enter_event_mode()
        self._instance.set_float64(parameters.references, parameters.values)
        self._iterate_event(Event(t, self.inputs, ticks=False, triggers=False))
        if not self.ended:
            self.outputs[:] = self._clocks.outputs()

    def _handle_event(self, event: Event) -> None:
        # Event mode first: it is where inputs may be set and outputs read without a step between,
        # and a discrete change of an input needs it (FMI 3.0 section 4.2.1).
        self._instance.enter_event_mode()
        if event.triggers:
            inputs = self._unclocked_inputs
            self._instance.set_float64(inputs, inputs.take(event.u))
            self._event_values[:] = self._event_inputs.take(event.u)
            self.inputs[:] = event.u
        self._iterate_event(event)

    def _iterate_event(self, event: Event) -> None:
        """Iterate the event; unless the run is to end, leave event mode."""
        discrete = self._clocks.iterate(event)
        next_event = discrete.next_event_time
        self._struct.next_event = math.inf if next_event is None else next_event
        self._struct.ended = discrete.terminate
        if not discrete.terminate:
            # Else only terminate may follow (FMI 3.0 section 2.3.5).
            self._instance.enter_step_mode()


def _watched(description: Description) -> NDArray[np.intp]:
    """Return the columns of the outputs that show whether time advances in the FMU.

    Real and continuous ones, if possible without direct feedthrough.
    """
    interface = description.interface
    real = [output for output in interface.outputs if output.type == "real"]
    moving = [output.name for output in real if output.variability == "continuous"]
    not_fed = [name for name in moving if not interface.feeds(name)]
    slices = interface.output_columns()
    columns: list[int] = []
    for name in not_fed or moving:
        columns_of_output = slices[name]
        columns += range(columns_of_output.start, columns_of_output.stop)
    return np.array(columns, np.intp)
