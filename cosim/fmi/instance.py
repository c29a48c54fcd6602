"""The FMI calls as a protocol: the standard's names in snake_case, the same for every version and for generated units.

FMI 2.0.4 sections 2.1, 3.2 and 4.2; FMI 3.0 sections 2.2, 3.2 and 4.2. Where the versions differ, the names are those of FMI 3:
``update_discrete_states`` is fmi2NewDiscreteStates, ``set_float64`` fmi2SetReal. A failed call raises ``RunError``.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Protocol

from cosim.arrays import Vector
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface
from cosim.fmi.description import Description
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable

TERMINATED: Final = "the FMU requests the end of the run"


class DiscreteStates(NamedTuple):
    """What fmi3UpdateDiscreteStates (fmi2NewDiscreteStates, fmiEventUpdate) answers."""

    need_update: bool
    terminate: bool
    next_event_time: float | None  # [s]
    values_changed: bool = False  # of the continuous states
    nominals_changed: bool = False


class StepEnd(NamedTuple):
    """How do_step ended.

    completed: it reached the end of the step. discarded: it refused the step; FMI 3 leaves the unit as it was, FMI 2 needs a
    saved state to go back to. Neither: it returned early, at ``reached``. event: it wants event mode there (FMI 3).
    followed: until when the inputs followed their lines, where there are some (FMI 3: the last Intermediate Update that asked for
    them, -inf where none did).
    """

    completed: bool
    terminate: bool
    discarded: bool = False
    event: bool = False
    reached: float = math.nan  # [s]
    followed: float = math.inf  # [s]


class Instance(Protocol):
    """What model exchange and co-simulation have in common."""

    @property
    def description(self) -> Description:
        """Variables, structure, capabilities."""
        ...

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough."""
        ...

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        ...

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s] (FMI 2: setup_experiment before it)."""
        ...

    def exit_initialization_mode(self) -> None:
        """End the initialization."""
        ...

    def enter_configuration_mode(self) -> None:
        """Let structural parameters be set (FMI 3), before the initialization."""
        ...

    def exit_configuration_mode(self) -> None:
        """Keep the structural parameters as they are."""
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
        """Give d(unknowns)/d(knowns) . seed; only where the capability says so."""
        ...

    def get_fmu_state(self, into: object | None = None) -> object:
        """Copy the whole state, into the memory of an earlier copy if one is given; only where the capability says so."""
        ...

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state."""
        ...

    def free_fmu_state(self, state: object) -> None:
        """Let go of a copied state."""
        ...

    def terminate(self) -> None:
        """End the run."""
        ...

    def free_instance(self) -> None:
        """Let go of everything."""
        ...


class ModelExchangeInstance(Instance, Protocol):
    """``x' = f(t, x, u)``, ``y = g(t, x, u)`` behind the model exchange calls."""

    linear: LinearModel | None
    """The model, where its numbers are known: it can then be discretized, and its numbers exchanged for recorded ones."""

    def enter_event_mode(self) -> None:
        """Stop time, for discrete changes."""
        ...

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        ...

    def enter_continuous_time_mode(self) -> None:
        """Let time move."""
        ...

    def set_time(self, t: float) -> None:
        """Set the time [s]."""
        ...

    def set_continuous_states(self, x: Vector) -> None:
        """Set the states, shape (n_x,)."""
        ...

    def get_continuous_states(self) -> Vector:
        """Give the states, shape (n_x,)."""
        ...

    def get_derivatives(self) -> Vector:
        """Give x', shape (n_x,), as a new vector."""
        ...

    def get_event_indicators(self) -> Vector:
        """Give the event indicators as a new vector."""
        ...

    def get_nominals(self) -> Vector:
        """Give the nominal values of the states, shape (n_x,)."""
        ...

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        ...


class CoSimulationInstance(Instance, Protocol):
    """A unit with a solver of its own."""

    def set_input_derivatives(self, references: ReferenceMap, slopes: Vector) -> None:
        """Set du/dt for the next step, beginning at the values set last; only where the unit interpolates inputs.

        FMI 3 has no input derivatives: the binding answers the unit's Intermediate Updates with the values on these lines.
        """
        ...

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        ...

    def enter_event_mode(self) -> None:
        """Stop time, for discrete changes; only where the unit has event mode (FMI 3)."""
        ...

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        ...

    def enter_step_mode(self) -> None:
        """Leave event mode."""
        ...
