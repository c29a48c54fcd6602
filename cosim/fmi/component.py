"""Units as components: what drives a model exchange unit, generated or loaded, and what drives a co-simulation unit.

Model exchange, one communication step from t0 to t1 (inputs in straight lines, held ones at u0)::

    x <- solver(x' = get_derivatives(set_time, set_continuous_states, set inputs))
    set_time(t1); set_continuous_states(x); set inputs; completed_integrator_step
    event mode, where the unit asks for it or an input jumps at t1: set inputs, update_discrete_states until settled
    y <- outputs

Co-simulation: where the unit interpolates inputs it gets u0 and the slope, else the mean of both ends: second order for states.
Its outputs then belong to the inputs it had at the end, u_end, and are corrected to the inputs at t1 by D (u1 - u_end), with D from
directional derivatives at t1. FMI forbids setting inputs and reading outputs without a step between, so that is never done.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.signals import Interface
from cosim.core.solver import SOLVERS, Linear, integrator
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.description import Capabilities, Description
from cosim.fmi.start import Start
from cosim.fmi.unit import CoSimulationUnit, ModelExchangeUnit, References, Unit

EVENT_ITERATIONS = 100
TERMINATED = "the unit asks for the end of the run"


@dataclass(frozen=True, eq=False)
class SavedState:
    """A unit's state and what its component keeps beside it."""

    unit: object
    own: tuple[object, ...]


def _save(unit: Unit, capabilities: Capabilities, own: tuple[object, ...]) -> SavedState:
    if not capabilities.saves_state:
        raise FmuError(f"{unit.description.name}: the unit cannot save its state (canGetAndSetFMUstate is false)")
    saved = SavedState(unit.get_fmu_state(), own)
    weakref.finalize(saved, unit.free_fmu_state, saved.unit)
    return saved


