"""FMI 2 and FMI 3 through fmpy's bindings: the only file that knows one version from the other.

fmpy loads the library and instantiates. The calls of a run go to the library's functions directly, on the memory of numpy arrays:
fmpy's own wrappers build their ctypes arrays anew from lists at every call.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from ctypes import byref, c_bool, c_double, c_int, c_size_t, c_uint8, c_void_p
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.core.contracts import Level
from cosim.errors import FmuError, RunError
from cosim.fmi.description import Description, Mode
from cosim.fmi.references import Group
from cosim.fmi.unit import DiscreteStates, StepEnd

Call: TypeAlias = Callable[..., None]

STATUS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
LEVELS: Final[tuple[Level, ...]] = ("info", "warning", "warning", "error", "fatal", "info")  # of a message, by status
WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4
MESSAGES = 100  # how many of the FMU's log messages are kept until they are fetched
_Memory = c_uint8 * 1


def pointer(array: NDArray[Any]) -> Any:
    """Point to a contiguous array's memory; quicker than ``array.ctypes``."""
    memory: Any = array
    return _Memory.from_buffer(memory) if array.size else None


class Messages:
    """What an FMU logs, kept until it is fetched: the last ``MESSAGES`` of it, 1000 characters each.

    FMI 2 hands over a printf format and its arguments, which cannot be read from Python: the format is kept as it is.
    """

    def __init__(self) -> None:
        self._kept: deque[tuple[Level, str]] = deque(maxlen=MESSAGES)
        self._dropped = 0

    def add(self, status: int, text: bytes | None) -> None:
        """Keep a message."""
        self._dropped += len(self._kept) == MESSAGES
        level: Level = LEVELS[status] if 0 <= status < len(LEVELS) else "warning"
        self._kept.append((level, (text or b"").decode("utf-8", "replace")[:1000]))

    @property
    def tail(self) -> str:
        """The last one that was not fetched yet, as the tail of an error; empty where there is none."""
        return f"; it said: {': '.join(self._kept[-1])}" if self._kept else ""

    def drain(self) -> list[tuple[Level, str]]:
        """Give (level, text) since the last call, and how many were dropped."""
        lost = f"{self._dropped} earlier messages of the FMU were dropped"
        found: list[tuple[Level, str]] = [("warning", lost)] if self._dropped else []
        found += self._kept
        self._kept.clear()
        self._dropped = 0
        return found


class Library:
    """The functions of one instance, each checking its status.

    Parameters
    ----------
    binding : fmpy's FMU2Model, FMU2Slave, FMU3Model or FMU3Slave, instantiated
    prefix : {"fmi2", "fmi3"}
    name : str
        Stands in messages.
    messages : Messages
        What the FMU logs.
    """

    def __init__(self, binding: Any, prefix: str, name: str, messages: Messages) -> None:
        self.binding, self.prefix, self.name, self.messages = binding, prefix, name, messages
        self.failed = False  # an error or worse: terminate is no longer allowed
        self.lost = False  # fatal: no call is allowed any more

    def function(self, name: str, *types: Any) -> Callable[..., int]:
        """Give a function of the instance that returns its status."""
        found = self.binding.dll[self.prefix + name]
        found.argtypes, found.restype = (c_void_p, *types), c_int
        instance = self.binding.component
        return lambda *arguments: self._heed(found(instance, *arguments))

    def call(self, name: str, *types: Any) -> Call:
        """Give a function of the instance that raises RunError unless its status is ok or warning."""
        found = self.binding.dll[self.prefix + name]
        found.argtypes, found.restype = (c_void_p, *types), c_int
        instance = self.binding.component

        def checked(*arguments: Any) -> None:
            status = self._heed(found(instance, *arguments))
            if status > WARNING:
                raise self.failure(name, status)

        return checked

    def _heed(self, status: int) -> int:
        """Remember what forbids later calls."""
        if status >= ERROR:
            self.failed = True
            self.lost |= status == FATAL
        return status

    def failure(self, name: str, status: int) -> RunError:
        """Name the FMU, the call, the status and the FMU's last words."""
        label = STATUS[status] if status < len(STATUS) else "no status of the standard"
        return RunError(f"{self.name}: {self.prefix}{name} returned {status} ({label}){self.messages.tail}")

    def free(self) -> None:
        """Free the instance, unless it is lost, and unload the library."""
        if self.binding.component and not self.lost:
            free = self.binding.dll[f"{self.prefix}FreeInstance"]
            free.argtypes, free.restype = (c_void_p,), None
            free(self.binding.component)
        self.binding.component = None
        self.binding.freeLibrary()


