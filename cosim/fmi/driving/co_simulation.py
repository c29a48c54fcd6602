"""A co-simulation FMU as a component.

``stepping.py`` shows what happens in a communication step. The end of the run that an FMU requests
is remembered, and comes with the next ``advance`` at the latest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, InputWiring, Stopped
from cosim.core.gain.responses import linearized_by_responses
from cosim.core.linearization import InputUse, Linearized
from cosim.core.recording import INNER_STEP, SHARED_INNER_STEP
from cosim.errors import FmuError, RunError
from cosim.fmi.binary.messages import Message
from cosim.fmi.description import Description
from cosim.fmi.driving.clocks import Event, EventClocks
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.direct import DirectFeedthrough
from cosim.fmi.driving.initialization import Initialization, Starts
from cosim.fmi.driving.left_limits import LeftLimits, jumping_outputs
from cosim.fmi.driving.local_model import derived, has_continuous_ports
from cosim.fmi.driving.saved import SavedState, restore, save
from cosim.fmi.driving.step_inputs import InputDerivativesFailed
from cosim.fmi.driving.stepping import Stepper, StepperState
from cosim.fmi.driving.tuning import TunedParameters
from cosim.fmi.instance import TERMINATED, CoSimulationInstance
from cosim.instants import NANOSECONDS, written_step
from cosim.native.step import NativeStep


class CoSimulationState(NamedTuple):
    """What a ``CoSimulation`` keeps beside the FMU's own state."""

    initialization_time: float | None  # of its initialization mode
    stepper: StepperState
    diagnostics: int


