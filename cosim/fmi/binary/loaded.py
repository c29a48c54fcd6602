"""An .fmu behind the unit calls, whatever its version and kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from ctypes import byref, c_double, c_size_t, c_void_p
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface
from cosim.errors import FmuError, RunError
from cosim.fmi.binary.binding import Calls, InstanceSpecification
from cosim.fmi.binary.fmi1 import Fmi1
from cosim.fmi.binary.fmi2 import Fmi2
from cosim.fmi.binary.fmi3 import Fmi3
from cosim.fmi.binary.library import Library, pointer
from cosim.fmi.binary.messages import Messages
from cosim.fmi.description import Description, InterfaceType
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import LARGEST_EXACT, Variable

VERSIONS: Final[Mapping[str, tuple[str, Callable[[Library, InstanceSpecification], Calls]]]] = {
    "1": ("{identifier}_fmi", Fmi1),
    "2": ("fmi2", Fmi2),
    "3": ("fmi3", Fmi3),
}
"""By the first digit of the FMI version: the prefix of its functions, and what binds them."""

ALONE: Final[set[tuple[str, str]]] = set()
"""Name and token of the FMUs that are here and can be instantiated only once per process."""

SPARE: Final = 4  # how many states that were let go of are kept for the next copies


@final
class LoadedInstance:
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
        If the library cannot be loaded or refuses to instantiate, or is here already and can be only once.
    """

    linear: LinearModel | None = None

    def __init__(
        self,
        folder: Path,
        library: Path,
        description: Description,
        *,
        interface_type: InterfaceType,
        name: str,
        label: str,
    ) -> None:
        self.description = description
        self.messages = Messages()
        about = InstanceSpecification(description, interface_type, name, folder, self.messages)
        with _alone(about, label), _loaded(library, about, label) as calls:
            self._library, self._about, self._calls = calls.library, about, calls
            self._bind(
                calls, interface_type
            )  # before there is an instance: what is missing leaves none behind
            calls.instantiate()
            if not calls.library.instance:
                raise calls.library.refusal("it refuses to instantiate")
        self._freed = self._running = False
        self._states: list[c_void_p] = []  # all that the FMU allocated
        self._spare: list[c_void_p] = []  # those of them that nobody needs
        self._n, self._n_z = description.n_states, description.event_indicators
        self._x = np.empty(self._n)
        self._x_memory = pointer(self._x)

    def _bind(self, calls: Calls, interface_type: InterfaceType) -> None:
        self.enter_configuration_mode, self.exit_configuration_mode = (
            calls.enter_configuration_mode,
            calls.exit_configuration_mode,
        )
        self.enter_event_mode, self.update_discrete_states = (
            calls.enter_event_mode,
            calls.update_discrete_states,
        )
        if interface_type == "me":
            self._bind_model_exchange(calls)
        else:
            self.enter_step_mode, self.do_step = calls.enter_step_mode, calls.do_step

    def _bind_model_exchange(self, calls: Calls) -> None:
        call, vector = self._library.call, (c_void_p, c_size_t)
        self.enter_continuous_time_mode, self._set_time = (
            calls.enter_continuous_time_mode,
            call("SetTime", c_double),
        )
        self.completed_integrator_step = calls.completed_integrator_step
        self._set_states, self._get_states = (
            call("SetContinuousStates", *vector),
            call("GetContinuousStates", *vector),
        )
        self._get_derivatives, self._get_nominals = (
            call(calls.derivatives, *vector),
            call(calls.nominals, *vector),
        )
        self._get_indicators = call("GetEventIndicators", *vector)

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough, as the file says."""
        return self.description.interface

    # --- modes ---

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self._running = False
        self._calls.reset()

    def enter_initialization_mode(self, t: float) -> None:
        """Start at ``t`` [s]."""
        self.messages.clock.value = t
        self._calls.enter_initialization_mode(t)

    def exit_initialization_mode(self) -> None:
        """End the initialization."""
        self._calls.exit_initialization_mode()
        self._running = True

    def terminate(self) -> None:
        """End the run; the standard forbids the call before its start and after an error."""
        if self._running and not self._library.failed and not self._freed:
            self._running = False
            self._calls.terminate()

    def free_instance(self) -> None:
        """Free the instance and unload the library; once."""
        if not self._freed:
            self._freed = True
            for state in self._states:
                with suppress(RunError):  # what cannot be freed does not keep the rest
                    self._calls.free_state(byref(state))
            self._calls.free()
            self._library.unload()
            ALONE.discard(self._about.key)

    def set_time(self, t: float) -> None:
        """Move to ``t`` [s], in model exchange."""
        self.messages.clock.value = t
        self._set_time(t)

    # --- values ---

    def set_float64(self, references: ReferenceMap, values: Vector) -> None:
        """Set variables; the values of integers and Booleans must be such."""
        if references.all_float64:
            self._calls.access("Set", references.groups[0], values)
            return
        for group in references.groups:
            own = to_own(
                self._library.name,
                group.type,
                self._calls.dtypes[group.type],
                values[group.columns],
            )
            self._calls.access("Set", group, own)

    def get_float64(self, references: ReferenceMap) -> Vector:
        """Get variables as a new vector."""
        values = np.empty(references.size)
        if references.all_float64:
            self._calls.access("Get", references.groups[0], values)
            return values
        for group in references.groups:
            own = np.empty(len(group.columns), self._calls.dtypes[group.type])
            self._calls.access("Get", group, own)
            values[group.columns] = from_own(self._library.name, own)
        return values

    def set_continuous_states(self, x: Vector) -> None:
        """Set the states, shape (n_x,)."""
        self._x[:] = x  # solvers hand over strided views
        self._set_states(self._x_memory, self._n)

    def get_continuous_states(self) -> Vector:
        """Give the states, shape (n_x,)."""
        x = np.empty(self._n)
        self._get_states(pointer(x), self._n)
        return x

    def get_derivatives(self) -> Vector:
        """Give x', shape (n_x,)."""
        dx = np.empty(self._n)
        self._get_derivatives(pointer(dx), self._n)
        return dx

    def get_directional_derivative(
        self, unknowns: ReferenceMap, knowns: ReferenceMap, seed: Vector
    ) -> Vector:
        """Give d(unknowns)/d(knowns) . seed, for Float64 variables."""
        result = np.empty(unknowns.size)
        self._calls.directional_derivative(unknowns.ungrouped, knowns.ungrouped, seed, result)
        return result

    def get_event_indicators(self) -> Vector:
        """Give the event indicators as a new vector."""
        z = np.empty(self._n_z)
        self._get_indicators(pointer(z), self._n_z)
        return z

    def get_nominals(self) -> Vector:
        """Give the nominal values of the states, shape (n_x,)."""
        nominals = np.empty(self._n)
        self._get_nominals(pointer(nominals), self._n)
        return nominals

    def set_input_derivatives(self, references: ReferenceMap, slopes: Vector) -> None:
        """Set du/dt for the next step, of Float64 variables."""
        self._calls.set_input_derivatives(references.ungrouped, slopes)

    # --- texts ---

    def set_text(self, variable: Variable, values: tuple[str, ...]) -> None:
        """Set a String; a Binary is given in hexadecimal.

        Raises
        ------
        RunError
            If there are more or fewer than the variable has elements, or one cannot be handed over.
        """
        if len(values) != variable.size:
            raise RunError(
                f"{self._library.name}: {variable.name}: found {len(values)} texts, needed {variable.size}"
            )
        try:
            raw = [
                bytes.fromhex(text) if variable.type == "Binary" else _string(text)
                for text in values
            ]
        except ValueError as error:
            raise RunError(
                f"{self._library.name}: {variable.name}: {values} cannot be set: {error}"
            ) from error
        self._calls.set_text(variable, raw)

    def get_text(self, variable: Variable) -> tuple[str, ...]:
        """Get a String, or a Binary in hexadecimal."""
        raw = self._calls.get_text(variable)
        return tuple(
            data.hex() if variable.type == "Binary" else data.decode("utf-8", "replace")
            for data in raw
        )

    # --- states ---

    def get_fmu_state(self, into: object | None = None) -> object:
        """Copy the whole state, into the memory of an earlier copy if one is given, or was let go of."""
        state: Any = into if into is not None else self._spare.pop() if self._spare else c_void_p()
        self._calls.get_state(byref(state))
        if state not in self._states:  # pointers are equal to themselves alone
            self._states.append(state)
        return state

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state."""
        self._calls.set_state(state)

    def free_fmu_state(self, state: object) -> None:
        """Let go of a copied state: its memory is kept for the next copy, within a limit."""
        mine = next((known for known in self._states if known is state), None)
        if mine is None or self._freed or any(known is state for known in self._spare):
            return
        if len(self._spare) < SPARE:
            self._spare.append(mine)
        elif not self._library.over:
            self._states = [known for known in self._states if known is not mine]
            self._calls.free_state(byref(mine))


@contextmanager
def _alone(about: InstanceSpecification, label: str) -> Iterator[None]:
    """Refuse a second instance of an FMU that can be instantiated only once per process."""
    if not about.capabilities.once_per_process:
        yield
        return
    if about.key in ALONE:
        raise FmuError(
            f"{label}: can be instantiated only once per process (canBeInstantiatedOnlyOncePerProcess), and there is an instance "
            "already; close that one before"
        )
    ALONE.add(about.key)
    try:
        yield
    except BaseException:
        ALONE.discard(about.key)
        raise


@contextmanager
def _loaded(binary: Path, about: InstanceSpecification, label: str) -> Iterator[Calls]:
    """Load a binary and give its calls; after a failure it is unloaded."""
    prefix, version = VERSIONS[about.description.version[0]]
    library = Library(
        binary, prefix.format(identifier=about.capabilities.identifier), label, about.messages
    )
    try:
        yield version(library, about)
    except BaseException:
        library.unload()
        raise


def _string(text: str) -> bytes:
    if "\0" in text:
        raise ValueError("a String ends at its first character 0")
    return text.encode()


def to_own(name: str, kind: str, dtype: DTypeLike, values: Vector) -> NDArray[Any]:
    """Convert to a type of the FMU; to integers and Booleans exactly or not at all.

    Raises
    ------
    RunError
        If a value is no number of that type, or an integer beyond 2**53.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # what does not fit is found below
        own = values.astype(dtype)
    if kind in ("Float32", "Float64"):
        return own
    exact = (own == values) & (np.abs(values) <= LARGEST_EXACT)
    if not exact.all() or (kind == "Boolean" and not np.isin(values, (0.0, 1.0)).all()):
        raise RunError(f"{name}: {values.tolist()} cannot be set: needed numbers of type {kind}")
    return own


def from_own(name: str, own: NDArray[Any]) -> Vector:
    """Convert from a type of the FMU, exactly.

    Raises
    ------
    RunError
        If an integer is too large for that.
    """
    if own.dtype.kind in "iu" and ((own > LARGEST_EXACT) | (own < -LARGEST_EXACT)).any():
        raise RunError(f"{name}: an integer beyond 2**53 cannot be carried exactly: {own.tolist()}")
    return own.astype(np.float64)
