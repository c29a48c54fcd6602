"""The calls of FMI 2.0.4."""

from __future__ import annotations

from collections.abc import Mapping
from ctypes import (
    addressof,
    byref,
    c_char_p,
    c_double,
    c_int,
    c_size_t,
    c_uint,
    c_void_p,
    memset,
    sizeof,
)
from typing import Any, ClassVar, Final, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.fmi.binary.binding import (
    NO_DIRECTIONAL_DERIVATIVES,
    NO_STATE,
    InstanceSpecification,
)
from cosim.fmi.binary.input_derivatives import RealInputDerivatives
from cosim.fmi.binary.library import DISCARD, WARNING, Call, Library, pointer
from cosim.fmi.binary.structures import Fmi2CallbackFunctions, Fmi2EventInfo
from cosim.fmi.description import Capabilities
from cosim.fmi.instance import ClockCalls, DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable, VariableType
from cosim.native.fmi.fmu import SlopesStruct, StepStruct
from cosim.native.library import address

LAST_SUCCESSFUL_TIME: Final = 2  # of fmi2StatusKind
TERMINATED: Final = 3  # of fmi2StatusKind
_VALUES = (c_void_p, c_size_t, c_void_p)  # of a function that gets or sets
_REFERENCES = (c_void_p, c_size_t)


