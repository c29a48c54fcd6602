"""The FMI calls as a protocol: the standard's names in snake_case, the same for every version and for generated units.

FMI 2.0.4 sections 2.1, 3.2 and 4.2; FMI 3.0 sections 2.2, 3.2 and 4.2. Where the versions differ, the names are those of FMI 3:
``update_discrete_states`` is fmi2NewDiscreteStates, ``set_float64`` fmi2SetReal. A failed call raises ``RunError``.
"""

from __future__ import annotations

from typing import Final, NamedTuple, Protocol

from cosim.arrays import Vector
from cosim.core.signals import Interface
from cosim.core.solver import LinearModel
from cosim.fmi.description import Description
from cosim.fmi.references import References

TERMINATED: Final = "the unit asks for the end of the run"


class DiscreteStates(NamedTuple):
    """What fmi3UpdateDiscreteStates (fmi2NewDiscreteStates) answers."""

    need_update: bool
    terminate: bool
    next_event_time: float | None  # [s]


class StepEnd(NamedTuple):
    """How do_step ended: whether it reached the end of the step, and whether the unit asks for the end of the run."""

    completed: bool
    terminate: bool


class Unit(Protocol):
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

    def set_float64(self, references: References, values: Vector) -> None:
        """Set variables; integers and Booleans are carried as float64 and converted here."""
        ...

    def get_float64(self, references: References) -> Vector:
        """Get variables as a new vector."""
        ...

    def get_directional_derivative(self, unknowns: References, knowns: References, seed: Vector) -> Vector:
        """Give d(unknowns)/d(knowns) . seed; only where the capability says so."""
        ...

    def get_fmu_state(self) -> object:
        """Copy the whole state; only where the capability says so."""
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


class ModelExchangeUnit(Unit, Protocol):
    """``x' = f(t, x, u)``, ``y = g(t, x, u)`` behind the model exchange calls."""

    linear: LinearModel | None
    """The model, where its numbers are known: it can then be discretised, and its numbers exchanged for recorded ones."""

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

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        ...


class CoSimulationUnit(Unit, Protocol):
    """A unit with a solver of its own."""

    def set_input_derivatives(self, references: References, slopes: Vector) -> None:
        """Set du/dt for the next step; only where the unit interpolates inputs."""
        ...

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        ...