class Calls(Protocol):
    """Where the versions differ."""

    states: str
    derivatives: str
    dtypes: dict[str, DTypeLike]

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        ...

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        ...

    def directional_derivative(self, unknowns: Group, knowns: Group, seed: Vector, result: Vector) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        ...

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        ...

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        ...

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        ...

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        ...


class Fmi2:
    """FMI 2.0.4."""

    states, derivatives = "FMUstate", "GetDerivatives"
    dtypes: dict[str, DTypeLike] = {"Float64": np.float64, "Int32": np.int32, "Boolean": np.int32}  # noqa: RUF012
    names: Final = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}

    def __init__(self, library: Library, mode: Mode, *, keep_state: bool) -> None:
        self._library, self._no_way_back = library, int(not keep_state)
        values = (c_void_p, c_size_t, c_void_p)
        self._access = {(v, k): library.call(f"{v}{n}", *values) for v in ("Get", "Set") for k, n in self.names.items()}
        self._setup = library.call("SetupExperiment", c_int, c_double, c_double, c_int, c_double)
        self._enter = library.call("EnterInitializationMode")
        self._directional = library.call("GetDirectionalDerivative", c_void_p, c_size_t, c_void_p, c_size_t, c_void_p, c_void_p)
        if mode == "me":
            from fmpy.fmi2 import fmi2EventInfo

            self._info, self._event, self._end = fmi2EventInfo(), c_int(), c_int()
            self._update = library.call("NewDiscreteStates", c_void_p)
            self._completed = library.call("CompletedIntegratorStep", c_int, c_void_p, c_void_p)
        else:
            self._step = library.function("DoStep", c_double, c_double, c_int)
            self._boolean_status = library.function("GetBooleanStatus", c_int, c_void_p)
            self._orders = np.zeros(0, np.int32)
            self._slopes = library.call("SetRealInputDerivatives", c_void_p, c_size_t, c_void_p, c_void_p)

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self._setup(0, 0.0, t, 0, 0.0)
        self._enter()

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        self._access[verb, group.type](group.address, group.count, pointer(values))

    def directional_derivative(self, unknowns: Group, knowns: Group, seed: Vector, result: Vector) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        self._directional(unknowns.address, unknowns.count, knowns.address, knowns.count, pointer(seed), pointer(result))

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        info = self._info
        self._update(byref(info))
        time = info.nextEventTime if info.nextEventTimeDefined else None
        return DiscreteStates(bool(info.newDiscreteStatesNeeded), bool(info.terminateSimulation), time)

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
        """Advance from ``t`` by ``h`` seconds."""
        status = self._step(t, h, self._no_way_back)
        if status <= WARNING:
            return StepEnd(completed=True, terminate=False)
        ended = c_int()
        if status == DISCARD and self._boolean_status(3, byref(ended)) <= WARNING and ended.value:  # 3: fmi2Terminated
            return StepEnd(completed=False, terminate=True)
        raise self._library.failure("DoStep", status)


