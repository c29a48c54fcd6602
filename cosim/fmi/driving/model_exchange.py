"""A model exchange FMU, generated or loaded, with a solver: a component.

``integrator.py`` shows what happens in a communication step. The end of the run that an FMU
requests is remembered, and comes with the next ``advance`` at the latest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped, check_design
from cosim.core.linear import LinearModel, shapes_of
from cosim.core.linearization import Linearized
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.binary.messages import Message
from cosim.fmi.driving.clocks import EventClocks
from cosim.fmi.driving.compiled import CompiledIntegrator
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.exact import ExactSolver
from cosim.fmi.driving.initialization import Initialization, Starts
from cosim.fmi.driving.integrator import (
    Integrator,
    IntegratorSnapshot,
    IntegratorState,
    Interruption,
    LinearInputs,
)
from cosim.fmi.driving.left_limits import LeftLimits, jumping_outputs
from cosim.fmi.driving.local_model import has_continuous_ports
from cosim.fmi.driving.residual import FORMS, RADAU, DaeForm
from cosim.fmi.driving.saved import SavedState, restore, save
from cosim.fmi.driving.solvers import LIBRARIES, SOLVERS, STEPPING, TOLERANT
from cosim.fmi.driving.tuning import TunedParameters
from cosim.fmi.instance import TERMINATED, ModelExchangeInstance
from cosim.fmi.variable import Variable
from cosim.native.fmi.model_exchange import AT_BEGIN
from cosim.native.step import NativeStep

RTOL: Final = 1e-9
CLOSEST: Final = 1e-13  # what rounding leaves of a relative tolerance
DEPENDS: Final = "on another processor the last bits may differ"


class ModelExchangeState(NamedTuple):
    """What a ``ModelExchange`` keeps beside the FMU's own state."""

    initialization_time: float | None  # of its initialization mode
    integrator: IntegratorSnapshot


