"""The calls of FMI 3.0."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from ctypes import (
    POINTER,
    addressof,
    byref,
    c_bool,
    c_char_p,
    c_double,
    c_int,
    c_size_t,
    c_uint,
    c_uint8,
    c_void_p,
    cast,
    string_at,
)
from functools import partial
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.fmi.binary.binding import NO_DIRECTIONAL_DERIVATIVES, NO_STATE, InstanceSpecification
from cosim.fmi.binary.clocks3 import Fmi3Clocks
from cosim.fmi.binary.library import DISCARD, WARNING, Call, Library, pointer
from cosim.fmi.description import Capabilities
from cosim.fmi.instance import ClockCalls, DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable, VariableType
from cosim.native.fmi.callbacks import InterpolationStruct
from cosim.native.fmi.fmu import SlopesStruct, StepStruct
from cosim.native.library import address

_FLOATS = ("Float64", "Float32")
_INTEGERS = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_NAMES = (c_char_p, c_char_p, c_char_p)  # of an instance: name, token, resources
_VALUES = (c_void_p, c_size_t, c_void_p, c_size_t)  # of a function that gets or sets
_BINARIES = (c_void_p, c_size_t, c_void_p, c_void_p, c_size_t)
_REFERENCES = (c_void_p, c_size_t)
_VECTOR = (c_void_p, c_size_t)


@final
class Fmi3:
    """FMI 3.0, one instance; see :class:`cosim.fmi.binary.binding.Calls`."""

    version: ClassVar[int] = 3
    functions: ClassVar[Mapping[str, str]] = {}
    dtypes: ClassVar[Mapping[str, DTypeLike]] = {
        **{name: np.dtype(name.lower()) for name in (*_FLOATS, *_INTEGERS)},
        "Boolean": np.bool_,
    }

    def __init__(self, library: Library, specification: InstanceSpecification) -> None:
        self.library = library
        self._specification = specification
        self._clock = specification.messages.clock
        capabilities = specification.capabilities
        self._free = library.function("FreeInstance", None, c_void_p)
        self._interpolation = InterpolationStruct()
        self._interpolated: Group | None = None  # the inputs that it sets
        self._flags = [c_bool() for _ in range(5)]  # results of the calls below
        self._flag_pointers = [byref(flag) for flag in self._flags]
        self._time = c_double()
        self._start_time = 0.0
        self.clocks: ClockCalls | None = None
        description = specification.description
        if description.drives_clocks:
            timings = [description[name].timing for name in description.clocks]
            with_fractions = any(timing and timing.supports_fraction for timing in timings)
            self.clocks = Fmi3Clocks(library, with_fractions=with_fractions)
        self._bind_values(capabilities)
        self._bind_modes()
        if specification.interface_type == "me":
            self._bind_model_exchange()
        else:
            self._bind_co_simulation()

    def _bind_values(self, capabilities: Capabilities) -> None:
        call = self.library.call
        self._access: dict[tuple[str, str], Call] = {}
        for variable_type in self.dtypes:
            self._access["Get", variable_type] = call(f"Get{variable_type}", *_VALUES)
            self._access["Set", variable_type] = call(f"Set{variable_type}", *_VALUES)
        self._set_string = call("SetString", *_VALUES)
        self._get_string = call("GetString", *_VALUES)
        self._set_binary = call("SetBinary", *_BINARIES)
        self._get_binary = call("GetBinary", *_BINARIES)
        if capabilities.directional_derivatives:
            types = (*_REFERENCES, *_REFERENCES, *_VECTOR, *_VECTOR)
            self._directional = call("GetDirectionalDerivative", *types)
        else:
            self._directional = self.library.unavailable(NO_DIRECTIONAL_DERIVATIVES)
        if capabilities.saves_state:
            self.get_state = call("GetFMUState", c_void_p)
            self.set_state = call("SetFMUState", c_void_p)
            self.free_state = call("FreeFMUState", c_void_p)
        else:
            no_state = self.library.unavailable(NO_STATE)
            self.get_state = no_state
            self.set_state = no_state
            self.free_state = no_state

    def _bind_modes(self) -> None:
        call = self.library.call
        self._enter = call("EnterInitializationMode", c_bool, c_double, c_double, c_bool, c_double)
        self.exit_initialization_mode = call("ExitInitializationMode")
        self.enter_configuration_mode = call("EnterConfigurationMode")
        self.exit_configuration_mode = call("ExitConfigurationMode")
        self.reset = call("Reset")
        self.terminate = call("Terminate")
        self.enter_event_mode = call("EnterEventMode")
        update = call("UpdateDiscreteStates", *[c_void_p] * 6)
        self._update = partial(update, *self._flag_pointers, byref(self._time))

    def _bind_model_exchange(self) -> None:
        call = self.library.call
        function = self.library.function
        flags = (c_bool, c_bool)  # visible, logging
        logger = (c_void_p, c_void_p)
        types = (*_NAMES, *flags, *logger)
        self._create = function("InstantiateModelExchange", c_void_p, *types)
        self.enter_continuous_time_mode = call("EnterContinuousTimeMode")
        self._completed = call("CompletedIntegratorStep", c_bool, c_void_p, c_void_p)

    def _bind_co_simulation(self) -> None:
        call = self.library.call
        function = self.library.function
        flags = (c_bool, c_bool, c_bool, c_bool)  # visible, logging, event mode, early return
        callbacks = (c_void_p, c_void_p, c_void_p)  # environment, logger, Intermediate Update
        types = (*_NAMES, *flags, *_REFERENCES, *callbacks)
        self._create = function("InstantiateCoSimulation", c_void_p, *types)
        self.enter_step_mode = call("EnterStepMode")
        results = [c_void_p] * 4
        self._step = self.library.status_call("DoStep", c_double, c_double, c_bool, *results)
        self._step_results = (*self._flag_pointers[:3], byref(self._time))

    def instantiate(self) -> None:
        """Create the instance."""
        specification = self._specification
        key = addressof(self._interpolation)
        logger = address("cosim_log_text")
        specification.messages.accept(key)
        name = specification.name.encode()
        token = specification.token.encode()
        folder = specification.folder / "resources"
        # none, where there is no such folder (FMI 3.0 section 2.3.1)
        resources = f"{folder}{os.sep}".encode() if folder.is_dir() else None
        names = (name, token, resources)
        if specification.interface_type == "me":
            created = self._create(*names, False, False, key, logger)
        else:
            event_mode = specification.capabilities.event_mode
            flags = (False, False, event_mode, True)  # visible, logging, event mode, early return
            inputs = _interpolated_inputs(specification)
            update = address("cosim_intermediate_update")
            created = self._create(
                *names, *flags, pointer(inputs), len(inputs), key, logger, update
            )
        self.library.instance.value = created
        self._interpolation.instance = created

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        if self.library.instance and not self.library.forbids_calls:
            self._free(self.library.instance)
        self.library.instance.value = None

    def setup_experiment(self, t: float) -> None:
        """Keep the start time ``t`` [s]."""
        self._start_time = t

    def enter_initialization_mode(self) -> None:
        """Enter it, at the start time."""
        self._enter(False, 0.0, self._start_time, False, 0.0)

    # --- values ---

    def type_name(self, variable_type: VariableType) -> str:
        """Return what the functions that get and set a type are named after."""
        return variable_type

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        self._access[verb, group.type](group.address, group.count, pointer(values), len(values))

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String or a Binary, an array too."""
        n = len(values)
        reference = byref(c_uint(variable.reference))
        texts = (c_char_p * n)(*values)
        if variable.type == "String":
            self._set_string(reference, 1, texts, n)
        else:
            sizes = (c_size_t * n)(*map(len, values))
            self._set_binary(reference, 1, sizes, texts, n)

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String or a Binary, an array too."""
        n = variable.size
        reference = byref(c_uint(variable.reference))
        if variable.type == "String":
            texts = (c_char_p * n)()
            self._get_string(reference, 1, texts, n)
            return [text or b"" for text in texts]
        sizes = (c_size_t * n)()
        data = (POINTER(c_uint8) * n)()
        self._get_binary(reference, 1, sizes, data, n)
        binaries = zip(data, sizes, strict=True)
        return [string_at(start, size) if size else b"" for start, size in binaries]

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        references = (unknowns.address, unknowns.count, knowns.address, knowns.count)
        self._directional(*references, pointer(seed), len(seed), pointer(result), len(result))

    # --- event mode and model exchange ---

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        for flag in self._flags:
            flag.value = False  # what it does not write
        self._update()
        need_update, terminate, nominals, values, has_time = (flag.value for flag in self._flags)
        return DiscreteStates(
            need_update=need_update,
            terminate=terminate,
            next_event_time=self._time.value if has_time else None,
            values_changed=values,
            nominals_changed=nominals,
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; return (enter event mode, terminate)."""
        self._completed(not self.library.may_go_back, *self._flag_pointers[:2])
        return self._flags[0].value, self._flags[1].value

    # --- co-simulation ---

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step: Intermediate Updates get the inputs interpolated linearly.

        The interpolation begins at the values that the inputs have now.
        """
        if group is not self._interpolated:
            self._prepare_interpolation(group, len(slopes))
        self.access("Get", group, self._start)
        self._slope[:] = slopes
        self._interpolation.size = len(slopes)  # not 0: switched on for one step

    def _prepare_interpolation(self, group: Group, size: int) -> None:
        """Set C's pointers to the memory to interpolate in, and to the inputs to set."""
        interpolation = self._interpolation
        self._interpolated = group
        self._start = np.empty(size)
        self._slope = np.empty(size)
        self._values = np.empty(size)
        interpolation.start = self._start.ctypes.data
        interpolation.slope = self._slope.ctypes.data
        interpolation.values = self._values.ctypes.data
        interpolation.references = group.address
        interpolation.count = group.count
        set_function = self.library.function("SetFloat64", c_int, c_void_p, *_VALUES)
        interpolation.set = cast(set_function, c_void_p).value

    def slopes_struct(self, group: Group, columns: NDArray[np.intp]) -> SlopesStruct:
        """Return the slopes of inputs for compiled code."""
        self._prepare_interpolation(group, len(columns))
        struct = SlopesStruct(self.library.call_address("GetFloat64"), group.address)
        struct.count = group.count
        struct.size = len(columns)
        struct.columns = columns.ctypes.data
        struct.start = self._start.ctypes.data
        struct.values = self._slope.ctypes.data
        struct.interpolation = addressof(self._interpolation)
        return struct

    def step_struct(self) -> StepStruct:
        """Return do_step for compiled code."""
        struct = StepStruct(
            self.library.function_address("DoStep"), self.library.call_address("DoStep")
        )
        struct.event_mode = self._specification.capabilities.event_mode
        event_needed, terminate, early_return = (addressof(flag) for flag in self._flags[:3])
        struct.event_needed = event_needed
        struct.terminate = terminate
        struct.early_return = early_return
        struct.last_successful_time = addressof(self._time)
        struct.interpolation = addressof(self._interpolation)
        struct.set = self.library.call_address("SetFloat64")
        return struct

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds.

        A discarded step left the FMU as it was (section 4.2.1.2).
        """
        self._clock.value = t
        interpolation = self._interpolation
        interpolation.t0 = t
        interpolation.h = h
        interpolation.last_request = -math.inf
        status = self._step(t, h, not self.library.may_go_back, *self._step_results)
        return self.end_of_step(t, h, status)

    def end_of_step(self, t: float, h: float, status: int) -> StepEnd:
        """Return how a step ended, by what do_step returned and wrote."""
        self.library.judge("DoStep", status, DISCARD)
        interpolation = self._interpolation
        interpolated_until = math.inf
        if interpolation.size:
            interpolated_until = interpolation.last_request
            interpolation.size = 0
            if interpolation.status > WARNING:
                raise self.library.record_failure("SetFloat64", interpolation.status)
            if interpolation.status == WARNING:
                self.library.record_warning("SetFloat64")
        event_needed, terminate, early = (flag.value for flag in self._flags[:3])
        if status == DISCARD:
            return StepEnd(
                completed=False,
                terminate=terminate,
                discarded=not terminate,
                last_successful_time=t,
            )
        return StepEnd(
            completed=not early,
            terminate=terminate,
            event_needed=event_needed,
            last_successful_time=self._time.value if early else t + h,
            interpolated_until=interpolated_until,
        )


def _interpolated_inputs(specification: InstanceSpecification) -> NDArray[np.uint32]:
    """Return the references of the inputs that will be set in Intermediate Updates."""
    references = []
    if specification.capabilities.interpolates_inputs:
        for variable in specification.description.references("input").variables:
            is_continuous = variable.type == "Float64" and variable.variability == "continuous"
            if is_continuous and variable.inside_steps:
                references.append(variable.reference)
    return np.array(references, np.uint32)
