"""Integrate a model exchange FMU over communication steps: its solver, its inputs, its events.

One communication step from t0 to t1 (inputs by linear interpolation, held and discrete ones at
u0)::

    handle_events: what is due at t0 happens with the inputs u0;
                   so does a change of a held or discrete input
    integrate, until t1:
        the solver steps on, to t1 or the next time event at most
        where an event indicator changed its domain:
            back to the first such time, just behind the change
        set_time, set_continuous_states, set continuous inputs
        completed_integrator_step
        a state, time or step event before t1: happens; the solver starts anew.  At t1: is due
    outputs: y <- outputs after what is due at t1, with the inputs u1

    (event: enter_event_mode, set inputs, update_discrete_states until no update is needed,
            enter_continuous_time_mode, read states; with clocks, see ``clocks.py``)

A tick of a time-based clock is a time event.

In the residual form x has z behind it. Where inputs or discrete states change without time, z is
solved for; see ``residual.py``.

The solver runs on over communication points, and starts anew after an event or where a continuous
input jumps.

An event at t1 belongs to the inputs there, which a loop may still correct. An FMU that can go back
shows its outputs after the event and goes back; the event happens when the next step begins. One
that cannot is left behind the event: what its discrete states make of inputs that are corrected
later, they keep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.clock import REPETITIONS, Standstill
from cosim.core.linearization import Linearized
from cosim.errors import RunError, listing
from cosim.fmi.description import usable_nominal
from cosim.fmi.driving.clocks import ClockState, Event, EventClocks
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.events import (
    BITS,
    EventKind,
    EventList,
    EventListState,
    close,
    crosses,
    endless_iteration,
    locate,
)
from cosim.fmi.driving.local_model import differentiated
from cosim.fmi.driving.residual import RADAU, RadauIIA, ResidualForm
from cosim.fmi.driving.solvers import TOLERANT, Adaptive, Solver, Stateless
from cosim.fmi.driving.tuning import TunedParameters
from cosim.fmi.instance import ModelExchangeInstance
from cosim.native.fmi.model_exchange import AT_END, ENDLESS_UPDATE, EVENT_IS_OVER, FAILED_SOLVER
from cosim.native.numerics.runge_kutta import EXPLICIT, RightHandSide, RungeKutta, RungeKuttaStruct

NONE: Final = np.empty(0)
PARTS: Final = {"DOP853": 8}
"""Of a step of a solver, which is several times as long as one of another solver with the same
tolerance: the event indicators are read after each part."""
TINY: Final = 1e-12  # nominal value that a difference is still made of


@dataclass(slots=True)
class IntegratorState:
    """The state of an FMU at one time.

    Arrays are replaced, never written to, so that a shallow copy keeps the state.
    """

    t: float = 0.0
    x: Vector = field(default_factory=lambda: NONE)  # in the residual form with z behind
    inputs: Vector = field(default_factory=lambda: NONE)  # as the FMU has them
    indicators: Vector = field(default_factory=lambda: NONE)
    nominals: Vector = field(default_factory=lambda: NONE)
    next_event: float = math.inf
    due: tuple[EventKind, ...] = ()  # events at t that were not handled yet
    ended: bool = False  # the FMU requested the end of the run


class IntegratorSnapshot(NamedTuple):
    """A copy of an ``Integrator``, without the FMU's own state."""

    state: IntegratorState
    solver: Any  # what the solver's ``save`` returned
    events: EventListState
    diagnostics: int
    clocks: ClockState


class Interruption(NamedTuple):
    """What compiled code has left of a communication step.

    Attributes
    ----------
    reached : int
        How far it came: ``AT_BEGIN`` and so on, of :mod:`cosim.native.fmi.model_exchange`.
    failure : int
        What ends the run: ``FAILED_CALL`` and so on; 0: nothing does.
    nominals_changed : bool
        Whether an event is to be finished: ``finish_event``.
    standstill : Standstill
        Of the events in the step.
    """

    reached: int
    failure: int
    nominals_changed: bool
    standstill: Standstill


