"""The FMI calls as a protocol, with the standard's names in snake_case.

It is the same for every version and for generated models. FMI 2.0.4 sections 2.1, 3.2 and 4.2;
FMI 3.0 sections 2.2, 3.2 and 4.2. Where the versions differ, the names are those of FMI 3:
``update_discrete_states`` is fmi2NewDiscreteStates, ``set_float64`` fmi2SetReal. A failed call
raises ``RunError``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Final, NamedTuple, Protocol, runtime_checkable

from cosim.arrays import Vector
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface
from cosim.errors import RunError
from cosim.fmi.description import Description
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable
from cosim.native.fmi.fmu import DirectionalStruct, SlopesStruct, StepStruct, VariablesStruct

TERMINATED: Final = "the FMU requests the end of the run"


class DiscreteStates(NamedTuple):
    """Results of fmi3UpdateDiscreteStates (fmi2NewDiscreteStates, fmiEventUpdate)."""

    need_update: bool
    terminate: bool
    next_event_time: float | None  # [s]
    values_changed: bool = False  # of the continuous states
    nominals_changed: bool = False


class StepEnd(NamedTuple):
    """How do_step ended.

    Attributes
    ----------
    completed : bool
        It reached the end of the step.
    terminate : bool
        The FMU requests the end of the run.
    discarded : bool
        It refused the step: FMI 3 leaves the instance as it was, FMI 2 needs a saved state to go
        back to. Neither completed nor discarded: it returned early, at ``last_successful_time``.
    event_needed : bool
        It requests event mode at ``last_successful_time`` (FMI 3).
    last_successful_time : float
        [s]
    interpolated_until : float
        Until when the inputs followed their slopes, where some have one [s]: of FMI 3 the time of
        the last Intermediate Update that requested inputs, -inf where none did.
    """

    completed: bool
    terminate: bool
    discarded: bool = False
    event_needed: bool = False
    last_successful_time: float = math.nan
    interpolated_until: float = math.inf

    @property
    def returned_early(self) -> bool:
        """Whether it came to ``last_successful_time`` only, of its own."""
        return not (self.completed or self.discarded or self.terminate)


class ClockInterval(NamedTuple):
    """Result of fmi3GetIntervalDecimal or fmi3GetIntervalFraction for one clock.

    Attributes
    ----------
    interval : Fraction or None
        [s]; None: not known yet.
    changed : bool
        Whether it is another than the last one: it then begins at the event that it was asked in.
    """

    interval: Fraction | None
    changed: bool


class ClockCalls(Protocol):
    """The calls of FMI 3 for clocks (section 2.2.9)."""

    def activate(self, clocks: Sequence[Variable]) -> None:
        """Activate input clocks (fmi3SetClock), in event mode."""
        ...

    def active(self, clocks: Sequence[Variable]) -> list[bool]:
        """Return which clocks are active (fmi3GetClock), in event mode."""
        ...

    def interval(self, clock: Variable) -> ClockInterval:
        """Return the interval of a clock that is based on time (fmi3GetInterval...)."""
        ...

    def shift(self, clock: Variable) -> Fraction:
        """Return the time from the start to the first tick [s] (fmi3GetShift...)."""
        ...


class Addresses(Protocol):
    """Where compiled code finds a loaded FMU (``fmu.h``); what it returns lives as long as this.

    Attributes
    ----------
    fmu : int
        Of ``cosim_fmu``.
    version : int
        First digit of the FMI version.
    """

    fmu: int
    version: int

    def call(self, name: str) -> int:
        """Return the address of a function of the instance (``cosim_fmu_call``).

        ``name`` is that of FMI 3 where the versions differ in nothing else; the function is one
        that the instance has.
        """
        ...

    def variables(self, references: ReferenceMap) -> VariablesStruct:
        """Return variables that are set or read together.

        Of a selection the vector is the one that it was selected from.
        """
        ...

    def directional(self, unknowns: ReferenceMap, knowns: ReferenceMap) -> DirectionalStruct:
        """Return the directional derivatives of variables, all of them Float64."""
        ...

    def step(self) -> StepStruct:
        """Return do_step of co-simulation."""
        ...

    def slopes(self, references: ReferenceMap) -> SlopesStruct:
        """Return the slopes of inputs, a selection of all of them."""
        ...

    def state(self, state: object) -> int:
        """Return where the pointer of a copied FMU state is."""
        ...

    def failure(self) -> RunError | None:
        """Return the call that failed in compiled code as an error; None: none did.

        It is returned once.
        """
        ...


class Instance(Protocol):
    """What model exchange and co-simulation have in common.

    Attributes
    ----------
    may_go_back : bool
        Whether a state may be restored that was copied at an earlier time than that of the next
        step: the negation of noSetFMUStatePriorToCurrentPoint.
    """

    may_go_back: bool

    @property
    def description(self) -> Description:
        """Variables, structure, capabilities."""
        ...

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough."""
        ...

    def addresses(self) -> Addresses | None:
        """Return where compiled code finds the instance; None: it does not, see the instance."""
        ...

    def clock_calls(self) -> ClockCalls | None:
        """Return the calls for clocks; None: nothing activates its clocks, or it has none."""
        ...

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        ...

    def setup_experiment(self, t: float) -> None:
        """Take the start time ``t`` [s]; start values are set after it."""
        ...

    def enter_initialization_mode(self) -> None:
        """Enter it, at the start time."""
        ...

    def exit_initialization_mode(self) -> None:
        """End the initialization."""
        ...

    def enter_configuration_mode(self) -> None:
        """Enter the mode in which structural parameters can be set (FMI 3)."""
        ...

    def exit_configuration_mode(self) -> None:
        """Fix the structural parameters."""
        ...

    def set_text(self, variable: Variable, values: tuple[str, ...]) -> None:
        """Set a String; a Binary is given in hexadecimal."""
        ...

    def get_text(self, variable: Variable) -> tuple[str, ...]:
        """Get a String, or a Binary in hexadecimal."""
        ...

    def set_float64(self, references: ReferenceMap, values: Vector) -> None:
        """Set variables; integers and Booleans are carried as float64 and converted here."""
        ...

    def get_float64(self, references: ReferenceMap) -> Vector:
        """Get variables as a new vector."""
        ...

    def get_directional_derivative(
        self, unknowns: ReferenceMap, knowns: ReferenceMap, seed: Vector
    ) -> Vector:
        """Return d(unknowns)/d(knowns) . seed; only with the capability for it."""
        ...

    def get_fmu_state(self, into: object | None = None) -> object:
        """Copy the FMU state, into the memory of an earlier copy if one is given.

        Only with the capability for it.
        """
        ...

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state."""
        ...

    def free_fmu_state(self, state: object) -> None:
        """Release a copied state."""
        ...

    def mark_messages(self) -> object:
        """Return what the messages up to now are known by."""
        ...

    def forget_messages(self, mark: object, *, of_calls: bool = True) -> None:
        """Forget the messages that came behind a mark, and were not fetched yet.

        ``of_calls``: also what functions returned as a warning or an error since then.
        """
        ...

    def terminate(self) -> None:
        """End the run."""
        ...

    def free_instance(self) -> None:
        """Release the instance and all its memory."""
        ...


@runtime_checkable
class ModelExchangeInstance(Instance, Protocol):
    """``x' = f(t, x, u)``, ``y = g(t, x, u)`` behind the model exchange calls."""

    linear: LinearModel | None
    """The model, where its matrices are known: it can then be discretized, and they can be
    replaced by recorded ones."""

    def enter_event_mode(self) -> None:
        """Stop time, for discrete changes."""
        ...

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        ...

    def enter_continuous_time_mode(self) -> None:
        """Leave event mode, so that time can advance."""
        ...

    def set_time(self, t: float) -> None:
        """Set the time [s]."""
        ...

    def set_continuous_states(self, x: Vector) -> None:
        """Set the states, shape (n_x,)."""
        ...

    def get_continuous_states(self) -> Vector:
        """Return the states, shape (n_x,)."""
        ...

    def get_derivatives(self) -> Vector:
        """Return x', shape (n_x,), as a new vector."""
        ...

    def get_event_indicators(self) -> Vector:
        """Return the event indicators as a new vector."""
        ...

    def get_nominals(self) -> Vector:
        """Return the nominal values of the states, shape (n_x,)."""
        ...

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; return (enter event mode, terminate)."""
        ...


class CoSimulationInstance(Instance, Protocol):
    """An FMU or a generated model with a solver of its own."""

    def renew(self) -> None:
        """Replace it by a new instance, in the state after instantiation; it may have failed.

        FMU states of the old one are lost.
        """
        ...

    def set_input_derivatives(self, references: ReferenceMap, slopes: Vector) -> None:
        """Set du/dt for the next step, which begins at the values set last.

        Only with the capability to interpolate inputs. FMI 3 has no input derivatives: there the
        FMU's Intermediate Updates are answered with the linear interpolation of the inputs.
        """
        ...

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        ...

    def end_of_step(self, t: float, h: float, status: int) -> StepEnd:
        """Return how a step ended whose do_step compiled code called.

        ``status`` is what it returned.
        """
        ...

    def enter_event_mode(self) -> None:
        """Stop time, for discrete changes; only with the capability for event mode (FMI 3)."""
        ...

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        ...

    def enter_step_mode(self) -> None:
        """Leave event mode."""
        ...
