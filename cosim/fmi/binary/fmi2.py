"""The calls of FMI 2.0.4."""

from __future__ import annotations

from ctypes import addressof, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_void_p, cast
from typing import Any, Final, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.fmi.binary.binding import (
    NO_DIRECTIONAL_DERIVATIVES,
    NO_SLOPES,
    NO_STATE,
    InstanceSpecification,
)
from cosim.fmi.binary.library import DISCARD, WARNING, Library, declared, pointer
from cosim.fmi.instance import DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable
from cosim.native.library import address

LAST_SUCCESSFUL_TIME, IS_TERMINATED = 2, 3  # of fmi2StatusKind


@final
class Fmi2:
    """FMI 2.0.4, one instance; see :class:`cosim.fmi.binary.binding.Calls`."""

    derivatives, nominals = "GetDerivatives", "GetNominalsOfContinuousStates"
    dtypes: dict[str, DTypeLike] = {"Float64": np.float64, "Int32": np.int32, "Boolean": np.int32}
    names: Final = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}

    def __init__(self, library: Library, about: InstanceSpecification) -> None:
        self.library, self._about, self._clock = library, about, about.messages.clock
        can = about.capabilities
        self._free = library.function("FreeInstance", None, c_void_p)
        self._create = library.function(
            "Instantiate", c_void_p, c_char_p, c_int, c_char_p, c_char_p, c_void_p, c_int, c_int
        )
        self._no_way_back = int(not can.saves_state)
        call, values = library.call, (c_void_p, c_size_t, c_void_p)
        self._access = {
            (v, k): call(f"{v}{n}", *values) for v in ("Get", "Set") for k, n in self.names.items()
        }
        self._set_string, self._get_string = call("SetString", *values), call("GetString", *values)
        self._setup = call("SetupExperiment", c_int, c_double, c_double, c_int, c_double)
        self._enter, self.exit_initialization_mode = (
            call("EnterInitializationMode"),
            call("ExitInitializationMode"),
        )
        self.reset, self.terminate = call("Reset"), call("Terminate")
        no_structure = library.absent(
            "FMI 2.0 has no configuration mode and no structural parameters"
        )
        self.enter_configuration_mode = self.exit_configuration_mode = no_structure
        if can.directional_derivatives:
            pair = (c_void_p, c_size_t)
            self._directional = call("GetDirectionalDerivative", *pair, *pair, c_void_p, c_void_p)
        else:
            self._directional = library.absent(NO_DIRECTIONAL_DERIVATIVES)
        if can.saves_state:
            self.get_state, self.set_state = (
                call("GetFMUstate", c_void_p),
                call("SetFMUstate", c_void_p),
            )
            self.free_state = call("FreeFMUstate", c_void_p)
        else:
            self.get_state = self.set_state = self.free_state = library.absent(NO_STATE)
        if about.interface_type == "me":
            self._bind_model_exchange()
        else:
            self._bind_co_simulation(interpolates=can.interpolates_inputs)

    def _bind_model_exchange(self) -> None:
        call = self.library.call
        self.enter_event_mode, self.enter_continuous_time_mode = (
            call("EnterEventMode"),
            call("EnterContinuousTimeMode"),
        )
        self._info: Any = declared("fmi2").fmi2EventInfo()
        self._update = call("NewDiscreteStates", c_void_p)
        self._completed = call("CompletedIntegratorStep", c_int, c_void_p, c_void_p)
        self._event, self._end = c_int(), c_int()

    def _bind_co_simulation(self, *, interpolates: bool) -> None:
        call = self.library.call
        self.enter_event_mode = self.enter_step_mode = self._update = self.library.absent(
            "FMI 2.0 has no event mode in co-simulation"
        )
        self._step = self.library.status("DoStep", c_double, c_double, c_int)
        self._boolean_status = self.library.status("GetBooleanStatus", c_int, c_void_p)
        self._real_status = self.library.status("GetRealStatus", c_int, c_void_p)
        self._orders = np.ones(0, np.int32)
        self._slopes = (
            call("SetRealInputDerivatives", c_void_p, c_size_t, c_void_p, c_void_p)
            if interpolates
            else self.library.absent(NO_SLOPES)
        )

    def instantiate(self) -> None:
        """Create the instance."""
        about, fmi2 = self._about, declared("fmi2")
        self._callbacks = fmi2.fmi2CallbackFunctions()  # the FMU keeps the address
        self._callbacks.logger = cast(address("cosim_log"), fmi2.fmi2CallbackLoggerTYPE)
        self._callbacks.allocateMemory = cast(
            address("cosim_allocate"), fmi2.fmi2CallbackAllocateMemoryTYPE
        )
        self._callbacks.freeMemory = cast(address("cosim_free"), fmi2.fmi2CallbackFreeMemoryTYPE)
        self._callbacks.componentEnvironment = key = addressof(self._callbacks)
        about.messages.listen(key)
        resources = (about.folder / "resources").as_uri().encode()
        names = (
            about.name.encode(),
            int(about.interface_type == "cs"),
            about.token.encode(),
            resources,
        )
        self.library.instance.value = self._create(*names, key, 0, 0)

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        if self.library.instance and not self.library.over:
            self._free(self.library.instance)
        self.library.instance.value = None

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self._setup(0, 0.0, t, 0, 0.0)
        self._enter()

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        self._access[verb, group.type](group.address, group.count, pointer(values))

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String."""
        self._set_string(byref(c_uint(variable.reference)), 1, (c_char_p * 1)(*values))

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String."""
        found = (c_char_p * 1)()
        self._get_string(byref(c_uint(variable.reference)), 1, found)
        return [found[0] or b""]

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        self._directional(
            unknowns.address,
            unknowns.count,
            knowns.address,
            knowns.count,
            pointer(seed),
            pointer(result),
        )

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        info = self._info
        self._update(byref(info))
        return DiscreteStates(
            bool(info.newDiscreteStatesNeeded),
            bool(info.terminateSimulation),
            info.nextEventTime if info.nextEventTimeDefined else None,
            bool(info.valuesOfContinuousStatesChanged),
            bool(info.nominalsOfContinuousStatesChanged),
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        self._completed(self._no_way_back, byref(self._event), byref(self._end))
        return bool(self._event.value), bool(self._end.value)

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        if len(self._orders) != group.count:
            self._orders = np.ones(group.count, np.int32)
        self._slopes(group.address, group.count, pointer(self._orders), pointer(slopes))

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds (section 4.2.2: what discard means is asked for)."""
        self._clock.value = t
        if self._step(t, h, self._no_way_back) <= WARNING:
            return StepEnd(True, False, False, False, t + h)
        ended, reached = c_int(), c_double()
        terminate = self._boolean_status(IS_TERMINATED, byref(ended)) < DISCARD and bool(
            ended.value
        )
        known = self._real_status(LAST_SUCCESSFUL_TIME, byref(reached)) < DISCARD
        return StepEnd(
            False, terminate, discarded=not terminate, reached=reached.value if known else t
        )
