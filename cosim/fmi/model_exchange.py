"""A model exchange unit, generated or loaded, with a solver: a component.

One communication step from t0 to t1 (inputs in straight lines, held ones at u0)::

    x <- solver(x' = get_derivatives after set_time, set_continuous_states, set inputs)
    set_time(t1); set_continuous_states(x); set inputs; completed_integrator_step
    event mode, where the unit asks for it or an input jumps at t1: set inputs, update_discrete_states until settled
    y <- outputs
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.solver import SOLVERS, Linear, LinearModel, integrator
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.description import Description
from cosim.fmi.references import References
from cosim.fmi.saved import SavedState, save
from cosim.fmi.start import Start
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
            raise FmuError(
                f"{self._name}: solver 'exact' needs the matrices of a linear model, an FMU does not show them; use 'rk4'"
            )
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
            model = self._unit.linear = _with_numbers(model, recorded)
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
        self._set_inputs(np.array(u, np.float64, order="C"))
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
        return save(self._unit, self._capabilities, (self._start.t, self._x.copy()))

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
        times, u, held = t.tolist(), np.array(u, np.float64, order="C"), bool(self._held.any())
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
        """Set inputs that jump at ``t`` and let the discrete states settle; True: it is the end of the run."""
        self._unit.enter_event_mode()
        self._unit.set_float64(self._inputs, u)
        terminate = _settle(self._unit, t)
        self._unit.enter_continuous_time_mode()
        self._x = self._unit.get_continuous_states()
        return terminate


def _with_numbers(model: LinearModel, numbers: Design) -> LinearModel:
    A, B, C, D, X0, Xu = (numbers[name] for name in ("A", "B", "C", "D", "X0", "Xu"))
    return replace(model, A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)


def _continuous_inputs(description: Description) -> tuple[References, NDArray[np.intp] | None]:
    """Give the inputs that may be set in continuous-time mode and their columns; None: all of them."""
    variables = [v for _, group in description.ports("input") for v in group]
    continuous = [v.variability == "continuous" for v in variables]
    if all(continuous):
        return description.references("input"), None
    columns = np.repeat(continuous, [v.size for v in variables]).nonzero()[0]
    return description.reference(v.name for v, moves in zip(variables, continuous, strict=True) if moves), columns


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