class LinearInputs:
    """Inputs by linear interpolation from u0 at t0 to u1 at t1."""

    def __init__(self, t0: float, t1: float, u0: Vector, u1: Vector) -> None:
        self.t0 = t0
        self.t1 = t1
        self.u0 = u0
        self.u1 = u1
        self._change = u1 - u0

    def __call__(self, t: float) -> Vector:
        """Return the inputs at ``t``; the values at the ends are exact."""
        if t >= self.t1:
            return self.u1
        if t <= self.t0:
            return self.u0
        fraction = (t - self.t0) / (self.t1 - self.t0)
        return self.u0 + fraction * self._change


@final
class Integrator:
    """Integrates an FMU and handles its events.

    Parameters
    ----------
    instance : ModelExchangeInstance
    solver : str
        One of ``cosim.fmi.driving.solvers.SOLVERS``, or ``RADAU`` for the residual form. With
        ``exact`` the owner of the integrator advances the state.
    clocks : EventClocks
        Its clocks.
    diagnostics : Diagnostics
        Takes what the run shows about the FMU.
    rtol : float
        Relative tolerance of the states.
    max_step : float
        The longest step of the solver [s]; infinity: as long as its tolerance allows.

    Attributes
    ----------
    state : IntegratorState
    event_inputs : array of int
        Which inputs change in events only: held and discrete ones; set by the owner.
    inputs_time : float
        The time whose inputs of this step the FMU has; NaN: it has others.
    rolls_back : bool
        Whether an event at the end of a step is undone when the outputs after it were read.
    fmu_state : object or None
        Copy of the FMU state before such an event; its memory is used again.
    events : EventList
    diagnostics : Diagnostics
        As it was handed over.
    parts : int
        Of a step of the solver, after each of which the event indicators are read.
    max_step : float
        As it was handed over.
    keeps_left : bool
        Whether the outputs before an event at the end of a step are read.
    left : Vector or None
        Those of the last step; None: it had no such event.
    """

    def __init__(
        self,
        instance: ModelExchangeInstance,
        solver: str,
        clocks: EventClocks,
        diagnostics: Diagnostics,
        *,
        rtol: float,
        max_step: float = math.inf,
    ) -> None:
        description = instance.description
        self._instance = instance
        self._clocks = clocks
        self._name = description.name
        self._capabilities = description.capabilities["me"]
        inputs = description.references("input")
        self._inputs = description.unclocked("input")
        self._continuous_inputs = inputs.select(~description.discrete_inputs)
        self._clocked = np.ones(inputs.size, np.bool_)
        self._clocked[self._inputs.columns] = False
        self._n_x = description.n_states
        self._n_z = description.event_indicators
        self._changed: list[int] = []  # event indicators that changed their domain in the last step
        self._form = ResidualForm(instance) if solver == RADAU else None
        self._runge_kutta: RungeKutta | None = None
        self._solver: Solver[Any]  # each restores what it saved itself
        if self._form is not None:
            self._solver = RadauIIA(self._name, self._equations, self._jacobian, self._n_x)
        elif solver in EXPLICIT and self._n_x:
            self._runge_kutta = RungeKutta(solver, self._derivatives, self._n_x, rtol=rtol)
            self._solver = self._runge_kutta
        else:
            self._solver = _build_solver(solver, self._derivatives, self._n_x, rtol)
        self.parts = PARTS.get(solver, 1)
        self.max_step = max_step
        self._uses_nominals = solver in (*TOLERANT, RADAU) and self._n_x > 0
        # With the exact solver the model is linear: an event changes nothing but its inputs.
        self.rolls_back = self._capabilities.saves_state and solver != "exact"
        self.fmu_state: object | None = None
        self._step_inputs = LinearInputs(0.0, 0.0, NONE, NONE)
        self.inputs_time = math.nan
        self.state = IntegratorState()
        self.event_inputs: NDArray[np.intp] = np.flatnonzero(description.discrete_inputs)
        self.events = EventList()
        self.diagnostics = diagnostics
        self.keeps_left = False
        self.left: Vector | None = None

    @property
    def is_explicit(self) -> bool:
        """Whether it can be compiled: with an explicit Runge-Kutta method, or without states."""
        return self._runge_kutta is not None or (self._n_x == 0 and self._form is None)

    def compiled_solver(self, f: int, model: int) -> tuple[RungeKuttaStruct | None, Vector]:
        """Return the solver for a compiled right-hand side, and the memory of its state.

        Without states there is no solver.
        """
        solver = self._runge_kutta
        return (None, np.empty(0)) if solver is None else (solver.compiled(f, model), solver.x)

    def begin(self) -> None:
        """Handle the event that the initialization ends with; from here on time may advance.

        No call of enter_event_mode: exit_initialization_mode leads to event mode (FMI 2.0.4 section
        3.2.3, FMI 3.0 section 2.3.3).
        """
        self._iterate_event(at_point=True)
        self._restart_solver()

    def save(self) -> IntegratorSnapshot:
        """Copy everything but the FMU's own state."""
        state = replace(self.state)
        return IntegratorSnapshot(
            state,
            self._solver.save(),
            self.events.save(),
            self.diagnostics.save(),
            self._clocks.state,
        )

    def restore(self, snapshot: IntegratorSnapshot) -> None:
        """Go back to a saved state, after the FMU."""
        self.state = replace(snapshot.state)
        self.inputs_time = math.nan
        self._solver.restore(snapshot.solver)
        self.events.restore(snapshot.events)
        self.diagnostics.restore(snapshot.diagnostics)
        self._clocks.restore(snapshot.clocks)

    def integrate(self, inputs: LinearInputs) -> bool:
        """Integrate over a communication step and handle the events before its end.

        Returns
        -------
        bool
            False where the FMU requested the end of the run on the way.

        Raises
        ------
        RunError
            If the events do not end.
        """
        self._step_inputs = inputs
        self.left = None
        self.events.begin_step()
        self._clocks.begin_step()
        return self._integrate_on(Standstill(inputs.t0))

    def _integrate_on(self, standstill: Standstill) -> bool:
        """Integrate over what is left of a communication step."""
        inputs = self._step_inputs
        while True:
            due = self._integrate_to_event(inputs.t1)
            state = self.state
            if state.t >= inputs.t1:
                state.due = due
                state.inputs = inputs.u1
                return True
            if state.ended:
                return False
            if standstill.lasts(state.t, (*due, *self._changed)):
                raise self._endless_events(standstill)
            state.due = due
            self.handle_events(inputs(state.t), at_point=False)
            if self.state.ended:
                return False

    def _endless_events(self, standstill: Standstill) -> RunError:
        """Return the error of events that do not advance time."""
        description = self._instance.description
        causes = standstill.causes
        names = [f"event indicator {i + 1} of {self._n_z}" for i in range(self._n_z)]  # of FMI 1, 2
        if description.indicators:
            sizes = [description[name].size for name in description.indicators]
            names = np.repeat(description.indicators, sizes).tolist()
        changing = dict.fromkeys(names[i] for i in range(self._n_z) if i in causes)
        reason = ", ".join(kind for kind in BITS if kind in causes)
        if changing:
            reason += (
                f", where {listing(list(changing))} changes sign; expected a hysteresis there, or "
                "something else that keeps the model from chattering"
            )
        return RunError(
            f"{self._name}: {REPETITIONS} events at t = {standstill.since} s do not advance time: "
            f"{reason}"
        )

    def finish_event(self) -> None:
        """Read the nominal values that an event changed, and start the solver with them."""
        self.state.nominals = self._read_nominals()
        self._restart_solver()

    def go_on(self, inputs: LinearInputs, interruption: Interruption) -> bool:
        """Integrate over what compiled code has left of a communication step; as ``integrate``."""
        self._step_inputs = inputs
        if interruption.reached == AT_END:
            return True
        return not self.state.ended and self._integrate_on(interruption.standstill)

    def failure(self, interruption: Interruption) -> RunError:
        """Return the error of what failed in a compiled step, but for a call of the FMU."""
        if interruption.failure == FAILED_SOLVER:
            assert self._runge_kutta is not None
            return self._runge_kutta.too_small_a_step()
        if interruption.failure == EVENT_IS_OVER:
            return self._event_is_over()
        assert interruption.failure == ENDLESS_UPDATE
        return endless_iteration(self._name, self.state.t)

    def _integrate_to_event(self, t1: float) -> tuple[EventKind, ...]:
        """Integrate to the next event, or to ``t1`` at most; return what is due there."""
        state = self.state
        self._changed = []
        while True:
            if state.next_event - state.t <= close(state.t):
                return self._with_time_event(())
            # Never beyond the next time event: there x' may jump (FMI 2.0.4 section 3.2.2).
            event_comes_first = t1 - state.next_event > close(t1)
            stop = state.next_event if event_comes_first else t1
            bound = state.t + max(self.max_step, close(state.t))
            due = self._step(bound if stop - bound > close(stop) else stop)
            if self._capabilities.completed_step:
                # After state events are located and with time, inputs and states set to accepted
                # values: time must not go back over this call (FMI 2.0.4 section 3.2.2, FMI 3.0
                # section 3.2.1).
                step_event, state.ended = self._instance.completed_integrator_step()
                if step_event:
                    due = (*due, "step event")
            due = self._with_time_event(due)
            if due or state.ended or state.t >= t1:
                return due

    def _step(self, stop: float) -> tuple[EventKind, ...]:
        """Take a step of the solver, to the first state event in it at most."""
        state = self.state
        begin = state.t
        t, x = self._set_solution(self._look_between(self._solver.step(stop), stop), stop)
        due: tuple[EventKind, ...] = ()
        if self._n_z:
            indicators = self._instance.get_event_indicators()
            if crosses(state.indicators, indicators):
                event_time = locate(self._indicators_at, begin, state.indicators, t, indicators)
                t, x = self._set_solution(event_time, stop)
                due = ("state event",)
                changed = (state.indicators > 0.0) != (indicators > 0.0)
                self._changed = np.flatnonzero(changed).tolist()
            state.indicators = indicators
        state.t = t
        state.x = x
        return due

    def _look_between(self, reached: float, stop: float) -> float:
        """Return the end of a step of the solver, or of its first part that changes a domain."""
        begin = self.state.t
        end = stop if stop - reached <= close(stop) else reached
        if self.parts == 1 or self._runge_kutta is None or not self._n_z:
            return reached
        # A step that is cut short is as long as one of other solvers would be.
        share = min((end - begin) / self._runge_kutta.proposed, 1.0)
        parts = math.ceil(self.parts * share)
        for i in range(1, parts):
            t = begin + (end - begin) * i / parts
            if crosses(self.state.indicators, self._indicators_at(t)):
                return t
        return reached

    def _set_solution(self, t: float, stop: float) -> tuple[float, Vector]:
        """Set the FMU to the solution at ``t``, or at ``stop`` where that is one time."""
        x = self._solver.at(t)
        if stop - t <= close(stop):
            t = stop
        self._set_point(t, x)
        return t, x

    def _with_time_event(self, due: tuple[EventKind, ...]) -> tuple[EventKind, ...]:
        """Add the time event where it is due; the FMU then has a time not before it."""
        state = self.state
        if state.next_event - state.t > close(state.t):
            return due
        if state.next_event > state.t:
            # At or after nextEventTime (FMI 3.0 section 2.3.5): a rounding before it an FMU that
            # compares times would not handle its event.
            state.t = state.next_event
            self._set_point(state.t, state.x)
        return (*due, "time event")

    # --- what the solver and the location of events evaluate ---

    def _set_point(self, t: float, x: Vector) -> None:
        """Set time, inputs and states, before anything that depends on them is read.

        FMI 2.0.4 section 3.2.2: the arguments of an evaluation are set before it. Time and inputs
        are set where they change only, as each call makes an FMU forget what it has computed.
        """
        if t != self.inputs_time:
            self._instance.set_time(t)
            if self._continuous_inputs.size:
                self.set_continuous_inputs(self._step_inputs(t))
            self.inputs_time = t
        if self._form is not None:
            self._form.set_variables(x)
        elif self._n_x:
            self._instance.set_continuous_states(x)

    def _derivatives(self, t: float, x: Vector) -> Vector:
        self._set_point(t, x)
        return self._instance.get_derivatives()

    def _indicators_at(self, t: float) -> Vector:
        self._set_point(t, self._solver.at(t))
        return self._instance.get_event_indicators()

    def _equations(self, t: float, w: Vector) -> Vector:
        assert self._form is not None
        self._set_point(t, w)
        return self._form.evaluate()

    def _jacobian(self, t: float, w: Vector, scale: Vector) -> Matrix:
        assert self._form is not None
        self._set_point(t, w)
        return self._form.jacobian(w, lambda w: self._equations(t, w), scale)

    # --- inputs and events ---

    def set_continuous_inputs(self, u: Vector) -> None:
        """Set the inputs that may change while time advances."""
        if self._continuous_inputs.size:
            self._instance.set_float64(self._continuous_inputs, self._continuous_inputs.take(u))

    def _jumps(self, u: Vector) -> bool:
        """Return whether a held or discrete input differs from what the FMU has.

        One that belongs to a clock is set where the clock ticks, and that is no event of its own.
        """
        columns = self.event_inputs
        if not columns.size:
            return False
        jumps = (u[columns] != self.state.inputs[columns]) & ~self._clocked[columns]
        return bool(jumps.any())

    def _differs(self, u: Vector) -> bool:
        """Return whether an input that belongs to no clock differs, by its bits."""
        inputs = self._inputs
        return inputs.take(u).tobytes() != inputs.take(self.state.inputs).tobytes()

    def outputs(self, u: Vector) -> Vector:
        """Return the outputs for inputs ``u``, after what is due; then go back, if the FMU can."""
        state = self.state
        if state.ended:
            return self._clocks.outputs()
        self.read_left(u)
        if not (state.due or self._jumps(u) or self._clocks.is_due(state.t, u)):
            self._correct_inputs(u)
        elif self.rolls_back:
            return self._outputs_after_event(u)
        else:
            self.handle_events(u)
        return self._clocks.outputs()

    def read_left(self, u: Vector) -> None:
        """Read the outputs for inputs ``u`` before the event that is due at the end of a step."""
        if self.keeps_left and self.state.due and not self.state.ended:
            self._correct_inputs(u)
            self.left = self._clocks.outputs()

    def _correct_inputs(self, u: Vector) -> None:
        """Set continuous inputs for the outputs alone; the state stays what it is."""
        state = self.state
        corrected = self._differs(u)
        if not corrected and not math.isnan(self.inputs_time):
            return
        self.set_continuous_inputs(u)
        self.inputs_time = math.nan
        if self._form is not None:
            x = self._form.solve(state.t, state.x) if corrected else state.x
            self._form.set_variables(x)

    def _outputs_after_event(self, u: Vector) -> Vector:
        instance = self._instance
        before = replace(self.state)
        clocks_before = self._clocks.state
        # The copy holds the mode too: with it the FMU is back in continuous-time mode.
        self.fmu_state = instance.get_fmu_state(self.fmu_state)
        self._handle_event(u, at_point=True)
        y = self._clocks.outputs()
        if not self.state.ended:
            instance.set_fmu_state(self.fmu_state)
            self.state = before
            self._clocks.restore(clocks_before)
        return y

    def linearized(self, u: Vector) -> Linearized | None:
        """Linearize at the time and the states reached; None: events of its own are to come."""
        state = self.state
        if state.ended or state.due or state.next_event < math.inf or self._form is not None:
            return None
        matrices = differentiated(self._instance, state.x, u, np.maximum(state.nominals, TINY))
        self.set_continuous_inputs(state.inputs)
        self.inputs_time = math.nan
        return matrices

    def handle_events(self, u: Vector, *, at_point: bool = True) -> None:
        """Handle what is due at the time reached, with ``u``, the inputs from here on.

        Where an event happens or a continuous input jumps, the solver starts anew. At communication
        points the inputs may trigger clocks.
        """
        state = self.state
        ticks = at_point and self._clocks.is_due(state.t, u)
        if state.due or self._jumps(u) or ticks:
            for kind in state.due or ("input event",):
                self.events.add(kind, state.t)
            self._handle_event(u, at_point=at_point)
            self._restart_solver()
        elif self._differs(u):
            self._set_jumped_inputs(u)

    def tune(self, parameters: TunedParameters) -> None:
        """Set tunable parameters in an event at the time reached, with what is due there."""
        state = self.state
        if state.ended:
            return
        for kind in state.due or ("input event",):
            self.events.add(kind, state.t)
        # What triggers clocks here is not known yet.
        self._handle_event(state.inputs, parameters, at_point=False)
        if not state.ended:
            self._restart_solver()

    def continue_from(self, x: Vector) -> None:
        """Go on from other states; what follows from them is an event at the time reached."""
        state = self.state
        if state.ended:
            return
        self._instance.set_continuous_states(x)
        state.x = x.copy()
        self._handle_event(state.inputs, at_point=False)
        if not state.ended:
            self._restart_solver()

    def _set_jumped_inputs(self, u: Vector) -> None:
        """Set continuous inputs that are not what they were a moment ago; that may be an event."""
        state = self.state
        self.set_continuous_inputs(u)
        self.inputs_time = math.nan
        state.inputs = u
        if self._form is not None:
            state.x = self._form.solve(state.t, state.x)
        self._restart_solver()
        if self._n_z:
            indicators_before = state.indicators
            state.indicators = self._instance.get_event_indicators()
            if crosses(indicators_before, state.indicators):
                state.due = ("state event",)
                self.handle_events(u)

    def _handle_event(
        self, u: Vector, parameters: TunedParameters | None = None, *, at_point: bool
    ) -> None:
        """Do one event, with all inputs and with parameters that are set."""
        # Event mode first: discrete inputs must not be set in continuous-time mode (FMI 2.0.4
        # section 3.2.3, FMI 3.0 section 3.2.1).
        self._instance.enter_event_mode()
        if parameters is not None:
            self._instance.set_float64(parameters.references, parameters.values)
        self._instance.set_float64(self._inputs, self._inputs.take(u))
        self.state.inputs = u
        if self._form is not None:
            self._form.solve(self.state.t, self.state.x)
        self._iterate_event(at_point=at_point)

    def _iterate_event(self, *, at_point: bool) -> None:
        """Iterate the event; unless the run is to end, leave event mode and read what changed."""
        instance = self._instance
        state = self.state
        discrete = self._clocks.iterate(Event(state.t, state.inputs, triggers=at_point))
        state.due = ()
        self.inputs_time = math.nan
        state.ended |= discrete.terminate
        if state.ended:
            # Only terminate may follow (FMI 2.0.4 section 3.2.2).
            return
        next_event = discrete.next_event_time
        state.next_event = math.inf if next_event is None else next_event
        if not state.next_event >= state.t - close(state.t):
            raise self._event_is_over()
        state.next_event = min(state.next_event, self._clocks.next_time)
        # States and nominals are read behind this call, as an FMU may select other states in it
        # (FMI 2.0.4 section 3.2.2).
        instance.enter_continuous_time_mode()
        if self._form is not None:
            state.x = self._form.solve(state.t, state.x)
        elif self._n_x:
            state.x = instance.get_continuous_states()
        if self._n_z:
            state.indicators = instance.get_event_indicators()
        if discrete.nominals_changed or not state.nominals.size:
            state.nominals = self._read_nominals()

    def _event_is_over(self) -> RunError:
        """Return the error of a time event that is announced too late."""
        return RunError(
            f"{self._name}: time event: expected a time >= {self.state.t} s (the current time), "
            f"got {self.state.next_event} s"
        )

    def _read_nominals(self) -> Vector:
        """Return the nominal values that the solver scales its tolerances with.

        In place of one that is none: 1, as of a state without information (FMI 2.0.4 section
        3.2.2).
        """
        nominals = np.ones(self._n_x)
        if self._uses_nominals:
            given = np.abs(self._instance.get_nominals())
            nominals[:] = list(map(usable_nominal, given.tolist()))
            for i in np.flatnonzero(nominals != given).tolist():
                self.diagnostics.add(
                    self.state.t,
                    f"nominal value of state {i}",
                    f"nominal value of state {i}: found {given[i]}; needed a number other than "
                    "zero, taken as 1",
                )
        if self._form is None:
            return nominals
        return np.concatenate([nominals, self._form.nominals])

    def _restart_solver(self) -> None:
        state = self.state
        self._solver.start(state.t, state.x, state.nominals)


def _build_solver(name: str, f: RightHandSide, n: int, rtol: float) -> Solver[Any]:
    if name == "exact" or n == 0:
        return Stateless()
    if name == "CVode":
        from cosim.fmi.driving.cvode import CVode

        return CVode(f, n, rtol=rtol)
    return Adaptive(name, f, rtol=rtol)
