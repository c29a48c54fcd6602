"""The calls of FMI 1.0, behind the modes of its successors.

FMI 1.0 has no initialization mode: ``fmiInitialize`` (``fmiInitializeSlave``) takes the start values and inputs that were set
before it, and only after it can anything be read. Between ``enter_initialization_mode`` and ``exit_initialization_mode``
therefore the first reading initializes, and a value set after it that is another one begins anew: a slave is reset, a model is
freed and instantiated again, and all that was set is set again. Exit initializes where no reading did. So every output that is
read belongs to the inputs that were set, as in the initialization mode of FMI 2.

Nor has it an FMU state, directional derivatives or event mode in co-simulation: those calls say so. Event mode and
continuous-time mode of model exchange are states in which the same calls are allowed, and entering them calls nothing. From
FMI for Model Exchange 1.0 and FMI for Co-Simulation 1.0, section 2.
"""

from __future__ import annotations

from ctypes import byref, c_char_p, c_double, c_int, c_int8, c_size_t, c_uint, c_void_p, cast
from typing import Any, Final, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.errors import RunError
from cosim.fmi.binary.binding import NO_SLOPES, InstanceSpecification
from cosim.fmi.binary.library import DISCARD, WARNING, Call, Library, declared, pointer
from cosim.fmi.instance import DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable, VariableType
from cosim.native.library import address

LAST_SUCCESSFUL_TIME = 2  # of fmiStatusKind
NO = b"\0"  # fmiFalse
MIME = b"application/x-fmu-sharedlibrary"