@final
class ModelExchange:
    """A model exchange FMU with a solver.

    Parameters
    ----------
    instance : ModelExchangeInstance
        Just instantiated.
    solver : str or None
        One of ``cosim.fmi.driving.solvers.SOLVERS``; None: ``exact`` where the model is known to be
        linear, else ``RK45``.
    starts : mapping of variable name to StartValue
        Start values to set instead of the FMU's own.
    rtol : float or None
        Relative tolerance of the states, for the solvers that keep one (``TOLERANT``), else None;
        None there: ``RTOL``. The absolute one is ``rtol`` times their nominal values.
    max_step : float or None
        The longest step of the solver [s]; None: as long as the tolerance allows, or, without one,
        the communication step.
    dae : {"ode", "residual"}
        Whether the FMU calculates its algebraic variables, or they are solved for here; see
        ``residual.py``.

    Attributes
    ----------
    solver : str
        The one that is used.
    rtol : float or None
        The relative tolerance that is kept; None: the solver keeps none.

    Raises
    ------
    FmuError
        If there is no such solver or residual form, it needs what the FMU or the machine does not
        have, the tolerance is not one or for a solver that keeps none, or a start value is wrong.
    """

    def __init__(
        self,
        instance: ModelExchangeInstance,
        solver: str | None = None,
        *,
        starts: Starts | None = None,
        rtol: float | None = None,
        max_step: float | None = None,
        dae: DaeForm = "ode",
    ) -> None:
        self.solver = _choose_solver(instance, solver, dae)
        tolerance = _choose_tolerance(instance.description.name, self.solver, rtol)
        self.rtol = tolerance if self.solver in TOLERANT else None
        self._max_step = max_step
        if max_step is not None and not 0.0 < max_step < math.inf:
            raise FmuError(
                f"{instance.description.name}: max_step: expected a time > 0 s, got {max_step}"
            )
        self.notes: tuple[str, ...] = _notes(instance.description.name, self.solver)
        self._instance = instance
        diagnostics = Diagnostics(instance.description.name)
        self._clocks = EventClocks(instance, diagnostics)
        self._initialization = Initialization(instance, starts or {}, diagnostics, self._clocks)
        self._discrete = instance.description.discrete_inputs
        self._capabilities = instance.description.capabilities["me"]
        self._integrator = Integrator(
            instance,
            self.solver,
            self._clocks,
            diagnostics,
            rtol=tolerance,
            max_step=max_step or math.inf,
        )
        has_compiled_steps = self._integrator.is_explicit and not instance.description.drives_clocks
        self._addresses = instance.addresses() if has_compiled_steps else None
        self.interface = replace(
            instance.interface,
            prepares=True,
            rollback=self._capabilities.saves_state,
            native=self.solver == "exact" or self._addresses is not None,
            restarts=self.solver == "CVode",
            linearizable=self.solver != RADAU and has_continuous_ports(instance.description),
            substeps=True,
            left_limits=jumping_outputs(instance.description) if self._may_have_events else (),
            locates_events=self._may_have_events,
            keeps_events=self._may_have_events and not self._capabilities.saves_state,
            continuous=True,
        )
        self._integrator.keeps_left = bool(self.interface.left_limits)
        self._left_limits = LeftLimits()
        self._exact: ExactSolver | None = None
        self._compiled: CompiledIntegrator | None = None

    @property
    def _may_have_events(self) -> bool:
        """Whether the FMU has event indicators, discrete variables or clocks."""
        return self.solver != "exact" and self._instance.description.has_discrete_parts

    @property
    def metadata(self) -> dict[str, str | float]:
        """What a log keeps of the solver: its name, its tolerance, and what its bits depend on."""
        metadata: dict[str, str | float] = {"solver": self.solver}
        if self.rtol is not None:
            metadata["tolerance"] = self.rtol
        if self._max_step is not None:
            metadata["max_step"] = self._max_step
        library = LIBRARIES.get(self.solver)
        if library is not None:
            metadata["bits"] = f"solver {self.solver} computes with {library}: {DEPENDS}"
        return metadata

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize for the exact solver.

        The numbers of a known model are recorded, and taken from the record.
        """
        held = held | self._discrete
        # With the exact solver the jump of an input with a zero-order hold is in the matrices.
        in_events = self._discrete if self.solver == "exact" else held
        self._integrator.event_inputs = np.flatnonzero(in_events)
        self._compiled = None
        model = self._instance.linear
        if model is None:
            return {}
        if self.solver == "exact":
            self._exact = ExactSolver(model, self._instance, self._integrator)
            design = self._exact.prepare(h, held, recorded)
        else:
            design = recorded or model.arrays
            check_design(design, shapes_of(model.arrays))
        self._instance.linear = _with_numbers(model, design)
        return design

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Discretize for the exact solver; the others take steps of any length."""
        if self._exact is None:
            return {}
        return self._exact.prepare_substeps(lengths, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize at ``t``; stays in initialization mode until the first advance."""
        self._take_over()
        self._integrator.state = IntegratorState(t, inputs=np.array(u, np.float64))
        y = self._initialization.enter(t, u)
        self._clocks.begin(y)
        return y

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs at ``t``, the time reached, after what is due there."""
        self._finish(self._take_over())
        self._leave_initialization()
        y = self._integrator.outputs(np.array(u, np.float64, order="C"))
        self._left_limits.keep(t, self._integrator.left)
        self._hand_over()
        return y

    def left_limits(self, t: Vector) -> dict[int, Vector]:
        """Return the outputs before events at the ends of the last steps, by place in ``t``."""
        return self._left_limits.at(t)

    def first_event(self) -> float:
        """Return the time of the first event inside the last step [s]; infinity: none."""
        if self._compiled:
            return self._compiled.first_event
        return self._integrator.events.first

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        interruption = self._take_over()
        self._left_limits.clear()
        no_rows = np.empty((0, self.interface.n_y))
        try:
            self._finish(interruption)
            self._leave_initialization()
        except RunError as error:
            raise Stopped(no_rows, str(error)) from error
        if interruption is None or interruption.reached == AT_BEGIN:
            interruption = None
            self._begin_step(u[0], no_rows)
        if self._exact:
            y = self._advance_exactly(self._exact, t, h, u)
        else:
            y = self._integrate(t, u, interruption)
        self._hand_over()
        return y

    def _begin_step(self, u: Vector, no_rows: Matrix) -> None:
        """Handle what is due where a step begins; stop where the FMU requests the end."""
        if not self._integrator.state.ended:
            self._handle_events(u, no_rows)
        if self._integrator.state.ended:
            raise Stopped(no_rows, TERMINATED, failed=False)

    def drain(self) -> list[Message]:
        """Return the events since the last call, at level debug, and warnings."""
        if self._compiled:
            self._compiled.list_events()
            self._compiled.begin_events()
        return self._integrator.events.drain() + self._integrator.diagnostics.drain()

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize at the states that are reached; None: there are time events, or it has ended.

        Its solver is taken as exact.
        """
        model = self._instance.linear
        if model is not None:
            x = model.initial(t, u)
            own = Linearized(model.A, model.B, model.C, model.D)
            return own.at(x, u, model.derivatives(t, x, u))
        self._finish(self._take_over())
        self._leave_initialization()
        matrices = self._integrator.linearized(np.array(u, np.float64))
        self._hand_over()
        return matrices

    def discard(self) -> None:
        """Forget all events and warnings, so that each may come again."""
        self.drain()
        self._integrator.diagnostics.discard()

    def save(self) -> SavedState[ModelExchangeState]:
        """Copy the state, the solver's included.

        CVode and LSODA cannot be copied: they start anew here, so that both branches begin alike.

        Raises
        ------
        FmuError
            If the FMU cannot save its state.
        """
        self._finish(self._take_over())
        state = ModelExchangeState(self._initialization.mode_time, self._integrator.save())
        saved = save(self._instance, self._capabilities, state)
        self._hand_over()
        return saved

    def restore(self, state: SavedState[ModelExchangeState]) -> None:
        """Go back to a saved state."""
        self._take_over()
        own = restore(self._instance, state)
        self._initialization.mode_time = own.initialization_time
        self._integrator.restore(own.integrator)
        if self._exact and self._initialization.mode_time is None:
            self._exact.begin()
        self._hand_over()

    def tune(self, t: float, parameters: TunedParameters) -> None:
        """Set tunable parameters at ``t``, the time reached.

        Raises
        ------
        RunError
            If the FMU refuses them.
        """
        self._finish(self._take_over())
        self._leave_initialization()
        self._integrator.tune(parameters)
        self._hand_over()

    @property
    def state_names(self) -> tuple[str, ...]:
        """The names of the elements of the continuous states, vectors numbered from 0.

        Empty where they have no names, of FMI 1, or others beside them, in the residual form.
        """
        description = self._instance.description
        if description.unnamed_states or self.solver == RADAU:
            return ()
        return element_names_of([description[name] for name in description.states])

    def nominals(self) -> dict[str, float]:
        """Return the nominal values of the continuous states as the FMU has them now."""
        if not self._instance.description.n_states:
            return {}
        given = self._instance.get_nominals().tolist()
        numbers = [f"state {i}" for i in range(len(given))]
        return dict(zip(self.state_names or numbers, given, strict=False))

    def states(self) -> Vector:
        """Return the continuous states at the time reached."""
        self._finish(self._take_over())
        self._leave_initialization()
        x = self._integrator.state.x.copy()
        self._hand_over()
        return x

    def continue_from(self, x: Vector) -> None:
        """Go on from other continuous states, at the time reached; what follows is an event."""
        self._finish(self._take_over())
        self._leave_initialization()
        self._integrator.continue_from(x)
        if self._exact:
            self._exact.begin()
        self._hand_over()

    def native(self) -> NativeStep | None:
        """Return the compiled step; see :class:`cosim.core.contracts.Native`."""
        self._finish(self._take_over())
        step: NativeStep | None = None
        if self._exact is not None:
            step = self._exact.native()
        elif self._addresses is not None:
            self._compiled = CompiledIntegrator(self._integrator, self._instance, self._addresses)
            step = self._compiled.native()
        self._hand_over()
        return step

    def _leave_initialization(self) -> None:
        if not self._initialization.leave():
            return
        self._integrator.begin()
        if self._exact and not self._integrator.state.ended:
            self._exact.begin()

    def _take_over(self) -> Interruption | None:
        """Go on from where compiled steps ended; none is taken until ``_hand_over``.

        Returns
        -------
        Interruption or None
            What is left of a step that was begun.
        """
        if self._compiled:
            return self._compiled.take_over()
        if self._exact:
            self._exact.take_over()
        return None

    def _finish(self, interruption: Interruption | None) -> None:
        """Finish the event that a compiled step was left in; raise what failed in it."""
        if self._compiled and interruption:
            self._compiled.finish(interruption)

    def _hand_over(self) -> None:
        """Hand over to compiled steps, unless the initialization is not over."""
        if self._initialization.mode_time is not None:
            return
        if self._compiled:
            self._compiled.hand_over()
        if self._exact:
            self._exact.hand_over()

    def _handle_events(self, u: Vector, rows: Matrix) -> None:
        """Handle what is due with inputs ``u``; an error comes with the rows completed so far."""
        try:
            self._integrator.handle_events(np.array(u, np.float64))
        except RunError as error:
            raise Stopped(rows.copy(), str(error)) from error

    # --- the exact solver ---

    def _advance_exactly(self, exact: ExactSolver, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance from one change of inputs that happens in events to the next."""
        steps = len(u) - 1
        y = np.empty((steps, self.interface.n_y))
        in_events = u[:-1, self._integrator.event_inputs]
        changes = np.flatnonzero((in_events[1:] != in_events[:-1]).any(axis=1)) + 1
        begin = 0
        for end in (*changes.tolist(), steps):
            if begin:
                self._handle_events(u[begin], y[:begin])
            if self._integrator.state.ended:
                raise Stopped(y[:begin].copy(), TERMINATED, failed=False)
            points = slice(begin, end + 1)
            y[begin:end] = exact.advance(t[points], h, u[points])
            begin = end
        return y

    # --- solvers in steps ---

    def _integrate(self, t: Vector, u: Matrix, interruption: Interruption | None) -> Matrix:
        """Step K times; the first step goes on where it was interrupted."""
        times = t.tolist()
        inputs = np.array(u, np.float64, order="C")
        # Inputs that change in events only keep their value to the end of the step.
        end_inputs = inputs[1:].copy()
        in_events = self._integrator.event_inputs
        end_inputs[:, in_events] = inputs[:-1, in_events]
        steps = len(end_inputs)
        y = np.empty((steps, self.interface.n_y))
        for k, t1 in enumerate(times[1:]):
            try:
                step_inputs = LinearInputs(times[k], t1, inputs[k], end_inputs[k])
                if interruption is None:
                    completed = self._integrator.integrate(step_inputs)
                else:
                    completed = self._integrator.go_on(step_inputs, interruption)
                    interruption = None
                # An event at the end of the block is left to the next advance: a loop may still
                # correct the inputs that it happens with.
                if completed and k < steps - 1 and not self._integrator.state.ended:
                    self._integrator.read_left(inputs[k + 1])
                    self._integrator.handle_events(inputs[k + 1])
                if completed:
                    y[k] = self._integrator.outputs(inputs[k + 1])
                    self._left_limits.keep(t1, self._integrator.left)
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
            if self._integrator.state.ended:
                raise Stopped(y[: k + completed].copy(), TERMINATED, failed=False)
        return y


def element_names_of(states: Sequence[Variable]) -> tuple[str, ...]:
    """Return the names of the elements of states, vectors numbered from 0.

    A vector is one array, or variables ``x[1]``, ``x[2]`` with the numbers of its elements.
    """
    names: list[str] = []
    for variable in states:
        is_vector = variable.size > 1 or bool(variable.dimensions)
        own = [f"{variable.name}[{i}]" for i in range(variable.size)]
        names += own if is_vector else [variable.name]
    lowest: dict[str, int] = {}
    for name in names:
        stem, number = split_index(name)
        if number is not None:
            lowest[stem] = min(number, lowest.get(stem, number))
    shifted = []
    for name in names:
        stem, number = split_index(name)
        shifted.append(name if number is None else f"{stem}[{number - lowest[stem]}]")
    return tuple(shifted)


def split_index(name: str) -> tuple[str, int | None]:
    """Return a name without its index, and the index; None: it has none."""
    stem, bracket, rest = name.rpartition("[")
    number = rest.removesuffix("]")
    is_index = bool(bracket) and rest.endswith("]") and number.isascii() and number.isdigit()
    return (stem, int(number)) if is_index else (name, None)


def _notes(name: str, solver: str) -> tuple[str, ...]:
    """Return what is to be known of a solver."""
    if solver != "LSODA":
        return ()
    return (
        f"{name}: LSODA starts anew at every communication point, which costs accuracy at each: "
        "the smaller the communication step, the larger the error, beyond the tolerance; BDF and "
        "CVode run on",
    )


def _choose_solver(instance: ModelExchangeInstance, solver: str | None, dae: DaeForm) -> str:
    """Return the solver to use; refuse one that does not exist or fit."""
    name = instance.description.name
    if dae not in FORMS:
        raise FmuError(f"{name}: dae = {dae!r}; {nearest(dae, FORMS)}")
    if dae == "residual":
        if solver is not None:
            raise FmuError(
                f"{name}: solver {solver!r}: the residual form has its own, {RADAU}; "
                "leave one of both out"
            )
        return RADAU
    is_linear = instance.linear is not None
    if not solver:
        return "exact" if is_linear else "RK45"
    if solver not in SOLVERS:
        available = SOLVERS if is_linear else STEPPING
        raise FmuError(f"{name}: no solver {solver!r}; {nearest(solver, available)}")
    if solver == "exact" and not is_linear:
        raise FmuError(
            f"{name}: solver 'exact' needs the matrices of a linear model, an FMU does not show "
            f"them; use one of: {', '.join(STEPPING)}"
        )
    return solver


def _choose_tolerance(name: str, solver: str, rtol: float | None) -> float:
    """Return the relative tolerance to use; refuse one that cannot be kept."""
    if rtol is None:
        return RTOL
    if solver not in TOLERANT:
        raise FmuError(
            f"{name}: relative tolerance {rtol}: solver {solver!r} takes the steps it is given; "
            f"leave it out or use one of: {', '.join(TOLERANT)}"
        )
    if not CLOSEST <= rtol < 1.0:
        raise FmuError(
            f"{name}: relative tolerance: expected at least {CLOSEST} and less than 1, got {rtol}"
        )
    return rtol


def _with_numbers(model: LinearModel, numbers: Design) -> LinearModel:
    """Return the model with recorded numbers in the place of its own."""
    return replace(
        model,
        A=numbers["A"],
        B=numbers["B"],
        C=numbers["C"],
        D=numbers["D"],
        X0=numbers["X0"],
        Xu=numbers["Xu"],
    )
