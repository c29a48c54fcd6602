"""The calls of FMI 1.0, behind the modes of its successors.

FMI 1.0 has no initialization mode: ``fmiInitialize`` (``fmiInitializeSlave``) takes the start
values and inputs that were set before it, and only after it can anything be read. Between
``setup_experiment`` and ``exit_initialization_mode`` therefore the first reading
initializes, and another value that is set after it restarts: the instance is freed, a new one is
instantiated, and all that was set is set again. Exit initializes where no reading did. So every
output that is read belongs to the inputs that were set, as in the initialization mode of FMI 2.
``fmiResetSlave`` is never called: masters have no need of it, so that in many FMUs it was never
tried, and leaves parameters at zero or a solver that never returns.

It has no FMU state, no directional derivatives and no event mode in co-simulation either: those
calls raise. Event mode and continuous-time mode of model exchange are states in which the same
calls are allowed, and entering them calls nothing. From FMI for Model Exchange 1.0 and FMI for
Co-Simulation 1.0, section 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from ctypes import (
    addressof,
    byref,
    c_char_p,
    c_double,
    c_int,
    c_int8,
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
from cosim.fmi.binary.binding import InstanceSpecification
from cosim.fmi.binary.input_derivatives import RealInputDerivatives
from cosim.fmi.binary.library import DISCARD, WARNING, Call, Library, pointer
from cosim.fmi.binary.structures import Fmi1CallbackFunctions, Fmi1EventInfo
from cosim.fmi.instance import ClockCalls, DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable, VariableType
from cosim.native.fmi.fmu import SlopesStruct, StepStruct
from cosim.native.library import address

LAST_SUCCESSFUL_TIME: Final = 2  # of fmiStatusKind
MIME: Final = b"application/x-fmu-sharedlibrary"
_VALUES = (c_void_p, c_size_t, c_void_p)  # of a function that gets or sets


@final
class Fmi1:
    """FMI 1.0, one instance; see :class:`cosim.fmi.binary.binding.Calls`."""

    version: ClassVar[int] = 1
    functions: ClassVar[Mapping[str, str]] = {
        "GetContinuousStateDerivatives": "GetDerivatives",
        "GetNominalsOfContinuousStates": "GetNominalContinuousStates",
    }
    dtypes: ClassVar[Mapping[str, DTypeLike]] = {
        "Float64": np.float64,
        "Int32": np.int32,
        "Boolean": np.int8,
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
        self._callbacks = Fmi1CallbackFunctions()  # handed over by value
        self._event_info = Fmi1EventInfo()
        self._start_time: float | None = None  # None: before the initialization mode
        self._initializing = True  # until the end of the initialization mode
        self._initialized = False  # with all values that were set
        self._event_info_is_new = False  # the initialization wrote it, and nobody read it yet
        self._set_values: dict[tuple[VariableType, int], NDArray[Any]] = {}  # by type and reference
        self._set_texts: dict[int, tuple[Variable, list[bytes]]] = {}  # by reference
        self._bind_values()
        self._bind_modes()
        if specification.interface_type == "me":
            self._bind_model_exchange()
        else:
            self._bind_co_simulation()

    def _bind_values(self) -> None:
        call = self.library.call
        self._access: dict[tuple[str, str], Call] = {}
        for variable_type, name in self.names.items():
            self._access["Get", variable_type] = call(f"Get{name}", *_VALUES)
            self._access["Set", variable_type] = call(f"Set{name}", *_VALUES)
        self._set_string = call("SetString", *_VALUES)
        self._get_string = call("GetString", *_VALUES)
        unavailable = self.library.unavailable
        self._directional = unavailable("FMI 1.0 has no directional derivatives")
        no_state = unavailable("FMI 1.0 has no FMU state, so it cannot be rolled back")
        self.get_state = no_state
        self.set_state = no_state
        self.free_state = no_state

    def _bind_modes(self) -> None:
        no_configuration = self.library.unavailable("FMI 1.0 has no structural parameters")
        self.enter_configuration_mode = no_configuration
        self.exit_configuration_mode = no_configuration

    def _bind_model_exchange(self) -> None:
        call = self.library.call
        function = self.library.function
        callbacks = type(self._callbacks)
        self._create = function("InstantiateModel", c_void_p, c_char_p, c_char_p, callbacks, c_int8)
        self._free = function("FreeModelInstance", None, c_void_p)
        self.terminate = call("Terminate")
        self.enter_event_mode: Call = _enter_mode
        self.enter_continuous_time_mode: Call = _enter_mode
        self._set_time = call("SetTime", c_double)
        self._initialize_model = call("Initialize", c_int8, c_double, c_void_p)
        self._update = call("EventUpdate", c_int8, c_void_p)
        self._completed = call("CompletedIntegratorStep", c_void_p)
        self._event = c_int8()

    def _bind_co_simulation(self) -> None:
        call = self.library.call
        function = self.library.function
        callbacks = type(self._callbacks)
        strings = [c_char_p] * 4
        environment = (c_double, c_int8, c_int8, callbacks, c_int8)
        self._create = function("InstantiateSlave", c_void_p, *strings, *environment)
        self._free = function("FreeSlaveInstance", None, c_void_p)
        self.terminate = call("TerminateSlave")
        no_events = self.library.unavailable("FMI 1.0 has no event mode in co-simulation")
        self.enter_event_mode = no_events
        self.enter_step_mode = no_events
        self._update = no_events
        self._initialize_slave = call("InitializeSlave", c_double, c_int8, c_double)
        self._step = self.library.status_call("DoStep", c_double, c_double, c_int8)
        self._real_status = self.library.status_call("GetRealStatus", c_int, c_void_p)
        interpolates = self._specification.capabilities.interpolates_inputs
        self._input_derivatives = RealInputDerivatives(self.library, available=interpolates)

    def instantiate(self) -> None:
        """Create the instance, and forget all that was set."""
        self._set_values.clear()
        self._set_texts.clear()
        self._start_time = None
        self._initializing = True
        self._initialized = False
        self._create_instance()

    def _create_instance(self) -> None:
        """Create the instance.

        The logger gets no environment in FMI 1.0: messages are known by the instance's own
        address, so that those which come before there is one have an unknown key.
        """
        specification = self._specification
        callbacks = self._callbacks
        callbacks.logger = address("cosim_log")
        callbacks.allocateMemory = address("cosim_allocate")
        callbacks.freeMemory = address("cosim_free")
        names = (specification.name.encode(), specification.token.encode())
        specification.messages.accept(None)
        if specification.interface_type == "me":
            created = self._create(*names, callbacks, 0)
        else:
            location = specification.folder.as_uri().encode()
            created = self._create(*names, location, MIME, 0.0, 0, 0, callbacks, 0)
        self.library.instance.value = created
        specification.messages.accept(created or 0)

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        if self.library.instance and not self.library.forbids_calls:
            self._free(self.library.instance)
        self.library.instance.value = None
        self._specification.messages.accept(0)

    # --- from instantiation to the end of initialization ---

    def reset(self) -> None:
        """Replace the instance by a new one."""
        self._end()
        self.instantiate()
        self.library.check_renewed()

    def _end(self) -> None:
        """Terminate, as only then an initialized instance may be freed; free."""
        if self._initialized and not self.library.failed:
            self.terminate()
        self.free()

    def setup_experiment(self, t: float) -> None:
        """Store the start time ``t`` [s]."""
        self._start_time = t

    def enter_initialization_mode(self) -> None:
        """Do nothing: the first reading initializes."""

    def exit_initialization_mode(self) -> None:
        """Initialize, where no reading did."""
        self._initialize()
        self._initializing = False

    def _initialize(self) -> None:
        if self._initialized or self._start_time is None:
            return
        if self._specification.interface_type == "me":
            self._set_time(self._start_time)
            self._initialize_model(0, 0.0, byref(self._event_info))
        else:
            self._initialize_slave(self._start_time, 0, 0.0)
        self._initialized = True
        self._event_info_is_new = True

    def _restart_if_initialized(self) -> None:
        """Restart with all that was set, as a value is about to differ from the initial one."""
        if self._initialized:
            self._end()
            self._initialized = False
            self._create_instance()
            self.library.check_renewed()
            for (variable_type, reference), value in self._set_values.items():
                self._access["Set", variable_type](byref(c_uint(reference)), 1, pointer(value))
            for variable, texts in self._set_texts.values():
                self._call_set_string(variable, texts)

    # --- values ---

    def type_name(self, variable_type: VariableType) -> str:
        """Return what the functions that get and set a type are named after."""
        return self.names[variable_type]

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        if self._initializing and not self._prepare_access(verb, group, values):
            return
        self._access[verb, group.type](group.address, group.count, pointer(values))

    def _prepare_access(self, verb: str, group: Group, values: NDArray[Any]) -> bool:
        """Initialize before a reading; restart before a value that differs from the one set.

        Returns
        -------
        bool
            Whether there is a call to make: after values that an initialized instance has already,
            set again, it may refuse to show what it made of them.
        """
        if verb == "Get":
            self._initialize()
            return True
        references = group.references.tolist()
        rows = values.copy().reshape(-1, 1)  # of one element each, to point to
        new_values: dict[tuple[VariableType, int], NDArray[Any]] = {}
        changed = False
        for reference, value in zip(references, rows, strict=True):
            key = (group.type, reference)
            new_values[key] = value
            previous = self._set_values.get(key)
            if previous is None or previous != value:
                changed = True
        if changed:
            self._restart_if_initialized()
            self._set_values |= new_values
        return changed

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String."""
        if self._initializing:
            self._restart_if_initialized()
            self._set_texts[variable.reference] = (variable, values)
        self._call_set_string(variable, values)

    def _call_set_string(self, variable: Variable, values: list[bytes]) -> None:
        texts = (c_char_p * 1)(*values)
        self._set_string(byref(c_uint(variable.reference)), 1, texts)

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String."""
        if self._initializing:
            self._initialize()
        texts = (c_char_p * 1)()
        self._get_string(byref(c_uint(variable.reference)), 1, texts)
        return [texts[0] or b""]

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Raise RunError: FMI 1.0 has none."""
        self._directional()

    # --- model exchange ---

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration; the first one was the initialization's."""
        info = self._event_info
        if self._event_info_is_new:
            self._event_info_is_new = False
        else:
            memset(addressof(info), 0, sizeof(info))  # what it does not write is false
            self._update(0, byref(info))
        return DiscreteStates(
            need_update=not info.iterationConverged,
            terminate=bool(info.terminateSimulation),
            next_event_time=info.nextEventTime if info.upcomingTimeEvent else None,
            values_changed=bool(info.stateValuesChanged),
            nominals_changed=bool(info.stateValueReferencesChanged),
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; return (enter event mode, terminate)."""
        self._completed(byref(self._event))
        return bool(self._event.value), False

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
        """Advance from ``t`` by ``h`` seconds: always a new step, as it cannot be rolled back."""
        self._clock.value = t
        return self.end_of_step(t, h, self._step(t, h, 1))

    def end_of_step(self, t: float, h: float, status: int) -> StepEnd:
        """Return how a step ended, by what do_step returned."""
        self.library.judge("DoStep", status, DISCARD)
        if status <= WARNING:
            return StepEnd(completed=True, terminate=False, last_successful_time=t + h)
        reached = c_double()
        known = self._real_status(LAST_SUCCESSFUL_TIME, byref(reached)) < DISCARD
        return StepEnd(
            completed=False,
            terminate=False,
            discarded=True,
            last_successful_time=reached.value if known else t,
        )


def _enter_mode() -> None:
    """Call nothing: event mode and continuous-time mode differ in nothing that is called."""
