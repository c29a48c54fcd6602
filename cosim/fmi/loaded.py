"""An .fmu behind the unit calls, through fmpy's bindings; the only file that knows FMI 2 from FMI 3.

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
from typing import Any, Final, Protocol, TypeAlias, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.core.signals import Interface
from cosim.core.solver import LinearModel
from cosim.errors import FmuError, RunError
from cosim.fmi.description import LARGEST_EXACT, Description, Mode
from cosim.fmi.unit import DiscreteStates, References, StepEnd

Call: TypeAlias = Callable[..., None]

STATUS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4
MESSAGES = 100  # how many of the FMU's log messages are kept
_Memory = c_uint8 * 1


def _pointer(array: NDArray[Any]) -> Any:
    """Point to a contiguous array's memory; quicker than ``array.ctypes``."""
    memory: Any = array
    return _Memory.from_buffer(memory) if array.size else None


class _Library:
    """The functions of one instance, each checking its status.

    Parameters
    ----------
    binding : fmpy's FMU2Model, FMU2Slave, FMU3Model or FMU3Slave, instantiated
    prefix : {"fmi2", "fmi3"}
    name : str
        Stands in messages.
    messages : deque of str
        What the FMU logged.
    """

    def __init__(self, binding: Any, prefix: str, name: str, messages: deque[str]) -> None:
        self.binding, self.prefix, self.name, self.messages = binding, prefix, name, messages
        self.worst = 0  # the worst status so far

    def function(self, name: str, *types: Any) -> Callable[..., int]:
        """Give a function of the instance that returns its status."""
        found = self.binding.dll[self.prefix + name]
        found.argtypes, found.restype = (c_void_p, *types), c_int
        instance = self.binding.component
        return lambda *arguments: int(found(instance, *arguments))

    def call(self, name: str, *types: Any) -> Call:
        """Give a function of the instance that raises RunError unless its status is ok or warning."""
        found = self.binding.dll[self.prefix + name]
        found.argtypes, found.restype = (c_void_p, *types), c_int
        instance = self.binding.component

        def checked(*arguments: Any) -> None:
            status = found(instance, *arguments)
            if status > WARNING:
                raise self.failure(name, status)

        return checked

    def failure(self, name: str, status: int) -> RunError:
        """Name the FMU, the call, the status and the FMU's last words."""
        self.worst = max(self.worst, status)
        label = STATUS[status] if status < len(STATUS) else "no status of the standard"
        words = f"; it said: {self.messages[-1]}" if self.messages else ""
        return RunError(f"{self.name}: {self.prefix}{name} returned {status} ({label}){words}")

    def free(self) -> None:
        """Free the instance, unless it is lost, and unload the library."""
        if self.binding.component and self.worst < FATAL:
            free = self.binding.dll[f"{self.prefix}FreeInstance"]
            free.argtypes, free.restype = (c_void_p,), None
            free(self.binding.component)
        self.binding.component = None
        self.binding.freeLibrary()


class _Calls(Protocol):
    """Where the versions differ."""

    states: str
    derivatives: str
    dtypes: dict[str, DTypeLike]

    def enter_initialization_mode(self, t: float) -> None: ...
    def access(self, verb: str, kind: str, references: NDArray[np.uint32], values: NDArray[Any]) -> None: ...
    def directional_derivative(
        self, unknowns: NDArray[np.uint32], knowns: NDArray[np.uint32], seed: Vector, result: Vector
    ) -> None: ...
    def update_discrete_states(self) -> DiscreteStates: ...
    def completed_integrator_step(self) -> tuple[bool, bool]: ...
    def set_input_derivatives(self, references: NDArray[np.uint32], slopes: Vector) -> None: ...
    def do_step(self, t: float, h: float) -> StepEnd: ...


class _Fmi2:
    """FMI 2.0.4."""

    states, derivatives = "FMUstate", "GetDerivatives"
    dtypes: dict[str, DTypeLike] = {"Float64": np.float64, "Int32": np.int32, "Boolean": np.int32}  # noqa: RUF012
    names: Final = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}

    def __init__(self, library: _Library, mode: Mode, *, keep_state: bool) -> None:
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
            self._slopes = library.call("SetRealInputDerivatives", c_void_p, c_size_t, c_void_p, c_void_p)

    def enter_initialization_mode(self, t: float) -> None:
        self._setup(0, 0.0, t, 0, 0.0)
        self._enter()

    def access(self, verb: str, kind: str, references: NDArray[np.uint32], values: NDArray[Any]) -> None:
        self._access[verb, kind](_pointer(references), len(references), _pointer(values))

    def directional_derivative(
        self, unknowns: NDArray[np.uint32], knowns: NDArray[np.uint32], seed: Vector, result: Vector
    ) -> None:
        self._directional(_pointer(unknowns), len(unknowns), _pointer(knowns), len(knowns), _pointer(seed), _pointer(result))

    def update_discrete_states(self) -> DiscreteStates:
        info = self._info
        self._update(byref(info))
        time = info.nextEventTime if info.nextEventTimeDefined else None
        return DiscreteStates(
            bool(info.newDiscreteStatesNeeded), bool(info.terminateSimulation), bool(info.valuesOfContinuousStatesChanged), time
        )

    def completed_integrator_step(self) -> tuple[bool, bool]:
        self._completed(self._no_way_back, byref(self._event), byref(self._end))
        return bool(self._event.value), bool(self._end.value)

    def set_input_derivatives(self, references: NDArray[np.uint32], slopes: Vector) -> None:
        orders = np.ones(len(references), np.int32)
        self._slopes(_pointer(references), len(references), _pointer(orders), _pointer(slopes))

    def do_step(self, t: float, h: float) -> StepEnd:
        status = self._step(t, h, self._no_way_back)
        if status <= WARNING:
            return StepEnd(completed=True, terminate=False)
        ended = c_int()
        if status == DISCARD and self._boolean_status(3, byref(ended)) <= WARNING and ended.value:  # 3: fmi2Terminated
            return StepEnd(completed=False, terminate=True)
        raise self._library.failure("DoStep", status)


