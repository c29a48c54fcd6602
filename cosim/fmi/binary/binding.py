"""What the calls of ``fmi1.py``, ``fmi2.py`` and ``fmi3.py`` have in common, as a protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.fmi.binary.library import Call, Library
from cosim.fmi.binary.messages import Messages
from cosim.fmi.description import Capabilities, Description, InterfaceType
from cosim.fmi.instance import ClockCalls, DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable, VariableType
from cosim.native.fmi.fmu import SlopesStruct, StepStruct

NO_STATE: Final = "the FMU cannot save its state (canGetAndSetFMUstate is false)"
NO_INPUT_DERIVATIVES: Final = "the FMU does not interpolate inputs (canInterpolateInputs is false)"
NO_DIRECTIONAL_DERIVATIVES: Final = (
    "the FMU has no directional derivatives (providesDirectionalDerivatives is false)"
)


@dataclass(frozen=True)
class InstanceSpecification:
    """What is instantiated.

    Parameters
    ----------
    description : Description
    interface_type : {"me", "cs"}
    name : str
        Of the instance.
    folder : Path
        Where the archive was unpacked.
    messages : Messages
        Takes what the FMU logs.
    """

    description: Description
    interface_type: InterfaceType
    name: str
    folder: Path
    messages: Messages

    @property
    def token(self) -> str:
        """GUID or instantiation token."""
        return self.description.token

    @property
    def capabilities(self) -> Capabilities:
        """What the FMU can do behind this interface type."""
        return self.description.capabilities[self.interface_type]


class Calls(Protocol):
    """Where the versions differ. A ``Call`` raises RunError for a status above warning."""

    library: Library
    clocks: ClockCalls | None
    """None: before FMI 3, or where nothing activates the clocks."""
    version: ClassVar[int]
    """First digit of the FMI version."""
    functions: ClassVar[Mapping[str, str]]
    """Names of functions that differ in nothing else between the versions, by those of FMI 3."""
    dtypes: ClassVar[Mapping[str, DTypeLike]]
    """How the FMU carries each type."""

    terminate: Call
    enter_configuration_mode: Call
    exit_configuration_mode: Call
    enter_event_mode: Call
    enter_continuous_time_mode: Call
    enter_step_mode: Call
    get_state: Call
    set_state: Call
    free_state: Call

    def instantiate(self) -> None:
        """Create the instance; ``library.instance`` stays empty where the FMU refuses."""
        ...

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        ...

    def setup_experiment(self, t: float) -> None:
        """Take the start time ``t`` [s]."""
        ...

    def enter_initialization_mode(self) -> None:
        """Enter it, at the start time."""
        ...

    def exit_initialization_mode(self) -> None:
        """End the initialization."""
        ...

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        ...

    def type_name(self, variable_type: VariableType) -> str:
        """Return what the functions that get and set a type are named after."""
        ...

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        ...

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String or a Binary."""
        ...

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String or a Binary."""
        ...

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        ...

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        ...

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; return (enter event mode, terminate)."""
        ...

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        ...

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        ...

    def end_of_step(self, t: float, h: float, status: int) -> StepEnd:
        """Return how a step ended, by what do_step returned; it was called in compiled code."""
        ...

    def step_struct(self) -> StepStruct:
        """Return do_step for compiled code."""
        ...

    def slopes_struct(self, group: Group, columns: NDArray[np.intp]) -> SlopesStruct:
        """Return the slopes of inputs for compiled code; ``columns`` are those of the inputs."""
        ...
