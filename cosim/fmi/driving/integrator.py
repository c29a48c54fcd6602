"""A model exchange unit moving through time: its solver, its inputs, its events.

One communication step from t0 to t1 (inputs in straight lines, held and discrete ones at u0)::

    arrive at t0: what is due there happens with the inputs u0; so does a held or discrete input that is not as before
    repeat until t1:
        the solver steps on, to t1 or the next time event at most
        where an event indicator changed its domain: back to the first such time, just behind the change
        set_time, set_continuous_states, set continuous inputs; completed_integrator_step
        a state, time or step event before t1: happens; the solver starts anew.  At t1: is due
    look: y <- outputs after what is due at t1, with the inputs u1

    (event:  enter_event_mode, set inputs, update_discrete_states until settled, enter_continuous_time_mode, read states)

In the residual form x has z behind it. Where inputs or discrete states change without time, z is solved for; see ``residual.py``.

The solver runs on over communication points, and starts anew after an event or where a continuous input jumps.

An event at t1 belongs to the inputs there, which a loop may still correct. A unit that can go back shows its outputs after the
event and goes back; the event happens when the next step arrives. One that cannot is left behind the event: what its discrete
states make of inputs that are corrected later, they keep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import RunError
from cosim.fmi.driving.events import EVENTS, EventKind, EventList, close, crosses, locate, settle
from cosim.fmi.driving.residual import RADAU, RadauIIA, ResidualForm
from cosim.fmi.driving.solvers import Adaptive, RungeKutta, Slope, Solver, Stateless
from cosim.fmi.instance import ModelExchangeInstance

NONE: Final = np.empty(0)


@dataclass(slots=True)
class IntegratorState:
    """Where a unit is. Arrays are replaced, never written to, so that a shallow copy keeps the state."""

    t: float = 0.0
    x: Vector = field(default_factory=lambda: NONE)  # in the residual form with z behind
    given: Vector = field(default_factory=lambda: NONE)  # all inputs, as the unit has them
    indicators: Vector = field(default_factory=lambda: NONE)
    nominals: Vector = field(default_factory=lambda: NONE)
    next_event: float = math.inf
    due: tuple[EventKind, ...] = ()  # events at t that did not happen yet
    ended: bool = False  # the unit asked for the end of the run


class Line:
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


@final
class Integrator:
    """Where a unit is, and what moves it on.

    Parameters
    ----------
    unit : ModelExchangeInstance
    solver : str
        One of ``cosim.fmi.driving.solvers.SOLVERS``, or ``RADAU`` for the residual form; ``exact``: its owner moves it.
    rtol : float
        Relative tolerance of the states.

    Attributes
    ----------
    now : Reached
    jumping : array of int
        Which inputs go through events: held and discrete ones; its owner says so.
    events : EventList
    """

    def __init__(self, instance: ModelExchangeInstance, solver: str, *, rtol: float) -> None:
        self._instance, self._name, description = (
            instance,
            instance.description.name,
            instance.description,
        )
        self._outputs, self._inputs = (
            description.references("output"),
            description.references("input"),
        )
        self._capabilities = description.capabilities["me"]
        self._moving = self._inputs.select(~description.discrete_inputs)
        self._n, self._n_z = description.n_states, description.event_indicators
        self._form = ResidualForm(instance) if solver == RADAU else None
        self._solver = (
            _solver(solver, self._derivative, self._n, rtol)
            if self._form is None
            else RadauIIA(self._name, self._equations, self._jacobian, self._n)
        )
        self._scaled = (
            solver not in ("exact", "rk4") and self._n > 0
        )  # the solver wants nominal values
        self._goes_back = (
            self._capabilities.saves_state and solver != "exact"
        )  # a linear model has nothing to undo
        self._copy: object | None = None  # of the unit's state; its memory is used again
        self._line = Line(0.0, 0.0, NONE, NONE)
        self._set = math.nan  # the time whose inputs, on the line, the unit has
        self.now = IntegratorState()
        self.jumping: NDArray[np.intp] = np.flatnonzero(description.discrete_inputs)
        self.events = EventList()

    def begin(self) -> None:
        """Settle what the initialization left; from here on time may move."""
        self._settle()
        self._restart()

    def save(self) -> object:
        """Copy everything but the unit's own state."""
        return replace(self.now), self._solver.save(), self.events.save()

    def restore(self, state: object) -> None:
        """Go back to a saved state, after the unit."""
        now, solver, events = state  # type: ignore[misc]
        self.now, self._set = replace(now), math.nan  # type: ignore[has-type]
        self._solver.restore(solver)  # type: ignore[has-type]
        self.events.restore(events)  # type: ignore[has-type]

    def move(self, line: Line) -> bool:
        """Integrate over a communication step, with the events before its end; False: the unit asked for the end on the way.

        Raises
        ------
        RunError
            If the events do not end.
        """
        self._line = line
        for _ in range(EVENTS):
            kinds, now = self._to_event(line.t1), self.now
            if now.t >= line.t1:
                now.due, now.given = kinds, line.u1
                return True
            if now.ended:
                return False
            now.due = kinds
            self.arrive(line(now.t))
            if self.now.ended:
                return False
        raise RunError(
            f"{self._name}: {EVENTS} events between t = {line.t0} s and {line.t1} s, the last at {self.now.t} s; they do not end"
        )

    def _to_event(self, t1: float) -> tuple[EventKind, ...]:
        """Integrate to the next event, or to ``t1`` at most; give what is due there."""
        now, solver = self.now, self._solver
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
                z = self._instance.get_event_indicators()
                if crosses(now.indicators, z):
                    t = locate(self._indicators, begin, now.indicators, t, z)
                    x, t = solver.at(t), stop if stop - t <= close(stop) else t
                    self._put(t, x)
                    kinds = ("state event",)
                now.indicators = z
            now.t, now.x = t, x
            if self._capabilities.completed_step:
                wanted, now.ended = self._instance.completed_integrator_step()
                kinds += ("step event",) if wanted else ()
            kinds = self._with_time_event(kinds)
            if kinds or now.ended or now.t >= t1:
                return kinds

    def _with_time_event(self, kinds: tuple[EventKind, ...]) -> tuple[EventKind, ...]:
        """Add the time event, if it is here; the unit then sees no time before it."""
        now = self.now
        if now.next_event - now.t > close(now.t):
            return kinds
        if now.next_event > now.t:
            now.t = now.next_event
            self._put(now.t, now.x)
        return *kinds, "time event"

    def _derivative(self, t: float, x: Vector) -> Vector:
        self._put(t, x)
        return self._instance.get_derivatives()

    def _indicators(self, t: float) -> Vector:
        self._put(t, self._solver.at(t))
        return self._instance.get_event_indicators()

    def _put(self, t: float, x: Vector) -> None:
        """Set time, states, and the continuous inputs on the line."""
        if t != self._set:
            self._instance.set_time(t)
            self.set_continuous(self._line(t))
            self._set = t
        if self._form is not None:
            self._form.put(x)
        elif self._n:
            self._instance.set_continuous_states(x)

    def _equations(self, t: float, w: Vector) -> Vector:
        assert self._form is not None
        self._put(t, w)
        return self._form.values()

    def _jacobian(self, t: float, w: Vector, scale: Vector) -> Matrix:
        assert self._form is not None
        self._put(t, w)
        return self._form.jacobian(w, lambda w: self._equations(t, w), scale)

    # --- inputs and events ---

    def set_continuous(self, u: Vector) -> None:
        """Set what may change while time moves."""
        if self._moving.size or not self._moving.is_part:
            self._instance.set_float64(self._moving, self._moving.take(u))

    def _jumps(self, u: Vector) -> bool:
        """Whether a held or discrete input is not what the unit was given last."""
        return self.jumping.size > 0 and bool(
            (u[self.jumping] != self.now.given[self.jumping]).any()
        )

    def look(self, u: Vector) -> Vector:
        """Give the outputs for inputs ``u``, after what is due; then go back, if the unit can."""
        now = self.now
        if now.ended:
            return self._instance.get_float64(self._outputs)
        if not (now.due or self._jumps(u)):
            moved = u.tobytes() != now.given.tobytes()
            if moved or math.isnan(self._set):
                self.set_continuous(u)
                self._set = math.nan
                if self._form is not None:
                    self._form.put(self._form.solved(now.t, now.x) if moved else now.x)
        elif self._goes_back:
            return self._look_ahead(u)
        else:
            self.arrive(u)
        return self._instance.get_float64(self._outputs)

    def _look_ahead(self, u: Vector) -> Vector:
        instance, before = self._instance, replace(self.now)
        self._copy = instance.get_fmu_state(self._copy)
        self._event(u)
        y = instance.get_float64(self._outputs)
        if not self.now.ended:
            instance.set_fmu_state(self._copy)
            self.now = before
        return y

    def arrive(self, u: Vector) -> None:
        """Let happen what is due at the time reached, with the inputs from here on; the solver starts anew if need be."""
        now = self.now
        if now.due or self._jumps(u):
            for kind in now.due or ("input event",):
                self.events.add(kind, now.t)
            self._event(u)
            self._restart()
        elif u.tobytes() != now.given.tobytes():
            self.set_continuous(u)
            self._set, now.given = math.nan, u
            if self._form is not None:
                now.x = self._form.solved(now.t, now.x)
            self._restart()
            if self._n_z:
                before, now.indicators = now.indicators, self._instance.get_event_indicators()
                if crosses(before, now.indicators):
                    now.due = ("state event",)
                    self.arrive(u)

    def _event(self, u: Vector) -> None:
        """Let the discrete states settle, with all inputs."""
        self._instance.enter_event_mode()
        self._instance.set_float64(self._inputs, u)
        self.now.given = u
        if self._form is not None:
            self._form.solved(self.now.t, self.now.x)
        self._settle()

    def _settle(self) -> None:
        """Iterate the discrete states, hear whether it is the end of the run; if not, let time move again."""
        instance, now = self._instance, self.now
        found = settle(instance, now.t)
        now.due, self._set = (), math.nan
        now.ended |= found.terminate
        if now.ended:
            return
        now.next_event = math.inf if found.next_event_time is None else found.next_event_time
        if not now.next_event >= now.t - close(now.t):
            text = f"at t = {now.t} s it announces a time event at {now.next_event} s; needed a time that is not over"
            raise RunError(f"{self._name}: {text}")
        instance.enter_continuous_time_mode()
        if self._form is not None:
            now.x = self._form.solved(now.t, now.x)
        elif self._n:
            now.x = instance.get_continuous_states()
        if self._n_z:
            now.indicators = instance.get_event_indicators()
        if found.nominals_changed or not now.nominals.size:
            now.nominals = self._nominals()

    def _nominals(self) -> Vector:
        nominals = np.abs(self._instance.get_nominals()) if self._scaled else np.ones(self._n)
        for i in np.flatnonzero(~((nominals > 0.0) & (nominals < math.inf))).tolist():
            raise RunError(
                f"{self._name}: nominal value of state {i}: found {nominals[i]}, needed a number other than zero"
            )
        return nominals if self._form is None else np.concatenate([nominals, self._form.nominals])

    def _restart(self) -> None:
        self._solver.start(self.now.t, self.now.x, self.now.nominals)


def _solver(name: str, f: Slope, n: int, rtol: float) -> Solver:
    if name == "exact" or n == 0:
        return Stateless()
    if name == "rk4":
        return RungeKutta(f)
    if name == "CVode":
        from cosim.fmi.driving.cvode import CVode

        return CVode(f, n, rtol=rtol)
    return Adaptive(name, f, rtol=rtol)
