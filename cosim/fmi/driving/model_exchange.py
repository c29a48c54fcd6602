"""A model exchange unit, generated or loaded, with a solver: a component.

``motion.py`` says what happens in a communication step. The end of the run that a unit asks for is remembered, and comes with the
next ``advance`` at the latest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.core.linear import Linear, LinearModel
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.binary.messages import Message
from cosim.fmi.driving.initialization import Initialization, Starts
from cosim.fmi.driving.integrator import Integrator, IntegratorState, Line
from cosim.fmi.driving.residual import FORMS, RADAU, DaeForm
from cosim.fmi.driving.saved import SavedState, save
from cosim.fmi.driving.solvers import SOLVERS, STEPPING, TOLERANT
from cosim.fmi.instance import TERMINATED, ModelExchangeInstance

RTOL: Final = 1e-9
CLOSEST: Final = 1e-13  # what rounding leaves of a relative tolerance


@final
class ModelExchange:
    """A model exchange unit with a solver.

    Parameters
    ----------
    unit : ModelExchangeInstance
        Just instantiated.
    solver : str or None
        One of ``cosim.fmi.driving.solvers.SOLVERS``; None: ``exact`` where the unit's model is known to be linear, else ``RK45``.
    starts : mapping of variable name to StartValue
        Start values to set instead of the unit's own.
    rtol : float or None
        Relative tolerance of the states, for the solvers that keep one (``TOLERANT``), else None; None there: ``RTOL``. The
        absolute one is ``rtol`` times their nominal values.
    dae : {"ode", "residual"}
        Whether the unit calculates its algebraic variables, or they are solved for here; see ``residual.py``.

    Raises
    ------
    FmuError
        If there is no such solver or residual form, it needs what the unit or the machine does not have, the tolerance is not
        one or for a solver that keeps none, or a start value is wrong.
    """

    def __init__(
        self,
        instance: ModelExchangeInstance,
        solver: str | None = None,
        *,
        starts: Starts | None = None,
        rtol: float | None = None,
        dae: DaeForm = "ode",
    ) -> None:
        self._instance, self._name = instance, instance.description.name
        if dae not in FORMS:
            raise FmuError(f"{self._name}: dae = {dae!r}; {nearest(dae, FORMS)}")
        if dae == "residual" and solver is not None:
            raise FmuError(
                f"{self._name}: solver {solver!r}: the residual form has its own, {RADAU}; leave one of both out"
            )
        self.solver = (
            RADAU
            if dae == "residual"
            else solver or ("RK45" if instance.linear is None else "exact")
        )
        if self.solver not in (*SOLVERS, RADAU) or solver == RADAU:
            raise FmuError(
                f"{self._name}: no solver {solver!r}; {nearest(self.solver, STEPPING if instance.linear is None else SOLVERS)}"
            )
        if self.solver == "exact" and instance.linear is None:
            raise FmuError(
                f"{self._name}: solver 'exact' needs the matrices of a linear model, an FMU does not show them; "
                f"use one of: {', '.join(STEPPING)}"
            )
        if rtol is not None and self.solver not in TOLERANT:
            raise FmuError(
                f"{self._name}: relative tolerance {rtol}: solver {self.solver!r} takes the steps it is given; leave it out or "
                f"use one of: {', '.join(TOLERANT)}"
            )
        rtol = RTOL if rtol is None else rtol
        if not CLOSEST <= rtol < 1.0:
            raise FmuError(
                f"{self._name}: relative tolerance {rtol}; needed at least {CLOSEST} and less than 1"
            )
        self.rtol = rtol if self.solver in TOLERANT else None
        self.interface = replace(
            instance.interface,
            prepares=True,
            rollback=instance.description.capabilities["me"].saves_state,
        )
        self.notes: tuple[str, ...] = ()
        self._start = Initialization(instance, starts or {})
        self._discrete, self._capabilities = (
            instance.description.discrete_inputs,
            instance.description.capabilities["me"],
        )
        self._motion = Integrator(instance, self.solver, rtol=rtol)
        self._exact: Linear | None = None

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize for the exact solver; a known model's numbers are recorded, and taken from the record."""
        held = held | self._discrete
        jumping = (
            self._discrete if self.solver == "exact" else held
        )  # exact: a jump of a held input is in the matrices
        self._motion.jumping = np.flatnonzero(jumping)
        model = self._instance.linear
        if model is None:
            return {}
        if recorded:
            model = self._instance.linear = _with_numbers(model, recorded)
        if self.solver != "exact":
            return model.arrays
        self._exact = Linear(model)
        return self._exact.prepare(h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        self._motion.now = IntegratorState(t, given=np.array(u, np.float64))
        return self._start.enter(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs at ``t``, the time reached, for inputs ``u``, after what is due there."""
        self._leave_initialization()
        return self._motion.look(np.array(u, np.float64, order="C"))

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        try:
            self._leave_initialization()
            if not self._motion.now.ended:
                self._motion.arrive(np.array(u[0], np.float64))
        except RunError as error:
            raise Stopped(np.empty((0, self.interface.n_y)), str(error)) from error
        if self._motion.now.ended:
            raise Stopped(np.empty((0, self.interface.n_y)), TERMINATED, failed=False)
        return self._advance_exactly(self._exact, t, h, u) if self._exact else self._integrate(t, u)

    def drain(self) -> list[Message]:
        """Give the events since the last call, at level debug."""
        return self._motion.events.drain()

    def save(self) -> SavedState:
        """Copy the state, the solver's included.

        CVode and LSODA cannot be copied: they start anew here, so that both branches begin alike.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        return save(self._instance, self._capabilities, (self._start.t, self._motion.save()))

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._instance.set_fmu_state(state.instance)
        self._start.t, motion = state.own  # type: ignore[assignment]
        self._motion.restore(motion)
        if self._exact and self._start.t is None:
            self._exact.state[:] = self._motion.now.x

    def _leave_initialization(self) -> None:
        if not self._start.leave():
            return
        self._motion.begin()
        if self._exact and not self._motion.now.ended:
            self._exact.state[:] = self._motion.now.x

    # --- the exact solver ---

    def _advance_exactly(self, exact: Linear, t: Vector, h: float, u: Matrix) -> Matrix:
        y = exact.advance(t, h, u)
        now, end = self._motion.now, u[-1].copy()
        now.t, now.x = float(t[-1]), exact.state.copy()
        end[self._motion.jumping] = now.given[self._motion.jumping]
        self._instance.set_time(now.t)
        self._instance.set_continuous_states(now.x)
        self._motion.set_continuous(end)
        self._instance.completed_integrator_step()
        now.given = end
        return y

    # --- solvers in steps ---

    def _integrate(self, t: Vector, u: Matrix) -> Matrix:
        times, u = t.tolist(), np.array(u, np.float64, order="C")
        ends = u[1:].copy()
        ends[:, self._motion.jumping] = u[:-1, self._motion.jumping]
        y = np.empty((len(ends), self.interface.n_y))
        for k, t1 in enumerate(times[1:]):
            try:
                arrived = self._motion.move(Line(times[k], t1, u[k], ends[k]))
                if arrived and k < len(ends) - 1:
                    self._motion.arrive(u[k + 1])
                if arrived:
                    y[k] = self._motion.look(u[k + 1])
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
            if self._motion.now.ended:
                raise Stopped(y[: k + arrived].copy(), TERMINATED, failed=False)
        return y


def _with_numbers(model: LinearModel, numbers: Design) -> LinearModel:
    A, B, C, D, X0, Xu = (numbers[name] for name in ("A", "B", "C", "D", "X0", "Xu"))
    return replace(model, A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)
