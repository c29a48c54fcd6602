"""The calls of FMI 3.0."""

from __future__ import annotations

import math
import os
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
from typing import Any, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.fmi.binary.binding import NO_DIRECTIONAL_DERIVATIVES, NO_STATE, InstanceSpecification
from cosim.fmi.binary.library import DISCARD, WARNING, Library, pointer
from cosim.fmi.description import Capabilities
from cosim.fmi.instance import DiscreteStates, StepEnd
from cosim.fmi.references import Group
from cosim.fmi.variable import Variable
from cosim.native.library import InterpolationStruct, address

_NUMBERS = (
    "Float64",
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
)
_NAMES = (
    c_char_p,
    c_char_p,
    c_char_p,
    c_bool,
    c_bool,
)  # of an instance: name, token, resources; visible, logging
_VALUES = (c_void_p, c_void_p, c_size_t, c_void_p, c_size_t)  # of a function that gets or sets


@final
class Fmi3:
    """FMI 3.0, one instance; see :class:`cosim.fmi.binary.binding.Calls`."""

    derivatives, nominals = "GetContinuousStateDerivatives", "GetNominalsOfContinuousStates"
    dtypes: dict[str, DTypeLike] = {
        **{name: np.dtype(name.lower()) for name in _NUMBERS},
        "Boolean": np.bool_,
    }

    def __init__(self, library: Library, about: InstanceSpecification) -> None:
        self.library, self._about, self._clock = library, about, about.messages.clock
        can = about.capabilities
        self._free = library.function("FreeInstance", None, c_void_p)
        self._lines = InterpolationStruct()
        self._lined: Group | None = None  # the inputs of the lines
        self._flags, self._time = [c_bool() for _ in range(5)], c_double()
        self._answers = [byref(flag) for flag in self._flags]
        self._bind_values(can)
        self._bind_modes()
        if about.interface_type == "me":
            self._bind_model_exchange(no_way_back=not can.saves_state)
        else:
            self._bind_co_simulation(no_way_back=not can.saves_state)

    def _bind_values(self, can: Capabilities) -> None:
        call, values = self.library.call, _VALUES[1:]
        self._access = {
            (verb, kind): call(f"{verb}{kind}", *values)
            for verb in ("Get", "Set")
            for kind in self.dtypes
        }
        self._text = {verb: call(f"{verb}String", *values) for verb in ("Get", "Set")}
        binary = (c_void_p, c_size_t, c_void_p, c_void_p, c_size_t)
        self._binary = {verb: call(f"{verb}Binary", *binary) for verb in ("Get", "Set")}
        if can.directional_derivatives:
            self._directional = call("GetDirectionalDerivative", *(c_void_p, c_size_t) * 4)
        else:
            self._directional = self.library.absent(NO_DIRECTIONAL_DERIVATIVES)
        if can.saves_state:
            self.get_state, self.set_state = (
                call("GetFMUState", c_void_p),
                call("SetFMUState", c_void_p),
            )
            self.free_state = call("FreeFMUState", c_void_p)
        else:
            self.get_state = self.set_state = self.free_state = self.library.absent(NO_STATE)

    def _bind_modes(self) -> None:
        call = self.library.call
        self._enter = call("EnterInitializationMode", c_bool, c_double, c_double, c_bool, c_double)
        self.exit_initialization_mode = call("ExitInitializationMode")
        self.enter_configuration_mode = call("EnterConfigurationMode")
        self.exit_configuration_mode = call("ExitConfigurationMode")
        self.reset, self.terminate, self.enter_event_mode = (
            call("Reset"),
            call("Terminate"),
            call("EnterEventMode"),
        )
        self._update = partial(
            call("UpdateDiscreteStates", *[c_void_p] * 6), *self._answers, byref(self._time)
        )

    def _bind_model_exchange(self, *, no_way_back: bool) -> None:
        self._create = self.library.function(
            "InstantiateModelExchange", c_void_p, *_NAMES, c_void_p, c_void_p
        )
        self.enter_continuous_time_mode = self.library.call("EnterContinuousTimeMode")
        completed = self.library.call("CompletedIntegratorStep", c_bool, c_void_p, c_void_p)
        self._completed = partial(completed, no_way_back, *self._answers[:2])

    def _bind_co_simulation(self, *, no_way_back: bool) -> None:
        rest = (c_bool, c_bool, c_void_p, c_size_t, c_void_p, c_void_p, c_void_p)
        self._create = self.library.function("InstantiateCoSimulation", c_void_p, *_NAMES, *rest)
        self.enter_step_mode = self.library.call("EnterStepMode")
        self._step = self.library.status("DoStep", c_double, c_double, c_bool, *[c_void_p] * 4)
        self._rest = (no_way_back, *self._answers[:3], byref(self._time))

    def instantiate(self) -> None:
        """Create the instance."""
        about, key, log = self._about, addressof(self._lines), address("cosim_log_text")
        about.messages.listen(key)
        names = (
            about.name.encode(),
            about.token.encode(),
            f"{about.folder / 'resources'}{os.sep}".encode(),
        )
        if about.interface_type == "me":
            self.library.instance.value = self._create(*names, False, False, key, log)
        else:
            flags = (
                False,
                False,
                about.capabilities.event_mode,
                True,
            )  # visible, logging, event mode used, early return allowed
            required = self._interpolated(about)
            update = (
                pointer(required),
                len(required),
                key,
                log,
                address("cosim_intermediate_update"),
            )
            self.library.instance.value = self._create(*names, *flags, *update)

    @staticmethod
    def _interpolated(about: InstanceSpecification) -> NDArray[np.uint32]:
        """Give the references of the inputs that will be set in Intermediate Updates."""
        moving = (
            v
            for v in about.description.variables
            if v.causality == "input" and v.variability == "continuous"
        )
        able = about.capabilities.interpolates_inputs
        found = [v.reference for v in moving if able and v.type == "Float64" and v.inside_steps]
        return np.array(found, np.uint32)

    def free(self) -> None:
        """Free the instance, unless a fatal status forbids it."""
        if self.library.instance and not self.library.over:
            self._free(self.library.instance)
        self.library.instance.value = None

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self._enter(False, 0.0, t, False, 0.0)

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        self._access[verb, group.type](group.address, group.count, pointer(values), len(values))

    def set_text(self, variable: Variable, values: list[bytes]) -> None:
        """Set a String or a Binary, an array too."""
        n, reference = len(values), byref(c_uint(variable.reference))
        texts = (c_char_p * n)(*values)
        if variable.type == "String":
            self._text["Set"](reference, 1, texts, n)
        else:
            self._binary["Set"](reference, 1, (c_size_t * n)(*map(len, values)), texts, n)

    def get_text(self, variable: Variable) -> list[bytes]:
        """Get a String or a Binary, an array too."""
        n, reference = variable.size, byref(c_uint(variable.reference))
        if variable.type == "String":
            texts = (c_char_p * n)()
            self._text["Get"](reference, 1, texts, n)
            return [text or b"" for text in texts]
        sizes, data = (c_size_t * n)(), (POINTER(c_uint8) * n)()
        self._binary["Get"](reference, 1, sizes, data, n)
        return [
            string_at(where, size) if size else b"" for where, size in zip(data, sizes, strict=True)
        ]

    def directional_derivative(
        self, unknowns: Group, knowns: Group, seed: Vector, result: Vector
    ) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        references = (unknowns.address, unknowns.count, knowns.address, knowns.count)
        self._directional(*references, pointer(seed), len(seed), pointer(result), len(result))

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        self._update()
        need, terminate, nominals, values, has_time = (flag.value for flag in self._flags)
        return DiscreteStates(
            need, terminate, self._time.value if has_time else None, values, nominals
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        self._completed()
        return self._flags[0].value, self._flags[1].value

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step: the FMU's Intermediate Updates are answered with the inputs on these lines."""
        if group is not self._lined:
            self._draw(group, len(slopes))
        self.access("Get", group, self._start)
        self._slope[:] = slopes
        self._lines.size = len(slopes)

    def _draw(self, group: Group, size: int) -> None:
        """Let C know the memory of the lines, and what they are of."""
        self._lined, (self._start, self._slope, self._scratch) = group, np.empty((3, size))
        lines, memory = self._lines, (self._start, self._slope, self._scratch)
        lines.start, lines.slope, lines.values = (array.ctypes.data for array in memory)
        lines.references, lines.count, lines.instance = (
            group.address,
            group.count,
            self.library.instance.value,
        )
        lines.set = cast(self.library.function("SetFloat64", c_int, *_VALUES), c_void_p).value

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds; a discarded step left the FMU as it was (section 4.2.1.2)."""
        self._clock.value = t
        lines, followed = self._lines, math.inf
        lines.t0, lines.h, lines.last_request = t, h, -math.inf
        status = self._step(t, h, *self._rest)
        if lines.size:
            lines.size, followed = 0, lines.last_request
            if lines.status > WARNING:
                raise self.library.failure("SetFloat64", lines.status)
        if status == DISCARD:
            return StepEnd(
                False, self._flags[1].value, discarded=not self._flags[1].value, reached=t
            )
        event, terminate, early = self._flags[0].value, self._flags[1].value, self._flags[2].value
        return StepEnd(
            not early, terminate, False, event, self._time.value if early else t + h, followed
        )
