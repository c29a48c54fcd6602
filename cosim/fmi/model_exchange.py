"""A model exchange unit, generated or loaded, with a solver: a component.

One communication step from t0 to t1 (inputs in straight lines, held and discrete ones at u0)::

    event at t0, where a held or discrete input is not what the unit was given last (it was late)
    x <- solver(x' = get_derivatives after set_time, set_continuous_states, set continuous inputs)
    set_time(t1); set_continuous_states(x); set continuous inputs; completed_integrator_step
    event at t1, where the unit asks for it or a held or discrete input changes
    y <- outputs
    (event:         enter event mode, set inputs, update_discrete_states until settled)

The end of the run that a unit asks for in an event is remembered, and comes with the next ``advance`` at the latest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.solver import SOLVERS, Linear, LinearModel, integrator
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.messages import Message
from cosim.fmi.saved import SavedState, save
from cosim.fmi.start import Start, Starts
from cosim.fmi.unit import TERMINATED, ModelExchangeUnit

EVENT_ITERATIONS: Final = 100


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

    Raises
    ------
    FmuError
        If there is no such solver, it needs what the unit does not have, or a start value is wrong.
    """

    def __init__(self, unit: ModelExchangeUnit, solver: str | None = None, *, starts: Starts | None = None) -> None:
        self._unit, self._name = unit, unit.description.name
        self.solver = solver or ("rk4" if unit.linear is None else "exact")
        if self.solver not in SOLVERS:
            raise FmuError(f"{self._name}: no solver {solver!r}; {nearest(self.solver, SOLVERS)}")
        if self.solver == "exact" and unit.linear is None:
            raise FmuError(
                f"{self._name}: solver 'exact' needs the matrices of a linear model, an FMU does not show them; use 'rk4'"
            )
        self.interface = unit.interface
        self.notes: tuple[str, ...] = ()
        self._start = Start(unit, starts or {})
        self._outputs = unit.description.references("output")
        self._inputs, self._discrete = unit.description.references("input"), unit.description.discrete_inputs
        moving = (v for _, group in unit.description.ports("input") for v in group if v.variability == "continuous")
        self._moving, self._columns = unit.description.reference(v.name for v in moving), np.flatnonzero(~self._discrete)
        self._capabilities = unit.description.capabilities["me"]
        self._exact: Linear | None = None
        self._x = np.zeros(unit.description.n_states)
        self._given = np.zeros(self._inputs.size)  # of the inputs that jump: what the unit was given last
        self._ended = False  # the unit asked for the end of the run

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
        self._given, self._ended = np.array(u, np.float64), False
        return self._start.enter(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs at ``t``, the time reached, for inputs ``u``; those that jump go through an event.

        A unit with discrete states of its own keeps what that event does to them.
        """
        self._leave_initialization(t)
        self._set_inputs(t, np.array(u, np.float64, order="C"))
        return self._unit.get_float64(self._outputs)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        try:
            self._leave_initialization(float(t[0]))
            if self._jumps(u[0]):
                self._event(float(t[0]), np.array(u[0], np.float64))
        except RunError as error:
            raise Stopped(np.empty((0, self.interface.n_y)), str(error)) from error
        if self._ended:
            raise Stopped(np.empty((0, self.interface.n_y)), TERMINATED, failed=False)
        return self._advance_exactly(self._exact, t, h, u) if self._exact else self._integrate(t, u)

    def drain(self) -> list[Message]:
        """Give what the run showed about the unit since the last call."""
        return []

    def save(self) -> SavedState:
        """Copy the state.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        return save(self._unit, self._capabilities, (self._start.t, self._x.copy(), self._given.copy(), self._ended))

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._unit.set_fmu_state(state.unit)
        self._start.t, x, given, self._ended = state.own  # type: ignore[assignment]
        self._x, self._given = np.array(x), np.array(given)
        if self._exact:
            self._exact.state[:] = self._x

    def _leave_initialization(self, t: float) -> None:
        if not self._start.leave():
            return
        self._settle(t)
        if self._exact:
            self._exact.state[:] = self._x

    # --- the exact solver ---

    def _advance_exactly(self, exact: Linear, t: Vector, h: float, u: Matrix) -> Matrix:
        y = exact.advance(t, h, u)
        self._x = exact.state.copy()
        self._unit.set_time(float(t[-1]))
        self._unit.set_continuous_states(self._x)
        self._set_inputs(float(t[-1]), u[-1].copy())
        self._unit.completed_integrator_step()
        return y

    # --- solvers in steps ---

    def _integrate(self, t: Vector, u: Matrix) -> Matrix:
        unit, solve, derivative = self._unit, integrator(self.solver), self._derivative()
        times, u = t.tolist(), np.array(u, np.float64, order="C")
        ends = u[1:].copy()
        ends[:, self._jumping] = u[:-1, self._jumping]
        y = np.empty((len(times) - 1, self.interface.n_y))
        for k, t1 in enumerate(times[1:]):
            try:
                self._x = solve(derivative, times[k], t1, self._x, u[k], ends[k])
                unit.set_time(t1)
                unit.set_continuous_states(self._x)
                self._set_continuous(ends[k])
                event, end = unit.completed_integrator_step() if self._capabilities.completed_step else (False, False)
                self._ended |= end
                if event or self._jumps(u[k + 1]):
                    self._event(t1, u[k + 1])
                y[k] = unit.get_float64(self._outputs)
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
            if self._ended:
                raise Stopped(y[: k + 1].copy(), TERMINATED, failed=False)
        return y

    def _derivative(self) -> Callable[[float, Vector, Vector], Vector]:
        unit, set_inputs = self._unit, self._set_continuous

        def derivative(t: float, x: Vector, u: Vector) -> Vector:
            unit.set_time(t)
            unit.set_continuous_states(x)
            set_inputs(u)
            return unit.get_derivatives()

        return derivative

    # --- inputs and events ---

    def _set_inputs(self, t: float, u: Vector) -> None:
        if self._jumps(u):
            self._event(t, u)
        else:
            self._set_continuous(u)

    def _set_continuous(self, u: Vector) -> None:
        """Set what may change while time moves."""
        if self._columns.size == u.size:
            self._unit.set_float64(self._moving, u)
        elif self._columns.size:
            self._unit.set_float64(self._moving, u[self._columns])

    def _jumps(self, u: Vector) -> bool:
        """Whether a held or discrete input is not what the unit was given last."""
        return self._jumping.size > 0 and bool((u[self._jumping] != self._given[self._jumping]).any())

    def _event(self, t: float, u: Vector) -> None:
        """Set the inputs at ``t`` and let the discrete states settle."""
        self._unit.enter_event_mode()
        self._unit.set_float64(self._inputs, u)
        self._given = u.copy()
        self._settle(t)

    def _settle(self, t: float) -> None:
        """Iterate the discrete states, hear whether it is the end of the run, let time move again."""
        self._ended |= _settle(self._unit, t)
        self._unit.enter_continuous_time_mode()
        self._x = self._unit.get_continuous_states()


def _with_numbers(model: LinearModel, numbers: Design) -> LinearModel:
    A, B, C, D, X0, Xu = (numbers[name] for name in ("A", "B", "C", "D", "X0", "Xu"))
    return replace(model, A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)


def _settle(unit: ModelExchangeUnit, t: float) -> bool:
    """Iterate the discrete states (FMI 2.0.4 section 3.2.2); True: the unit asks for the end of the run.

    Raises
    ------
    RunError
        If they do not settle, or the unit announces a time event.
    """
    for _ in range(EVENT_ITERATIONS):
        found = unit.update_discrete_states()
        if found.next_event_time is not None:
            raise RunError(
                f"{unit.description.name}: announces a time event at {found.next_event_time} s; events are not located yet in "
                'model exchange; use mode = "cs" if the FMU has it'
            )
        if found.terminate or not found.need_update:
            return found.terminate
    raise RunError(f"{unit.description.name}: discrete states do not settle at t = {t} s after {EVENT_ITERATIONS} iterations")
