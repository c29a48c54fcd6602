"""A model exchange unit, generated or loaded, with a solver: a component.

One communication step from t0 to t1 (inputs in straight lines, held and discrete ones at u0)::

    arrive at t0: what is due there happens with the inputs u0; so does a held or discrete input that is not as before
    repeat until t1:
        the solver steps on, to t1 or the next time event at most
        where an event indicator changed its domain: back to the first such time, just behind the change
        set_time, set_continuous_states, set continuous inputs; completed_integrator_step
        a state, time or step event before t1: happens; the solver starts anew.  At t1: is due
    y <- outputs after what is due at t1, with the inputs u1

    (event:  enter_event_mode, set inputs, update_discrete_states until settled, enter_continuous_time_mode, read states)

The solver runs on over communication points, and starts anew after an event or where a continuous input jumps.

An event at t1 belongs to the inputs there, which a loop may still correct. A unit that can go back shows its outputs after the
event and goes back; the event happens when the next step arrives. One that cannot is left behind the event: what its discrete
states make of inputs that were corrected later, they keep.

The end of the run that a unit asks for is remembered, and comes with the next ``advance`` at the latest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.solver import SOLVERS, Adaptive, Linear, LinearModel, RungeKutta, Slope, Solver, Stateless
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.binary.messages import Message
from cosim.fmi.driving.events import EVENTS, EventKind, EventList, close, crosses, locate, settle
from cosim.fmi.driving.saved import SavedState, save
from cosim.fmi.driving.start import Start, Starts
from cosim.fmi.unit import TERMINATED, ModelExchangeUnit

RTOL: Final = 1e-9
CLOSEST: Final = 1e-13  # what rounding leaves of a relative tolerance
NONE: Final = np.empty(0)


@dataclass(slots=True)
class Reached:
    """Where a unit is. Arrays are replaced, never written to, so that a shallow copy keeps the state."""

    t: float = 0.0
    x: Vector = field(default_factory=lambda: NONE)
    given: Vector = field(default_factory=lambda: NONE)  # all inputs, as the unit has them
    indicators: Vector = field(default_factory=lambda: NONE)
    nominals: Vector = field(default_factory=lambda: NONE)
    next_event: float = math.inf
    due: tuple[EventKind, ...] = ()  # events at t that did not happen yet
    ended: bool = False  # the unit asked for the end of the run


@final
class ModelExchange:
    """A model exchange unit with a solver.

    Parameters
    ----------
    unit : ModelExchangeUnit
        Just instantiated.
    solver : str or None
        One of ``cosim.core.solver.SOLVERS``; None: ``exact`` where the unit's model is known to be linear, else ``rk4``.
    starts : mapping of variable name to StartValue
        Start values to set instead of the unit's own.
    rtol : float
        Relative tolerance of the states, for the solvers that keep one; the absolute one is ``rtol`` times their nominal values.

    Raises
    ------
    FmuError
        If there is no such solver, it needs what the unit or the machine does not have, the tolerance is not one, or a start
        value is wrong.
    """

    def __init__(
        self,
        unit: ModelExchangeUnit,
        solver: str | None = None,
        *,
        starts: Starts | None = None,
        rtol: float = RTOL,
    ) -> None:
        self._unit, self._name = unit, unit.description.name
        self.solver = solver or ("rk4" if unit.linear is None else "exact")
        if self.solver not in SOLVERS:
            raise FmuError(f"{self._name}: no solver {solver!r}; {nearest(self.solver, SOLVERS)}")
        if self.solver == "exact" and unit.linear is None:
            raise FmuError(
                f"{self._name}: solver 'exact' needs the matrices of a linear model, an FMU does not show them; use 'rk4'"
            )
        if not CLOSEST <= rtol < 1.0:
            raise FmuError(f"{self._name}: relative tolerance {rtol}; needed at least {CLOSEST} and less than 1")
        self.interface = unit.interface
        self.notes: tuple[str, ...] = ()
        self._events = EventList()
        self._start = Start(unit, starts or {})
        description = unit.description
        self._outputs, self._inputs = description.references("output"), description.references("input")
        self._discrete, self._capabilities = description.discrete_inputs, description.capabilities["me"]
        moving = (v for _, group in description.ports("input") for v in group if v.variability == "continuous")
        self._moving, self._columns = description.reference(v.name for v in moving), np.flatnonzero(~self._discrete)
        self._n, self._n_z = description.n_states, description.event_indicators
        self._solver = _solver(self.solver, self._derivative, self._n, rtol)
        self._scaled = self.solver not in ("exact", "rk4") and self._n > 0  # the solver wants nominal values
        self._exact: Linear | None = None
        self._goes_back = self._capabilities.saves_state and self.solver != "exact"  # a linear model has nothing to undo
        self._copy: object | None = None  # of the unit's state; its memory is used again
        self._now = Reached()
        self._line = _Line(0.0, 0.0, NONE, NONE)
        self._set = math.nan  # the time whose inputs, on the line, the unit has

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretise for the exact solver; a known model's numbers are recorded, and taken from the record."""
        held = held | self._discrete
        self._jumping = np.flatnonzero(self._discrete if self.solver == "exact" else held)  # exact: a jump is in the matrices
        model = self._unit.linear
        if model is None:
            return {}
        if recorded:
            model = self._unit.linear = _with_numbers(model, recorded)
        if self.solver != "exact":
            return model.arrays
        self._exact = Linear(model)
        return self._exact.prepare(h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        self._now = Reached(t, given=np.array(u, np.float64))
        return self._start.enter(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs at ``t``, the time reached, for inputs ``u``, after what is due there."""
        self._leave_initialization()
        return self._look(np.array(u, np.float64, order="C"))

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        try:
            self._leave_initialization()
            if not self._now.ended:
                self._arrive(np.array(u[0], np.float64))
        except RunError as error:
            raise Stopped(np.empty((0, self.interface.n_y)), str(error)) from error
        if self._now.ended:
            raise Stopped(np.empty((0, self.interface.n_y)), TERMINATED, failed=False)
        return self._advance_exactly(self._exact, t, h, u) if self._exact else self._integrate(t, u)

    def drain(self) -> list[Message]:
        """Give the events since the last call, at level debug."""
        return self._events.drain()

    def save(self) -> SavedState:
        """Copy the state, the solver's included.

        CVode and LSODA cannot be copied: they start anew here, so that both branches begin alike.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        own = (self._start.t, replace(self._now), self._solver.save(), self._events.save())
        return save(self._unit, self._capabilities, own)

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._unit.set_fmu_state(state.unit)
        now: Reached
        self._start.t, now, solver, events = state.own  # type: ignore[assignment]
        self._now, self._set = replace(now), math.nan
        self._solver.restore(solver)
        self._events.restore(events)
        if self._exact:
            self._exact.state[:] = self._now.x

    def _leave_initialization(self) -> None:
        if not self._start.leave():
            return
        self._settle()
        self._restart()
        if self._exact and not self._now.ended:
            self._exact.state[:] = self._now.x

    # --- the exact solver ---

    def _advance_exactly(self, exact: Linear, t: Vector, h: float, u: Matrix) -> Matrix:
        y = exact.advance(t, h, u)
        now, end = self._now, u[-1].copy()
        now.t, now.x = float(t[-1]), exact.state.copy()
        end[self._jumping] = now.given[self._jumping]
        self._unit.set_time(now.t)
        self._unit.set_continuous_states(now.x)
        self._set_continuous(end)
        self._unit.completed_integrator_step()
        now.given = end
        return y

    # --- solvers in steps ---

    def _integrate(self, t: Vector, u: Matrix) -> Matrix:
        times, u = t.tolist(), np.array(u, np.float64, order="C")
        ends = u[1:].copy()
        ends[:, self._jumping] = u[:-1, self._jumping]
        y = np.empty((len(ends), self.interface.n_y))
        for k, t1 in enumerate(times[1:]):
            try:
                arrived = self._move(_Line(times[k], t1, u[k], ends[k]))
                if arrived and k < len(ends) - 1:
                    self._arrive(u[k + 1])
                if arrived:
                    y[k] = self._look(u[k + 1])
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
            if self._now.ended:
                raise Stopped(y[: k + arrived].copy(), TERMINATED, failed=False)
        return y

    def _move(self, line: _Line) -> bool:
        """Integrate over a communication step, with the events before its end; False: the unit asked for the end on the way.

        Raises
        ------
        RunError
            If the events do not end.
        """
        self._line = line
        for _ in range(EVENTS):
            kinds, now = self._to_event(line.t1), self._now
            if now.t >= line.t1:
                now.due, now.given = kinds, line.u1
                return True
            if now.ended:
                return False
            now.due = kinds
            self._arrive(line(now.t))
            if self._now.ended:
                return False
        raise RunError(
            f"{self._name}: {EVENTS} events between t = {line.t0} s and {line.t1} s, the last at {self._now.t} s; they do not end"
        )

    def _to_event(self, t1: float) -> tuple[EventKind, ...]:
        """Integrate to the next event, or to ``t1`` at most; give what is due there."""
        now, solver = self._now, self._solver
        while True:
            if now.next_event - now.t <= close(now.t):
                return self._with_time_event(())
            stop = now.next_event if t1 - now.next_event > close(t1) else t1
            begin, t = now.t, solver.step(stop)
            x = solver.at(t)
            t = stop if stop - t <= close(stop) else t
            self._put(t, x)
            kinds: tuple[EventKind, ...] = ()
            if self._n_z:
                z = self._unit.get_event_indicators()
                if crosses(now.indicators, z):
                    t = locate(self._indicators, begin, now.indicators, t, z)
                    x, t = solver.at(t), stop if stop - t <= close(stop) else t
                    self._put(t, x)
                    kinds = ("state event",)
                now.indicators = z
            now.t, now.x = t, x
            if self._capabilities.completed_step:
                wanted, now.ended = self._unit.completed_integrator_step()
                kinds += ("step event",) if wanted else ()
            kinds = self._with_time_event(kinds)
            if kinds or now.ended or now.t >= t1:
                return kinds

    def _with_time_event(self, kinds: tuple[EventKind, ...]) -> tuple[EventKind, ...]:
        """Add the time event, if it is here; the unit then sees no time before it."""
        now = self._now
        if now.next_event - now.t > close(now.t):
            return kinds
        if now.next_event > now.t:
            now.t = now.next_event
            self._put(now.t, now.x)
        return *kinds, "time event"

    def _derivative(self, t: float, x: Vector) -> Vector:
        self._put(t, x)
        return self._unit.get_derivatives()

    def _indicators(self, t: float) -> Vector:
        self._put(t, self._solver.at(t))
        return self._unit.get_event_indicators()

    def _put(self, t: float, x: Vector) -> None:
        """Set time, states, and the continuous inputs on the line."""
        if t != self._set:
            self._unit.set_time(t)
            self._set_continuous(self._line(t))
            self._set = t
        if self._n:
            self._unit.set_continuous_states(x)

    # --- inputs and events ---

    def _set_continuous(self, u: Vector) -> None:
        """Set what may change while time moves."""
        if self._columns.size == u.size:
            self._unit.set_float64(self._moving, u)
        elif self._columns.size:
            self._unit.set_float64(self._moving, u[self._columns])

    def _jumps(self, u: Vector) -> bool:
        """Whether a held or discrete input is not what the unit was given last."""
        return self._jumping.size > 0 and bool((u[self._jumping] != self._now.given[self._jumping]).any())

    def _look(self, u: Vector) -> Vector:
        """Give the outputs for inputs ``u``, after what is due; then go back, if the unit can."""
        now = self._now
        if now.ended:
            return self._unit.get_float64(self._outputs)
        if not (now.due or self._jumps(u)):
            if u.tobytes() != now.given.tobytes() or math.isnan(self._set):
                self._set_continuous(u)
                self._set = math.nan
        elif self._goes_back:
            return self._look_ahead(u)
        else:
            self._arrive(u)
        return self._unit.get_float64(self._outputs)

    def _look_ahead(self, u: Vector) -> Vector:
        unit, before = self._unit, replace(self._now)
        self._copy = unit.get_fmu_state(self._copy)
        self._event(u)
        y = unit.get_float64(self._outputs)
        if not self._now.ended:
            unit.set_fmu_state(self._copy)
            self._now = before
        return y

    def _arrive(self, u: Vector) -> None:
        """Let happen what is due at the time reached, with the inputs from here on; the solver starts anew if need be."""
        now = self._now
        if now.due or self._jumps(u):
            for kind in now.due or ("input event",):
                self._events.add(kind, now.t)
            self._event(u)
            self._restart()
        elif u.tobytes() != now.given.tobytes():
            self._set_continuous(u)
            self._set, now.given = math.nan, u
            self._restart()
            if self._n_z and not self._exact:
                before, now.indicators = now.indicators, self._unit.get_event_indicators()
                if crosses(before, now.indicators):
                    now.due = ("state event",)
                    self._arrive(u)

    def _event(self, u: Vector) -> None:
        """Let the discrete states settle, with all inputs."""
        self._unit.enter_event_mode()
        self._unit.set_float64(self._inputs, u)
        self._now.given = u
        self._settle()

    def _settle(self) -> None:
        """Iterate the discrete states, hear whether it is the end of the run; if not, let time move again."""
        unit, now = self._unit, self._now
        found = settle(unit, now.t)
        now.due, self._set = (), math.nan
        now.ended |= found.terminate
        now.next_event = math.inf if found.next_event_time is None else found.next_event_time
        if now.ended:
            return
        unit.enter_continuous_time_mode()
        if self._n:
            now.x = unit.get_continuous_states()
        if self._n_z:
            now.indicators = unit.get_event_indicators()
        if found.nominals_changed or not now.nominals.size:
            now.nominals = self._nominals()

    def _nominals(self) -> Vector:
        if not self._scaled:
            return np.ones(self._n)
        nominals = np.abs(self._unit.get_nominals())
        for i in np.flatnonzero(~((nominals > 0.0) & (nominals < math.inf))).tolist():
            raise RunError(f"{self._name}: nominal value of state {i}: found {nominals[i]}, needed a number other than zero")
        return nominals

    def _restart(self) -> None:
        self._solver.start(self._now.t, self._now.x, self._now.nominals)


class _Line:
    """Inputs in a straight line from u0 at t0 to u1 at t1."""

    def __init__(self, t0: float, t1: float, u0: Vector, u1: Vector) -> None:
        self.t0, self.t1, self.u0, self.u1 = t0, t1, u0, u1

    def __call__(self, t: float) -> Vector:
        """Give the inputs at ``t``."""
        if t >= self.t1:
            return self.u1
        if t <= self.t0:
            return self.u0
        return self.u0 + (t - self.t0) / (self.t1 - self.t0) * (self.u1 - self.u0)


def _solver(name: str, f: Slope, n: int, rtol: float) -> Solver:
    if name == "exact" or n == 0:
        return Stateless()
    if name == "rk4":
        return RungeKutta(f)
    if name == "CVode":
        from cosim.fmi.driving.cvode import CVode

        return CVode(f, n, rtol=rtol)
    return Adaptive(name, f, rtol=rtol)


def _with_numbers(model: LinearModel, numbers: Design) -> LinearModel:
    A, B, C, D, X0, Xu = (numbers[name] for name in ("A", "B", "C", "D", "X0", "Xu"))
    return replace(model, A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)