@final
class ModelExchange:
    """A model exchange unit with a solver.

    Parameters
    ----------
    unit : ModelExchangeUnit
        Just instantiated.
    solver : str or None
        One of ``cosim.core.solver.SOLVERS``; None: ``exact`` where the unit's model is known to be linear, else ``rk4``.
    starts : mapping of variable name to float
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If there is no such solver, it needs what the unit does not have, or a start value is wrong.
    """

    def __init__(self, unit: ModelExchangeUnit, solver: str | None = None, *, starts: Mapping[str, float] | None = None) -> None:
        self._unit, self._name = unit, unit.description.name
        self.solver = solver or ("rk4" if unit.linear is None else "exact")
        if self.solver not in SOLVERS:
            raise FmuError(f"{self._name}: no solver {solver!r}; {nearest(self.solver, SOLVERS)}")
        if self.solver == "exact" and unit.linear is None:
            raise FmuError(f"{self._name}: solver 'exact' needs the matrices of a linear model, an FMU does not show them; use 'rk4'")
        self.interface = unit.interface
        self.notes: tuple[str, ...] = ()
        self._start = Start(unit, starts or {})
        self._outputs = unit.description.references("output")
        self._moving, self._columns = _continuous_inputs(unit.description)
        self._inputs = unit.description.references("input")
        self._capabilities = unit.description.capabilities["me"]
        self._exact: Linear | None = None
        self._x = np.zeros(unit.description.n_states)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretise for the exact solver; a known model's numbers are recorded, and taken from the record."""
        self._held = held
        model = self._unit.linear
        if model is None:
            return {}
        if recorded:
            model = self._unit.linear = replace(model, **{name: recorded[name] for name in model.arrays})
        if self.solver != "exact":
            return model.arrays
        self._exact = Linear(model)
        return self._exact.prepare(h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        return self._start.enter(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs at ``t``, the time reached, for inputs ``u``."""
        self._leave_initialization(t)
        self._set_inputs(np.ascontiguousarray(u))
        return self._unit.get_float64(self._outputs)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        try:
            self._leave_initialization(float(t[0]))
        except RunError as error:
            raise Stopped(np.empty((0, self.interface.n_y)), str(error)) from error
        return self._advance_exactly(self._exact, t, h, u) if self._exact else self._integrate(t, u)

    def save(self) -> SavedState:
        """Copy the state.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        return _save(self._unit, self._capabilities, (self._start.t, self._x.copy()))

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._unit.set_fmu_state(state.unit)
        self._start.t, self._x = state.own[0], np.array(state.own[1])  # type: ignore[assignment]
        if self._exact:
            self._exact.state[:] = self._x

    def _leave_initialization(self, t: float) -> None:
        if not self._start.leave():
            return
        _settle(self._unit, t)
        self._unit.enter_continuous_time_mode()
        self._x = self._unit.get_continuous_states()
        if self._exact:
            self._exact.state[:] = self._x

    # --- the exact solver ---

    def _advance_exactly(self, exact: Linear, t: Vector, h: float, u: Matrix) -> Matrix:
        y = exact.advance(t, h, u)
        self._x = exact.state.copy()
        self._unit.set_time(float(t[-1]))
        self._unit.set_continuous_states(self._x)
        self._set_inputs(u[-1].copy())
        self._unit.completed_integrator_step()
        return y

    # --- solvers in steps ---

    def _integrate(self, t: Vector, u: Matrix) -> Matrix:
        unit, solve, derivative = self._unit, integrator(self.solver), self._derivative()
        times, u, held = t.tolist(), np.ascontiguousarray(u), bool(self._held.any())
        ends = u[1:]
        if held:
            ends = ends.copy()
            ends[:, self._held] = u[:-1, self._held]
        y = np.empty((len(times) - 1, self.interface.n_y))
        for k, t1 in enumerate(times[1:]):
            try:
                self._x = solve(derivative, times[k], t1, self._x, u[k], ends[k])
                unit.set_time(t1)
                unit.set_continuous_states(self._x)
                self._set_inputs(ends[k])
                event, terminate = unit.completed_integrator_step() if self._capabilities.completed_step else (False, False)
                if event or (held and (ends[k] != u[k + 1]).any()):
                    terminate = self._event(t1, u[k + 1]) or terminate
                y[k] = unit.get_float64(self._outputs)
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
            if terminate:
                raise Stopped(y[: k + 1].copy(), TERMINATED, failed=False)
        return y

    def _derivative(self) -> Callable[[float, Vector, Vector], Vector]:
        unit, set_inputs = self._unit, self._set_inputs

        def derivative(t: float, x: Vector, u: Vector) -> Vector:
            unit.set_time(t)
            unit.set_continuous_states(x)
            set_inputs(u)
            return unit.get_derivatives()

        return derivative

    def _set_inputs(self, u: Vector) -> None:
        """Set what may change while time moves; discrete inputs wait for event mode."""
        if self._columns is None:
            self._unit.set_float64(self._moving, u)
        elif self._moving.size:
            self._unit.set_float64(self._moving, u[self._columns])

    def _event(self, t: float, u: Vector) -> bool:
        """Set inputs that jump at ``t`` and let the discrete states settle; is it the end of the run?"""
        self._unit.enter_event_mode()
        self._unit.set_float64(self._inputs, u)
        terminate = _settle(self._unit, t)
        self._unit.enter_continuous_time_mode()
        self._x = self._unit.get_continuous_states()
        return terminate


def _continuous_inputs(description: Description) -> tuple[References, Vector | None]:
    """Give the inputs that may be set in continuous-time mode and their columns; None: all of them."""
    variables = [v for _, group in description.ports("input") for v in group]
    continuous = [v.variability == "continuous" for v in variables]
    if all(continuous):
        return description.references("input"), None
    columns = np.repeat(continuous, [v.size for v in variables]).nonzero()[0]
    return description.reference(v.name for v, moves in zip(variables, continuous, strict=True) if moves), columns


def _settle(unit: ModelExchangeUnit, t: float) -> bool:
    """Iterate the discrete states (FMI 2.0.4 section 3.2.2); does the unit ask for the end of the run?

    Raises
    ------
    RunError
        If they do not settle, or the unit announces a time event.
    """
    for _ in range(EVENT_ITERATIONS):
        found = unit.update_discrete_states()
        if found.next_event_time is not None:
            raise RunError(
                f"{unit.description.name}: announces a time event at {found.next_event_time} s; events are not located yet in model "
                'exchange; use mode = "cs" if the FMU has it'
            )
        if found.terminate or not found.need_update:
            return found.terminate
    raise RunError(f"{unit.description.name}: discrete states do not settle at t = {t} s after {EVENT_ITERATIONS} iterations")


@final
class CoSimulation:
    """A co-simulation unit.

    Parameters
    ----------
    unit : CoSimulationUnit
        Just instantiated.
    starts : mapping of variable name to float
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If a start value is wrong.
    """

    def __init__(self, unit: CoSimulationUnit, *, starts: Mapping[str, float] | None = None) -> None:
        self._unit = unit
        self.interface = unit.interface
        self.notes: tuple[str, ...] = ()
        self._start = Start(unit, starts or {})
        description = unit.description
        self._capabilities = description.capabilities["cs"]
        self._inputs, self._outputs = description.references("input"), description.references("output")
        self._slopes = self._capabilities.interpolates_inputs and self._inputs.plain
        self._direct = _Direct(description) if self._capabilities.directional_derivatives else None
        self._read, self._belongs = np.zeros(self._outputs.size), np.zeros(self._inputs.size)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Learn which inputs are held; nothing is designed.

        Raises
        ------
        FmuError
            If the unit has a fixed inner step and ``h`` [s] is not a whole number of them.
        """
        fixed = self._capabilities.fixed_step
        if fixed and not self._capabilities.variable_step and abs(round(h / fixed) * fixed - h) > 1e-9 * h:
            nearest_step = max(1, round(h / fixed)) * fixed
            raise FmuError(
                f"{self._unit.description.name}: the communication step {h} s is not a whole number of the unit's fixed inner steps of "
                f"{fixed} s; nearest: {nearest_step} s"
            )
        self._held = held | np.array([v.variability != "continuous" for v in self._variables()], np.bool_)
        self.notes = self._accuracy()
        return {}

    def _variables(self) -> list[object]:
        raise NotImplementedError

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        self._read, self._belongs = self._start.enter(t, u), np.array(u)
        return self._read.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs last read, corrected to the inputs ``u`` by D where it is known."""
        self._start.leave()
        return self._outputs_for(u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        times, u = t.tolist(), np.ascontiguousarray(u)
        y = np.empty((len(times) - 1, self.interface.n_y))
        for k, t0 in enumerate(times[:-1]):
            try:
                self._start.leave()
                end = self._step(t0, h, u[k], u[k + 1])
                if end:
                    y[k] = self._outputs_for(u[k + 1])
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
        return y

    def _step(self, t: float, h: float, u0: Vector, u1: Vector) -> bool:
        raise NotImplementedError

    def _outputs_for(self, u: Vector) -> Vector:
        raise NotImplementedError

    def _accuracy(self) -> tuple[str, ...]:
        raise NotImplementedError


class _Direct:
    def __init__(self, description: Description) -> None:
        pass


__all__ = ["CoSimulation", "Interface", "ModelExchange"]