@final
class CoSimulation:
    """A co-simulation FMU.

    Parameters
    ----------
    instance : CoSimulationInstance
        Just instantiated.
    starts : mapping of variable name to StartValue
        Start values to set instead of the FMU's own.

    Raises
    ------
    FmuError
        If a start value is wrong.
    """

    def __init__(self, instance: CoSimulationInstance, *, starts: Starts | None = None) -> None:
        description = instance.description
        self._instance = instance
        self._name = description.name
        self._diagnostics = Diagnostics(self._name)
        self._clocks = EventClocks(instance, self._diagnostics)
        self._initialization = Initialization(
            instance, starts or {}, self._diagnostics, self._clocks
        )
        self._capabilities = description.capabilities["cs"]
        self.interface = replace(
            instance.interface,
            prepares=True,
            rollback=self._capabilities.saves_state,
            native=not description.drives_clocks,
            linearizable=self._is_linearizable(description),
            substeps=self._capabilities.variable_step,
            left_limits=jumping_outputs(description) if self._capabilities.event_mode else (),
            locates_events=self._capabilities.event_mode or self._capabilities.early_return,
            keeps_events=self._capabilities.event_mode and not self._capabilities.saves_state,
            one_value=description.one_value_inputs,
        )
        self._in_events: frozenset[str] = frozenset()
        if self._capabilities.event_mode:
            inputs = self.interface.inputs
            self._in_events = frozenset(s.name for s in inputs if s.variability == "discrete")
        self._tries = False  # steps that are undone
        self._feedthrough: DirectFeedthrough | None = None
        if self._capabilities.directional_derivatives:
            self._feedthrough = DirectFeedthrough(instance, self._in_events)
        # Of the FMU before an event that is only shown; its memory is used again.
        self._fmu_state: object | None = None
        self._stepper = Stepper(instance, self._diagnostics, self._clocks, self._feedthrough)
        self._stepper.keeps_left = bool(self.interface.left_limits)
        self._left_limits = LeftLimits()
        if not self._stepper.interpolates:
            self.interface = replace(self.interface, lagging=tuple(self._uncorrected_outputs()))
        self._tuned: list[TunedParameters] = []
        none = np.zeros(self.interface.n_u, np.bool_)
        self._wiring = InputWiring(none, none, none, none)

    def take_wiring(self, wiring: InputWiring) -> None:
        """Take what drives the inputs; see :class:`cosim.core.contracts.Wired`."""
        self._wiring = wiring
        self._stepper.take_wiring(wiring.latest, wiring.in_loop)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Take which inputs have a zero-order hold; nothing is designed.

        Raises
        ------
        FmuError
            If the FMU has a fixed inner step and ``h`` is not a whole number of them.
        """
        fixed = self._capabilities.fixed_step
        if fixed and not self._capabilities.variable_step:
            whole = round(h / fixed)
            nearest_step = written_step(max(1, whole) * fixed)
            if abs(whole * fixed - h) > max(1e-9 * h, 0.5 / NANOSECONDS):
                raise FmuError(
                    f"{self._name}: the communication step {h} s is not a whole number of the "
                    f"FMU's inner steps of {fixed} s; nearest: {nearest_step} s"
                )
        self._stepper.hold(held)
        self._h = h
        self._held = held
        return {}

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Return an empty design: the FMU takes steps of any length."""
        return {}

    def _is_linearizable(self, description: Description) -> bool:
        shows = self._capabilities.directional_derivatives or self._capabilities.saves_state
        return shows and has_continuous_ports(description)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the results, once it is known what drives the inputs."""
        held, means = self._late_inputs()
        names = []
        late: set[str] = set()
        for name in self._uncorrected_outputs():
            feeding = (held | means).intersection(self.interface.feeds(name)) - self._in_events
            if feeding:
                names.append(name)
                late |= feeding
        if not names:
            return ()
        verb = "lag" if len(names) > 1 else "lags"
        if not all(self.interface.knows(name) for name in names):
            verb = "may lag"
        ways = []
        if late & held:
            ways.append("with a zero-order hold")
        if late & means:
            ways.append("set to a mean")
        inputs = f"inputs {', or '.join(ways)}{',' * (len(ways) - 1)}"
        why = "the FMU has no directional derivatives"
        if self._feedthrough:
            why = "directional derivatives are for real variables"
        return (f"{self._name}: {', '.join(names)} {verb} {inputs} by up to one step ({why})",)

    def _late_inputs(self) -> tuple[set[str], set[str]]:
        """Return the driven inputs that have a zero-order hold, and those that get means."""
        wiring = self._wiring
        one_value = self.interface.one_value
        held: set[str] = set()
        means: set[str] = set()
        for name, columns in self.interface.input_columns().items():
            if (wiring.driven & wiring.held)[columns].any():
                held.add(name)
            moves = wiring.driven & ~wiring.held & ~wiring.latest
            if name in one_value and moves[columns].any():
                means.add(name)
        return held, means

    def _uncorrected_outputs(self) -> list[str]:
        """Return the outputs that depend on inputs directly, and do not follow all of them."""
        corrected = self._feedthrough.corrected if self._feedthrough else ()
        names = []
        for output in self.interface.outputs:
            feeding = self.interface.feeds(output.name)
            if output.name not in corrected and not self._in_events.issuperset(feeding):
                names.append(output.name)
        return names

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize at ``t``; stays in initialization mode until the first advance."""
        u = np.array(u, np.float64)
        self._tuned.clear()
        y = self._initialization.enter(t, u)
        self._stepper.begin(u, y)
        return y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs last read, after an event where one is due.

        They are corrected to the inputs ``u`` where D is known.
        """
        self._stepper.check_compiled()
        self._leave_initialization(t)
        return self._outputs_at(t, np.array(u, np.float64)).copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        stepper = self._stepper
        self._left_limits.clear()
        inputs = list(np.array(u, np.float64, order="C"))
        times = t.tolist()
        steps = len(inputs) - 1
        y = np.empty((steps, self.interface.n_y))
        k = 0
        try:
            self._leave_initialization(times[0])
            for k, t1 in enumerate(times[1:]):
                u1 = inputs[k + 1]
                completed = self._step(times[k], h, inputs[k], u1)
                if completed:
                    self._report_inner_step(t1, h)
                    self._left_limits.keep(t1, stepper.left)
                    # An event at the end of the block is left to the next advance: a loop may still
                    # correct the inputs that it happens with.
                    if k < steps - 1:
                        stepper.handle_point_event(Event(t1, u1))
                    y[k] = self._outputs_at(t1, u1)
                if stepper.ended:
                    raise Stopped(y[: k + completed].copy(), TERMINATED, failed=False)
        except Stopped:
            raise
        except RunError as error:
            raise Stopped(y[:k].copy(), str(error)) from error
        return y

    def left_limits(self, t: Vector) -> dict[int, Vector]:
        """Return the outputs before events at the ends of the last steps, by place in ``t``."""
        return self._left_limits.at(t)

    def first_event(self) -> float:
        """Return the time of the first event inside the last step [s]; infinity: none."""
        return self._stepper.first_event

    def _step(self, t: float, h: float, u0: Vector, u1: Vector) -> bool:
        """Do one communication step; return False where the FMU requests the end inside it."""
        try:
            return self._stepper.step(t, h, u0, u1)
        except InputDerivativesFailed as error:
            # After an error an FMU cannot go on. Nothing is lost with it before the end of the
            # first step; later it would be the past.
            if self._stepper.stepped or self._tries:
                raise
            self._instance.renew()
            self._fmu_state = None
            y = self._initialization.repeat()
            self._stepper.begin_without_slopes(t, u0, y, str(error))
            self._stepper.leave_initialization(t)
            for parameters in self._tuned:
                self._stepper.tune(t, parameters)
            return self._stepper.step(t, h, u0, u1)

    def _leave_initialization(self, t: float) -> None:
        if self._initialization.leave():
            self._stepper.leave_initialization(t)

    def _outputs_at(self, t: float, u: Vector) -> Vector:
        """Return the outputs at ``t``, the time reached, for inputs ``u``.

        Where an event is due for them, they are those after it; then the FMU goes back, if it can.
        Without one they are y + D (u - u_end).
        """
        stepper = self._stepper
        event = Event(t, u)
        before: StepperState | None = None
        if self._capabilities.saves_state and stepper.has_point_event(event):
            # The copy holds the mode too: with it the FMU is back in step mode.
            self._fmu_state = self._instance.get_fmu_state(self._fmu_state)
            before = stepper.save()
        y = stepper.outputs
        if not stepper.handle_point_event(event):
            y = stepper.corrected(y, u)
        if before is None:
            return y
        y = y.copy()
        if not stepper.ended:
            self._instance.set_fmu_state(self._fmu_state)
            stepper.restore(before)
        return y

    def tune(self, t: float, parameters: TunedParameters) -> None:
        """Set tunable parameters at ``t``, the time reached.

        Raises
        ------
        RunError
            If the FMU refuses them.
        """
        self._stepper.check_compiled()
        self._leave_initialization(t)
        self._tuned.append(parameters)
        self._stepper.tune(t, parameters)

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize by directional derivatives where the FMU shows its states, else by responses.

        The latter go back to where they began. None: it can do neither, or is not linear here. Its
        own solver is taken as exact.

        Raises
        ------
        RunError
            If the FMU refuses.
        """
        self._stepper.check_compiled()
        self._leave_initialization(t)
        use: InputUse = "linear" if self._stepper.interpolates else "mean"
        if self._capabilities.directional_derivatives:
            corrected: list[bool] = []
            uncorrected = self._uncorrected_outputs()
            for output in self.interface.outputs:
                corrected += [output.name not in uncorrected] * output.size
            matrices = derived(self._instance, use=use, corrected=np.array(corrected, np.bool_))
            if matrices is not None:
                return matrices
        if not self._capabilities.saves_state:
            return None
        self._tries = True
        try:
            masks = {"held": self._held, "latest": self._wiring.latest}
            return linearized_by_responses(self, t, self._h, u, **masks, use=use)
        finally:
            self._tries = False

    def native(self) -> NativeStep | None:
        """Return the compiled step; None: there is none."""
        return self._stepper.native()

    # --- messages, states ---

    def _report_inner_step(self, t: float, h: float) -> None:
        n = self._stepper.inner_steps
        if n:
            together, who, category = "", "it seems", INNER_STEP
            if self._stepper.shares_inner_step:
                together, who = ", with its inputs from its loop", "it, or another one there, seems"
                category = SHARED_INNER_STEP
            self._diagnostics.add(
                t,
                INNER_STEP,
                f"its outputs change at {_every(n)} communication step only{together}: {who} to "
                f"keep an inner step of {_seconds(n, h)} s and to ignore the communication "
                f"step of {h} s",
                category,
            )

    def drain(self) -> list[Message]:
        """Return what the run showed about the FMU since the last call, each topic once."""
        return self._diagnostics.drain()

    def discard(self) -> None:
        """Forget what the run showed about the FMU, so that it may show it again."""
        self._diagnostics.discard()

    def save(self) -> SavedState[CoSimulationState]:
        """Copy the state.

        Raises
        ------
        FmuError
            If the FMU cannot save its state.
        """
        state = CoSimulationState(
            self._initialization.mode_time, self._stepper.save(), self._diagnostics.save()
        )
        return save(self._instance, self._capabilities, state)

    def restore(self, state: SavedState[CoSimulationState]) -> None:
        """Go back to a saved state."""
        own = restore(self._instance, state)
        self._initialization.mode_time = own.initialization_time
        self._stepper.restore(own.stepper)
        self._diagnostics.restore(own.diagnostics)


def _every(n: float) -> str:
    """Return which steps it is; of n between whole numbers, which is known to some digits only."""
    if n == int(n):
        return f"every {_ordinal(int(n))}"
    return f"every {n:.3g}th (on average)"


def _seconds(n: float, h: float) -> str:
    return f"{n * h:.12g}" if n == int(n) else f"about {n * h:.2g}"


def _ordinal(n: int) -> str:
    if 10 <= n % 100 <= 20:
        return f"{n}th"
    endings = {1: "st", 2: "nd", 3: "rd"}
    return f"{n}{endings.get(n % 10, 'th')}"