@final
class Fmi1:
    """FMI 1.0, one instance; see :class:`cosim.fmi.binary.binding.Calls`."""

    derivatives, nominals = "GetDerivatives", "GetNominalContinuousStates"
    dtypes: dict[str, DTypeLike] = {"Float64": np.float64, "Int32": np.int32, "Boolean": np.int8}
    names: Final = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}

    def __init__(self, library: Library, about: InstanceSpecification) -> None:
        self.library, self._about, self._clock = library, about, about.messages.clock
        fmi1 = declared("fmi1")
        call, values = library.call, (c_void_p, c_size_t, c_void_p)
        self._access = {
            (v, k): call(f"{v}{n}", *values) for v in ("Get", "Set") for k, n in self.names.items()
        }
        self._set_string, self._get_string = call("SetString", *values), call("GetString", *values)
        self._functions: Any = fmi1.fmi1CallbackFunctions()  # handed over by value
        self._info: Any = fmi1.fmi1EventInfo()
        self._given: dict[tuple[VariableType, int], NDArray[Any]] = {}  # by type and reference
        self._texts: dict[int, tuple[Variable, list[bytes]]] = {}
        self._t: float | None = None  # not None: in initialization mode, or after it
        self._told = False  # whether the answer of the initialization is still to be given
        self._starting, self._initialized = (
            True,
            False,
        )  # still before the end of initialization mode; was initialized
        self._say_what_is_missing()
        if about.interface_type == "me":
            self._bind_model_exchange()
        else:
            self._bind_co_simulation()

    def _say_what_is_missing(self) -> None:
        absent = self.library.absent
        self.enter_configuration_mode = self.exit_configuration_mode = absent(
            "FMI 1.0 has no structural parameters"
        )
        self.get_state = self.set_state = self.free_state = absent(
            "FMI 1.0 has no FMU state, so there is no way back"
        )
        self._directional = absent("FMI 1.0 has no directional derivatives")

    def _bind_model_exchange(self) -> None:
        call, function = self.library.call, self.library.function
        by_value = type(self._functions)
        self._create = function("InstantiateModel", c_void_p, c_char_p, c_char_p, by_value, c_int8)
        self._free = function("FreeModelInstance", None, c_void_p)
        self._set_time, self.terminate = call("SetTime", c_double), call("Terminate")
        self._initialize_model = call("Initialize", c_int8, c_double, c_void_p)
        self._update = call("EventUpdate", c_int8, c_void_p)
        self._completed, self._event = call("CompletedIntegratorStep", c_void_p), c_int8()
        self.enter_event_mode: Call = _nothing
        self.enter_continuous_time_mode: Call = _nothing

    def _bind_co_simulation(self) -> None:
        call, function = self.library.call, self.library.function
        names, by_value = (c_char_p, c_char_p, c_char_p, c_char_p), type(self._functions)
        self._create = function(
            "InstantiateSlave", c_void_p, *names, c_double, c_int8, c_int8, by_value, c_int8
        )
        self._free = function("FreeSlaveInstance", None, c_void_p)
        self._reset_slave, self.terminate = call("ResetSlave"), call("TerminateSlave")
        self._initialize_slave = call("InitializeSlave", c_double, c_int8, c_double)
        self._step = self.library.status("DoStep", c_double, c_double, c_int8)
        self._real_status = self.library.status("GetRealStatus", c_int, c_void_p)
        self._orders = np.ones(0, np.int32)
        if self._about.capabilities.interpolates_inputs:
            self._slopes = call("SetRealInputDerivatives", c_void_p, c_size_t, c_void_p, c_void_p)
        else:
            self._slopes = self.library.absent(NO_SLOPES)
        no_events = self.library.absent("FMI 1.0 has no event mode in co-simulation")
        self.enter_event_mode = self.enter_step_mode = self._update = no_events

    def instantiate(self) -> None:
        """Create the instance. It gives no environment to the logger: its messages are known by its own address."""
        about, functions, fmi1 = self._about, self._functions, declared("fmi1")
        functions.logger = cast(address("cosim_log"), fmi1.fmi1CallbackLoggerTYPE)
        functions.allocateMemory = cast(
            address("cosim_allocate"), fmi1.fmi1CallbackAllocateMemoryTYPE
        )
        functions.freeMemory = cast(address("cosim_free"), fmi1.fmi1CallbackFreeMemoryTYPE)
        names = (about.name.encode(), about.token.encode())
        about.messages.listen(None)
        if about.interface_type == "me":
            created = self._create(*names, functions, 0)
        else:
            created = self._create(
                *names, about.folder.as_uri().encode(), MIME, 0.0, 0, 0, functions, 0
            )
        self.library.instance.value = created
        about.messages.listen(created or 0)

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        if self.library.instance and not self.library.over:
            self._free(self.library.instance)
        self.library.instance.value = None
        self._about.messages.listen(0)

    # --- from instantiation to the end of initialization ---

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self._begin_anew()
        self._given.clear()
        self._texts.clear()
        self._t, self._starting = None, True

    def _begin_anew(self) -> None:
        self._initialized = False
        if self._about.interface_type == "cs":
            self._reset_slave()
            return
        self.free()
        self.instantiate()
        if not self.library.instance:
            raise RunError(
                f"{self.library.name}: refuses to be instantiated a second time{self.library.messages.tail}"
            )

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self._t = t

    def exit_initialization_mode(self) -> None:
        """Initialize, where no reading did."""
        self._initialize()
        self._starting = False

    def _initialize(self) -> None:
        if self._initialized or self._t is None:
            return
        if self._about.interface_type == "me":
            self._set_time(self._t)
            self._initialize_model(0, 0.0, byref(self._info))
        else:
            self._initialize_slave(self._t, 0, 0.0)
        self._initialized = self._told = True

    def _change(self) -> None:
        """Begin anew with all that was set, as a value is about to be another than the one that was initialized with."""
        if self._initialized:
            self._begin_anew()
            for (kind, reference), value in self._given.items():
                self._access["Set", kind](byref(c_uint(reference)), 1, pointer(value))
            for variable, texts in self._texts.values():
                self._hand_over_text(variable, texts)

    # --- values ---

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        if self._starting:
            self._access_at_start(verb, group, values)
        self._access[verb, group.type](group.address, group.count, pointer(values))

    def _access_at_start(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        if verb == "Get":
            self._initialize()
            return
        keys = [(group.type, reference) for reference in group.references.tolist()]
        given = dict(zip(keys, values.copy().reshape(-1, 1), strict=True))
        if any(key not in self._given or self._given[key] != value for key, value in given.items()):
            self._change()
            self._given |= given

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String."""
        if self._starting:
            self._change()
            self._texts[variable.reference] = variable, values
        self._hand_over_text(variable, values)

    def _hand_over_text(self, variable: Variable, values: list[bytes]) -> None:
        self._set_string(byref(c_uint(variable.reference)), 1, (c_char_p * 1)(*values))

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String."""
        if self._starting:
            self._initialize()
        found = (c_char_p * 1)()
        self._get_string(byref(c_uint(variable.reference)), 1, found)
        return [found[0] or b""]

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Refuse."""
        self._directional()

    # --- model exchange ---

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration; the first one was the initialization's."""
        info = self._info
        if self._told:
            self._told = False
        else:
            self._update(0, byref(info))
        return DiscreteStates(
            info.iterationConverged == NO,
            info.terminateSimulation != NO,
            info.nextEventTime if info.upcomingTimeEvent != NO else None,
            info.stateValuesChanged != NO,
            info.stateValueReferencesChanged != NO,
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        self._completed(byref(self._event))
        return bool(self._event.value), False

    # --- co-simulation ---

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        if len(self._orders) != group.count:
            self._orders = np.ones(group.count, np.int32)
        self._slopes(group.address, group.count, pointer(self._orders), pointer(slopes))

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds: always a new step, as there is no way back."""
        self._clock.value = t
        if self._step(t, h, 1) <= WARNING:
            return StepEnd(completed=True, terminate=False, reached=t + h)
        reached = c_double()
        known = self._real_status(LAST_SUCCESSFUL_TIME, byref(reached)) < DISCARD
        return StepEnd(
            completed=False, terminate=False, discarded=True, reached=reached.value if known else t
        )


def _nothing() -> None:
    """Event mode and continuous-time mode differ in nothing that is called."""