class _Fmi3:
    """FMI 3.0."""

    states, derivatives = "FMUState", "GetContinuousStateDerivatives"
    dtypes: dict[str, DTypeLike] = {  # noqa: RUF012
        **{
            name: np.dtype(name.lower()) for name in ("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32")
        },
        **{"Int64": np.int64, "UInt64": np.uint64, "Boolean": np.bool_},
    }

    def __init__(self, library: _Library, mode: Mode, *, keep_state: bool) -> None:
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
        self._enter(False, 0.0, t, False, 0.0)

    def access(self, verb: str, kind: str, references: NDArray[np.uint32], values: NDArray[Any]) -> None:
        self._access[verb, kind](_pointer(references), len(references), _pointer(values), len(values))

    def directional_derivative(
        self, unknowns: NDArray[np.uint32], knowns: NDArray[np.uint32], seed: Vector, result: Vector
    ) -> None:
        arrays = (unknowns, knowns, seed, result)
        self._directional(*(argument for array in arrays for argument in (_pointer(array), len(array))))

    def update_discrete_states(self) -> DiscreteStates:
        self._update()
        need, terminate, _, changed, has_time = (flag.value for flag in self._flags)
        return DiscreteStates(need, terminate, changed, self._time.value if has_time else None)

    def completed_integrator_step(self) -> tuple[bool, bool]:
        self._completed()
        return self._flags[0].value, self._flags[1].value

    def set_input_derivatives(self, references: NDArray[np.uint32], slopes: Vector) -> None:
        raise FmuError("FMI 3 has no input derivatives")

    def do_step(self, t: float, h: float) -> StepEnd:
        self._step(t, h, *self._rest)
        return StepEnd(completed=not self._flags[2].value, terminate=self._flags[1].value)