@final
class Fmi2:
    """FMI 2.0.4, one instance; see :class:`cosim.fmi.binary.binding.Calls`."""

    version: ClassVar[int] = 2
    functions: ClassVar[Mapping[str, str]] = {
        "GetContinuousStateDerivatives": "GetDerivatives",
        "GetFMUState": "GetFMUstate",
        "SetFMUState": "SetFMUstate",
    }
    dtypes: ClassVar[Mapping[str, DTypeLike]] = {
        "Float64": np.float64,
        "Int32": np.int32,
        "Boolean": np.int32,
    }
    names: Final[Mapping[VariableType, str]] = {
        "Float64": "Real",
        "Int32": "Integer",
        "Boolean": "Boolean",
    }

    def __init__(self, library: Library, specification: InstanceSpecification) -> None:
        self.library = library
        self.clocks: ClockCalls | None = None
        self._specification = specification
        self._clock = specification.messages.clock
        capabilities = specification.capabilities
        self._free = library.function("FreeInstance", None, c_void_p)
        names = (c_char_p, c_int, c_char_p, c_char_p)  # name, type, token, resources
        self._create = library.function("Instantiate", c_void_p, *names, c_void_p, c_int, c_int)
        self._bind_values(capabilities)
        self._bind_modes()
        if specification.interface_type == "me":
            self._bind_model_exchange()
        else:
            self._bind_co_simulation(capabilities)

    def _bind_values(self, capabilities: Capabilities) -> None:
        call = self.library.call
        self._access: dict[tuple[str, str], Call] = {}
        for variable_type, name in self.names.items():
            self._access["Get", variable_type] = call(f"Get{name}", *_VALUES)
            self._access["Set", variable_type] = call(f"Set{name}", *_VALUES)
        self._set_string = call("SetString", *_VALUES)
        self._get_string = call("GetString", *_VALUES)
        if capabilities.directional_derivatives:
            vectors = (c_void_p, c_void_p)
            types = (*_REFERENCES, *_REFERENCES, *vectors)
            self._directional = call("GetDirectionalDerivative", *types)
        else:
            self._directional = self.library.unavailable(NO_DIRECTIONAL_DERIVATIVES)
        if capabilities.saves_state:
            self.get_state = call("GetFMUstate", c_void_p)
            self.set_state = call("SetFMUstate", c_void_p)
            self.free_state = call("FreeFMUstate", c_void_p)
        else:
            no_state = self.library.unavailable(NO_STATE)
            self.get_state = no_state
            self.set_state = no_state
            self.free_state = no_state

    def _bind_modes(self) -> None:
        call = self.library.call
        self._setup = call("SetupExperiment", c_int, c_double, c_double, c_int, c_double)
        self.enter_initialization_mode = call("EnterInitializationMode")
        self.exit_initialization_mode = call("ExitInitializationMode")
        no_configuration = self.library.unavailable(
            "FMI 2.0 has no configuration mode and no structural parameters"
        )
        self.enter_configuration_mode = no_configuration
        self.exit_configuration_mode = no_configuration
        self.reset = call("Reset")
        self.terminate = call("Terminate")

    def _bind_model_exchange(self) -> None:
        call = self.library.call
        self.enter_event_mode = call("EnterEventMode")
        self.enter_continuous_time_mode = call("EnterContinuousTimeMode")
        self._event_info = Fmi2EventInfo()
        self._update = call("NewDiscreteStates", c_void_p)
        self._completed = call("CompletedIntegratorStep", c_int, c_void_p, c_void_p)
        self._event = c_int()
        self._terminate = c_int()

    def _bind_co_simulation(self, capabilities: Capabilities) -> None:
        no_events = self.library.unavailable("FMI 2.0 has no event mode in co-simulation")
        self.enter_event_mode = no_events
        self.enter_step_mode = no_events
        self._update = no_events
        self._step = self.library.status_call("DoStep", c_double, c_double, c_int)
        self._boolean_status = self.library.status_call("GetBooleanStatus", c_int, c_void_p)
        self._real_status = self.library.status_call("GetRealStatus", c_int, c_void_p)
        interpolates = capabilities.interpolates_inputs
        self._input_derivatives = RealInputDerivatives(self.library, available=interpolates)

    def instantiate(self) -> None:
        """Create the instance."""
        specification = self._specification
        self._callbacks = Fmi2CallbackFunctions()  # the FMU keeps the address
        key = addressof(self._callbacks)
        self._callbacks.logger = address("cosim_log")
        self._callbacks.allocateMemory = address("cosim_allocate")
        self._callbacks.freeMemory = address("cosim_free")
        self._callbacks.componentEnvironment = key
        specification.messages.accept(key)
        name = specification.name.encode()
        fmu_type = int(specification.interface_type == "cs")
        token = specification.token.encode()
        resources = (specification.folder / "resources").as_uri().encode()
        # it logs what was raised in its Python code as debugging alone, and nothing else by itself
        is_logging = specification.description.tool.startswith("PythonFMU ")
        created = self._create(name, fmu_type, token, resources, key, 0, int(is_logging))
        self.library.instance.value = created

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        if self.library.instance and not self.library.forbids_calls:
            self._free(self.library.instance)
        self.library.instance.value = None

    def setup_experiment(self, t: float) -> None:
        """Take the start time ``t`` [s]."""
        self._setup(0, 0.0, t, 0, 0.0)

    # --- values ---

    def type_name(self, variable_type: VariableType) -> str:
        """Return what the functions that get and set a type are named after."""
        return self.names[variable_type]

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        self._access[verb, group.type](group.address, group.count, pointer(values))

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String."""
        texts = (c_char_p * 1)(*values)
        self._set_string(byref(c_uint(variable.reference)), 1, texts)

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String."""
        texts = (c_char_p * 1)()
        self._get_string(byref(c_uint(variable.reference)), 1, texts)
        return [texts[0] or b""]

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        references = (unknowns.address, unknowns.count, knowns.address, knowns.count)
        self._directional(*references, pointer(seed), pointer(result))

    # --- model exchange ---

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        info = self._event_info
        memset(addressof(info), 0, sizeof(info))  # what it does not write is false
        self._update(byref(info))
        return DiscreteStates(
            need_update=bool(info.newDiscreteStatesNeeded),
            terminate=bool(info.terminateSimulation),
            next_event_time=info.nextEventTime if info.nextEventTimeDefined else None,
            values_changed=bool(info.valuesOfContinuousStatesChanged),
            nominals_changed=bool(info.nominalsOfContinuousStatesChanged),
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; return (enter event mode, terminate)."""
        self._completed(not self.library.may_go_back, byref(self._event), byref(self._terminate))
        return bool(self._event.value), bool(self._terminate.value)

    # --- co-simulation ---

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        self._input_derivatives.set(group, slopes)

    def slopes_struct(self, group: Group, columns: NDArray[np.intp]) -> SlopesStruct:
        """Return the slopes of inputs for compiled code."""
        return self._input_derivatives.struct(group, columns)

    def step_struct(self) -> StepStruct:
        """Return do_step for compiled code."""
        return StepStruct(
            self.library.function_address("DoStep"), self.library.call_address("DoStep")
        )

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds (section 4.2.2: what discard means is asked for)."""
        self._clock.value = t
        return self.end_of_step(t, h, self._step(t, h, not self.library.may_go_back))

    def end_of_step(self, t: float, h: float, status: int) -> StepEnd:
        """Return how a step ended, by what do_step returned."""
        self.library.judge("DoStep", status, DISCARD)
        if status <= WARNING:
            return StepEnd(completed=True, terminate=False, last_successful_time=t + h)
        terminated = c_int()
        reached = c_double()
        terminate_known = self._boolean_status(TERMINATED, byref(terminated)) < DISCARD
        terminate = terminate_known and bool(terminated.value)
        time_known = self._real_status(LAST_SUCCESSFUL_TIME, byref(reached)) < DISCARD
        return StepEnd(
            completed=False,
            terminate=terminate,
            discarded=not terminate,
            last_successful_time=reached.value if time_known else t,
        )