class Fmi3:
    """FMI 3.0."""

    states, derivatives = "FMUState", "GetContinuousStateDerivatives"
    dtypes: dict[str, DTypeLike] = {  # noqa: RUF012
        **{
            name: np.dtype(name.lower()) for name in ("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32")
        },
        **{"Int64": np.int64, "UInt64": np.uint64, "Boolean": np.bool_},
    }

    def __init__(self, library: Library, mode: Mode, *, keep_state: bool) -> None:
        no_way_back = not keep_state
        values = (c_void_p, c_size_t, c_void_p, c_size_t)
        self._access = {(verb, kind): library.call(f"{verb}{kind}", *values) for verb in ("Get", "Set") for kind in self.dtypes}
        self._enter = library.call("EnterInitializationMode", c_bool, c_double, c_double, c_bool, c_double)
        pair = (c_void_p, c_size_t)
        self._directional = library.call("GetDirectionalDerivative", *pair, *pair, *pair, *pair)
        self._flags, self._time = [c_bool() for _ in range(5)], c_double()
        pointers = [byref(flag) for flag in self._flags]
        if mode == "me":
            update = library.call("UpdateDiscreteStates", *[c_void_p] * 6)
            completed = library.call("CompletedIntegratorStep", c_bool, c_void_p, c_void_p)
            self._update = partial(update, *pointers, byref(self._time))
            self._completed = partial(completed, no_way_back, *pointers[:2])
        else:
            self._step = library.call("DoStep", c_double, c_double, c_bool, *[c_void_p] * 4)
            self._rest = (no_way_back, *pointers[:3], byref(self._time))

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self._enter(False, 0.0, t, False, 0.0)

    def access(self, verb: str, group: Group, values: NDArray[Any]) -> None:
        """Get or set variables of one type: ``verb`` is "Get" or "Set"."""
        self._access[verb, group.type](group.address, group.count, pointer(values), len(values))

    def directional_derivative(self, unknowns: Group, knowns: Group, seed: Vector, result: Vector) -> None:
        """Write d(unknowns)/d(knowns) . seed into ``result``."""
        references = (unknowns.address, unknowns.count, knowns.address, knowns.count)
        self._directional(*references, pointer(seed), len(seed), pointer(result), len(result))

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        self._update()
        need, terminate, _, _, has_time = (flag.value for flag in self._flags)
        return DiscreteStates(need, terminate, self._time.value if has_time else None)

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        self._completed()
        return self._flags[0].value, self._flags[1].value

    def set_input_derivatives(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        raise FmuError("FMI 3 has no input derivatives")

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        self._step(t, h, *self._rest)
        return StepEnd(completed=not self._flags[2].value, terminate=self._flags[1].value)


def instantiate(
    folder: Path, library: Path, description: Description, *, mode: Mode, name: str, label: str, messages: Messages
) -> tuple[Any, Literal["fmi2", "fmi3"]]:
    """Load the library and instantiate it, through fmpy; give fmpy's object and the prefix of the functions.

    Raises
    ------
    FmuError
        If the library cannot be loaded, lacks a function, or refuses.
    """
    from fmpy import fmi2, fmi3

    version_2 = description.version.startswith("2.")
    found: dict[Mode, Any] = (
        {"me": fmi2.FMU2Model, "cs": fmi2.FMU2Slave} if version_2 else {"me": fmi3.FMU3Model, "cs": fmi3.FMU3Slave}
    )
    home, binding = Path.cwd(), None
    try:
        binding = found[mode](
            guid=description.token,
            modelIdentifier=description.capabilities[mode].identifier,
            unzipDirectory=str(folder),
            instanceName=name,
            libraryPath=str(library),
        )
        if version_2:
            binding.instantiate(callbacks=_callbacks(fmi2, messages))
        else:
            binding.instantiate(logMessage=lambda _, status, category, text: messages.add(status, text))
    except Exception as error:  # fmpy raises plain Exceptions, ctypes OSError and AttributeError
        if binding is not None:
            binding.freeLibrary()
        raise FmuError(f"{label}: the binary {library.name} cannot be used: {error}{messages.tail}") from error
    finally:
        os.chdir(home)  # fmpy leaves it changed where loading fails
    return binding, "fmi2" if version_2 else "fmi3"


def _callbacks(fmi2: Any, messages: Messages) -> Any:
    from fmpy import calloc, free

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda _, instance, status, category, text: messages.add(status, text))
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return callbacks


def bind(library: Library, description: Description, mode: Mode) -> Calls:
    """Bind the calls of an instance's version and kind."""
    version = Fmi2 if library.prefix == "fmi2" else Fmi3
    return version(library, mode, keep_state=description.capabilities[mode].saves_state)