@final
class LoadedUnit:
    """One instance of an FMU: every unit call, of the kind it was instantiated for.

    Parameters
    ----------
    folder : Path
        Where the archive was unpacked.
    library : Path
        The binary for this machine.
    description : Description
    mode : Mode
    name : str
        Name of the instance.
    label : str
        Names the FMU in messages.

    Raises
    ------
    FmuError
        If the library cannot be loaded or refuses to instantiate.
    """

    linear: LinearModel | None = None

    def __init__(self, folder: Path, library: Path, description: Description, *, mode: Mode, name: str, label: str) -> None:
        self.description = description
        self.messages: deque[str] = deque(maxlen=MESSAGES)
        capabilities = description.capabilities[mode]
        binding = _instantiate(folder, library, description, mode=mode, name=name, label=label, messages=self.messages)
        prefix, version = ("fmi2", _Fmi2) if description.version.startswith("2.") else ("fmi3", _Fmi3)
        self._library = _Library(binding, prefix, label, self.messages)
        self._freed = False
        self._calls: _Calls = version(self._library, mode, keep_state=capabilities.saves_state)
        self._n = description.n_states
        call, states = self._library.call, self._calls.states
        self._running = False
        self._exit, self._reset, self._terminate = call("ExitInitializationMode"), call("Reset"), call("Terminate")
        self._get_state, self._set_state = call(f"Get{states}", c_void_p), call(f"Set{states}", c_void_p)
        self._free_state = call(f"Free{states}", c_void_p)
        if mode == "me":
            self.enter_event_mode, self.enter_continuous_time_mode = call("EnterEventMode"), call("EnterContinuousTimeMode")
            self.set_time = call("SetTime", c_double)
            self._set_states = call("SetContinuousStates", c_void_p, c_size_t)
            self._get_states = call("GetContinuousStates", c_void_p, c_size_t)
            self._get_derivatives = call(self._calls.derivatives, c_void_p, c_size_t)

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough, as the file says."""
        return self.description.interface

    # --- modes ---

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self._running = False
        self._reset()

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self._calls.enter_initialization_mode(t)

    def exit_initialization_mode(self) -> None:
        """End the initialization."""
        self._exit()
        self._running = True

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration."""
        return self._calls.update_discrete_states()

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step; answers (enter event mode, terminate)."""
        return self._calls.completed_integrator_step()

    def terminate(self) -> None:
        """End the run; the standard forbids the call before its start and after an error."""
        if self._running and self._library.worst < ERROR and not self._freed:
            self._running = False
            self._terminate()

    def free_instance(self) -> None:
        """Free the instance and unload the library; once."""
        if not self._freed:
            self._freed = True
            self._library.free()

    # --- values ---

    def set_float64(self, references: References, values: Vector) -> None:
        """Set variables; the values of integers and Booleans must be such."""
        if references.plain:
            self._calls.access("Set", "Float64", references.groups[0].references, values)
            return
        for group in references.groups:
            own = self._to(group.type, values[group.columns])
            self._calls.access("Set", group.type, group.references, own)

    def get_float64(self, references: References) -> Vector:
        """Get variables as a new vector."""
        values = np.empty(references.size)
        if references.plain:
            self._calls.access("Get", "Float64", references.groups[0].references, values)
            return values
        for group in references.groups:
            own = np.empty(len(group.columns), self._calls.dtypes[group.type])
            self._calls.access("Get", group.type, group.references, own)
            if group.type in ("Int64", "UInt64") and (np.abs(own.astype(np.float64)) > LARGEST_EXACT).any():
                raise RunError(f"{self._library.name}: an integer beyond 2**53 cannot be carried exactly: {own.tolist()}")
            values[group.columns] = own
        return values

    def _to(self, kind: str, values: Vector) -> NDArray[Any]:
        """Convert to the type of the FMU, exactly or not at all."""
        if kind == "Float32":
            return values.astype(np.float32)
        if not np.isfinite(values).all():
            raise RunError(f"{self._library.name}: {values.tolist()} cannot be set: needed numbers of type {kind}")
        own = values.astype(self._calls.dtypes[kind])
        if (own.astype(np.float64) != values).any() or (kind == "Boolean" and not np.isin(values, (0.0, 1.0)).all()):
            raise RunError(f"{self._library.name}: {values.tolist()} cannot be set: needed numbers of type {kind}")
        return own

    def set_continuous_states(self, x: Vector) -> None:
        """Set the states, shape (n_x,)."""
        self._set_states(_pointer(x), self._n)

    def get_continuous_states(self) -> Vector:
        """Give the states, shape (n_x,)."""
        x = np.empty(self._n)
        self._get_states(_pointer(x), self._n)
        return x

    def get_derivatives(self) -> Vector:
        """Give x', shape (n_x,)."""
        dx = np.empty(self._n)
        self._get_derivatives(_pointer(dx), self._n)
        return dx

    def get_directional_derivative(self, unknowns: References, knowns: References, seed: Vector) -> Vector:
        """Give d(unknowns)/d(knowns) . seed, for Float64 variables."""
        result = np.empty(unknowns.size)
        self._calls.directional_derivative(unknowns.groups[0].references, knowns.groups[0].references, seed, result)
        return result

    # --- co-simulation ---

    def set_input_derivatives(self, references: References, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        self._calls.set_input_derivatives(references.groups[0].references, slopes)

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        return self._calls.do_step(t, h)

    # --- states ---

    def get_fmu_state(self) -> object:
        """Copy the whole state."""
        state = c_void_p()
        self._get_state(byref(state))
        return state

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state."""
        self._set_state(state)

    def free_fmu_state(self, state: object) -> None:
        """Let go of a copied state; nothing to do once the instance is gone."""
        assert isinstance(state, c_void_p)
        if not self._freed and self._library.worst < FATAL:
            self._free_state(byref(state))


def _instantiate(
    folder: Path, library: Path, description: Description, *, mode: Mode, name: str, label: str, messages: deque[str]
) -> Any:
    """Load the library and instantiate it, through fmpy."""
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
            binding.instantiate(logMessage=lambda _, status, category, text: _keep(messages, status, text))
    except Exception as error:  # fmpy raises plain Exceptions, ctypes OSError and AttributeError
        if binding is not None:
            binding.freeLibrary()
        words = f"; it said: {messages[-1]}" if messages else ""
        raise FmuError(f"{label}: the binary {library.name} cannot be used: {error}{words}") from error
    finally:
        os.chdir(home)  # fmpy leaves it changed where loading fails
    return binding


def _callbacks(fmi2: Any, messages: deque[str]) -> Any:
    from fmpy import calloc, free

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda _, instance, status, category, text: _keep(messages, status, text))
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return callbacks


def _keep(messages: deque[str], status: int, text: bytes | None) -> None:
    label = STATUS[status] if 0 <= status < len(STATUS) else str(status)
    messages.append(f"{label}: {(text or b'').decode('utf-8', 'replace')[:1000]}")
