"""A loaded FMU behind the calls of the protocol, whatever its version and interface type."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from ctypes import byref, c_double, c_size_t, c_void_p
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface
from cosim.errors import RunError
from cosim.fmi.binary.addresses import InstanceAddresses
from cosim.fmi.binary.binding import Calls, InstanceSpecification
from cosim.fmi.binary.fmi1 import Fmi1
from cosim.fmi.binary.fmi2 import Fmi2
from cosim.fmi.binary.fmi3 import Fmi3
from cosim.fmi.binary.library import Library, MessageMark, pointer
from cosim.fmi.binary.messages import Message, Messages
from cosim.fmi.description import Description, InterfaceType
from cosim.fmi.instance import ClockCalls
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable

VERSIONS: Final[Mapping[str, tuple[str, type[Fmi1] | type[Fmi2] | type[Fmi3]]]] = {
    "1": ("{identifier}_fmi", Fmi1),
    "2": ("fmi2", Fmi2),
    "3": ("fmi3", Fmi3),
}
"""By the first digit of the FMI version: the prefix of its functions, and what binds them."""

SPARE_STATES: Final = 4  # how many released FMU states are kept for the next copies


@final
class LoadedInstance:
    """One instance of an FMU: every call of the interface type that it was instantiated for.

    Parameters
    ----------
    folder : Path
        Where the archive was unpacked.
    library : Path
        The binary for this machine.
    description : Description
    interface_type : {"me", "cs"}
    name : str
        Name of the instance.
    label : str
        Names the FMU in messages.
    messages : Messages
        Takes what the FMU logs.

    Attributes
    ----------
    refused : str
        That it was instantiated without the event mode that it declares; empty: it was not.

    Raises
    ------
    FmuError
        If the library cannot be loaded or refuses to instantiate.
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
        messages: Messages,
    ) -> None:
        self.description = description
        self.messages = messages
        self.refused = ""
        self.interface_type = interface_type
        specification = InstanceSpecification(
            description, interface_type, name, folder, self.messages
        )
        with _opened_library(library, specification, label) as calls:
            self._library = calls.library
            self._instantiate(calls, interface_type)
            if not calls.library.instance and specification.capabilities.event_mode:
                self.refused = (
                    f"{description.name}: refuses to be instantiated with event mode, which it "
                    f"declares (hasEventMode); it runs without{messages.last_as_suffix}"
                )
                self.description = description.without("event_mode", interface_type)
                specification = replace(specification, description=self.description)
                _, bind = VERSIONS[description.version[0]]
                self._instantiate(bind(calls.library, specification), interface_type)
            if not calls.library.instance:
                raise calls.library.load_error("it refuses to instantiate")
        self._freed = False
        self._running = False
        self._states: list[c_void_p] = []  # all that the FMU allocated
        self._spare_states: list[c_void_p] = []  # the released ones of them
        self._lost_states: list[c_void_p] = []  # of an instance that was replaced
        self._n_states = description.n_states
        self._n_indicators = description.event_indicators
        self._x = np.empty(self._n_states)
        self._x_pointer = pointer(self._x)
        self._derivatives = np.empty(self._n_states)
        self._derivatives_pointer = pointer(self._derivatives)

    def _instantiate(self, calls: Calls, interface_type: InterfaceType) -> None:
        self._calls = calls
        # Before there is an instance: a function that is missing leaves none behind.
        self._bind(calls, interface_type)
        calls.instantiate()

    def _bind(self, calls: Calls, interface_type: InterfaceType) -> None:
        self.enter_configuration_mode = calls.enter_configuration_mode
        self.exit_configuration_mode = calls.exit_configuration_mode
        self.enter_event_mode = calls.enter_event_mode
        self.update_discrete_states = calls.update_discrete_states
        if interface_type == "me":
            self._bind_model_exchange(calls)
        else:
            self.enter_step_mode = calls.enter_step_mode
            self.do_step = calls.do_step
            self.end_of_step = calls.end_of_step

    def _bind_model_exchange(self, calls: Calls) -> None:
        call = self._library.call
        vector = (c_void_p, c_size_t)
        self.enter_continuous_time_mode = calls.enter_continuous_time_mode
        self.completed_integrator_step = calls.completed_integrator_step
        self._set_time = call("SetTime", c_double)
        self._set_states = call("SetContinuousStates", *vector)
        self._get_states = call("GetContinuousStates", *vector)
        functions = calls.functions
        derivatives = "GetContinuousStateDerivatives"
        nominals = "GetNominalsOfContinuousStates"
        self._get_derivatives = call(functions.get(derivatives, derivatives), *vector)
        self._get_nominals = call(functions.get(nominals, nominals), *vector)
        self._get_indicators = call("GetEventIndicators", *vector)

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough, from the description."""
        return self.description.interface

    def drain(self) -> list[Message]:
        """Return the FMU's messages since the last call, and what it returned as a warning."""
        return self._library.drain()

    def mark_messages(self) -> object:
        """Return what the messages up to now are known by."""
        return self._library.mark_messages()

    def forget_messages(self, mark: object, *, of_calls: bool = True) -> None:
        """Forget the messages that came behind a mark, and were not fetched yet.

        ``of_calls``: also what functions returned as a warning or an error since then.
        """
        assert isinstance(mark, MessageMark)
        self._library.forget_messages(mark, of_calls=of_calls)

    def addresses(self) -> InstanceAddresses | None:
        """Return where compiled code finds the instance, its functions and its variables.

        None: it has ports that are negated, which compiled code does not know.
        """
        ports = [self.description.references(name) for name in ("input", "output")]
        if any(references.opposite is not None for references in ports):
            return None
        return InstanceAddresses(self._calls)

    def clock_calls(self) -> ClockCalls | None:
        """Return the calls for clocks; None: nothing activates its clocks, or it has none."""
        return self._calls.clocks

    # --- modes ---

    def reset(self) -> None:
        """Go back to the state after instantiation: by a new instance, where nothing is lost.

        Many an FMU forgets too little in its own reset, or crashes later. It is called where there
        are copied states, which a new instance would not take, or may be no second instance.
        """
        single = self.description.capabilities[self.interface_type].once_per_process
        if self._states or single or self._calls.version == 1:  # it does the same for FMI 1
            self._running = False
            self._calls.reset()
            return
        with suppress(RunError):  # an instance that cannot terminate is freed all the same
            self.terminate()
        self.renew()

    def renew(self) -> None:
        """Replace the instance by a new one; FMU states of the old one are lost.

        Raises
        ------
        RunError
            If no call is allowed any more, or the FMU refuses.
        """
        self._library.check_allowed("be instantiated again")
        self._running = False
        self._free_states()
        self._lost_states += self._states
        self._states = []
        self._spare_states = []
        self._calls.free()
        self._library.failed = False
        self._calls.instantiate()
        self._library.check_renewed()

    def setup_experiment(self, t: float) -> None:
        """Take the start time ``t`` [s]; start values are set after it."""
        self.messages.clock.value = t
        self._calls.setup_experiment(t)

    def enter_initialization_mode(self) -> None:
        """Enter it, at the start time."""
        self._calls.enter_initialization_mode()

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
            self._free_states()
            self._calls.free()
            self._library.unload()

    def _free_states(self) -> None:
        for state in self._states:
            with suppress(RunError):  # one that cannot be freed does not keep the rest
                self._calls.free_state(byref(state))

    def set_time(self, t: float) -> None:
        """Set the time [s], in model exchange."""
        self.messages.clock.value = t
        self._set_time(t)

    # --- values ---

    def set_float64(self, references: ReferenceMap, values: Vector) -> None:
        """Set variables; integers and Booleans need values that are exactly such."""
        values = references.negated(values)
        if references.all_float64:
            self._calls.access("Set", references.groups[0], values)
            return
        for group in references.groups:
            dtype = self._calls.dtypes[group.type]
            columns = values[group.columns]
            converted = to_fmu_type(self._library.name, group.type, dtype, columns)
            self._calls.access("Set", group, converted)

    def get_float64(self, references: ReferenceMap) -> Vector:
        """Get variables as a new vector."""
        values = np.empty(references.size)
        if references.all_float64:
            self._calls.access("Get", references.groups[0], values)
            return references.negated(values)
        for group in references.groups:
            received = np.empty(len(group.columns), self._calls.dtypes[group.type])
            self._calls.access("Get", group, received)
            values[group.columns] = from_fmu_type(self._library.name, received)
        return references.negated(values)

    def set_continuous_states(self, x: Vector) -> None:
        """Set the states, shape (n_x,)."""
        self._x[:] = x  # solvers hand over strided views
        self._set_states(self._x_pointer, self._n_states)

    def get_continuous_states(self) -> Vector:
        """Return the states, shape (n_x,)."""
        x = np.empty(self._n_states)
        self._get_states(pointer(x), self._n_states)
        return x

    def get_derivatives(self) -> Vector:
        """Return x', shape (n_x,)."""
        self._get_derivatives(self._derivatives_pointer, self._n_states)
        return self._derivatives.copy()

    def get_directional_derivative(
        self, unknowns: ReferenceMap, knowns: ReferenceMap, seed: Vector
    ) -> Vector:
        """Return d(unknowns)/d(knowns) . seed, for Float64 variables."""
        result = np.empty(unknowns.size)
        self._calls.directional_derivative(unknowns.ungrouped, knowns.ungrouped, seed, result)
        return result

    def get_event_indicators(self) -> Vector:
        """Return the event indicators as a new vector."""
        indicators = np.empty(self._n_indicators)
        self._get_indicators(pointer(indicators), self._n_indicators)
        return indicators

    def get_nominals(self) -> Vector:
        """Return the nominal values of the states, shape (n_x,)."""
        nominals = np.empty(self._n_states)
        self._get_nominals(pointer(nominals), self._n_states)
        return nominals

    def set_input_derivatives(self, references: ReferenceMap, slopes: Vector) -> None:
        """Set du/dt for the next step, of Float64 variables."""
        self._calls.set_input_derivatives(references.ungrouped, references.negated(slopes))

    # --- texts ---

    def set_text(self, variable: Variable, values: tuple[str, ...]) -> None:
        """Set a String; a Binary is given in hexadecimal.

        Raises
        ------
        RunError
            If there are more or fewer than the variable has elements, or one cannot be passed on.
        """
        label = f"{self._library.name}: {variable.name}"
        if len(values) != variable.size:
            raise RunError(f"{label}: expected {variable.size} string(s), got {len(values)}")
        encode = bytes.fromhex if variable.type == "Binary" else _encode_string
        try:
            encoded = [encode(text) for text in values]
        except ValueError as error:
            raise RunError(f"{label}: {values} cannot be set: {error}") from error
        self._calls.set_text(variable, encoded)

    def get_text(self, variable: Variable) -> tuple[str, ...]:
        """Get a String, or a Binary in hexadecimal."""
        received = self._calls.get_text(variable)
        if variable.type == "Binary":
            return tuple(data.hex() for data in received)
        return tuple(data.decode("utf-8", "replace") for data in received)

    # --- states ---

    @property
    def may_go_back(self) -> bool:
        """Whether a state of an earlier time may be restored."""
        return self._library.may_go_back

    @may_go_back.setter
    def may_go_back(self, possible: bool) -> None:
        self._library.may_go_back = possible

    def get_fmu_state(self, into: object | None = None) -> object:
        """Copy the FMU state, into the memory of an earlier copy if one is given or released."""
        state: Any = into
        if state is None:
            state = self._spare_states.pop() if self._spare_states else c_void_p()
        self._calls.get_state(byref(state))
        if state not in self._states:  # a c_void_p is equal to itself only
            self._states.append(state)
        return state

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state.

        Raises
        ------
        RunError
            If the instance that it was copied from was replaced.
        """
        if any(lost is state for lost in self._lost_states):
            raise RunError(
                f"{self._library.name}: a saved state was lost, as the instance that it was saved "
                "of was replaced by a new one"
            )
        self._calls.set_state(state)

    def free_fmu_state(self, state: object) -> None:
        """Release a copied state: its memory is kept for the next copy, within a limit."""
        own_state = next((known for known in self._states if known is state), None)
        if own_state is None or self._freed:
            return
        if any(spare is state for spare in self._spare_states):
            return
        if len(self._spare_states) < SPARE_STATES:
            self._spare_states.append(own_state)
        elif not self._library.forbids_calls:
            self._states = [known for known in self._states if known is not own_state]
            self._calls.free_state(byref(own_state))


@contextmanager
def _opened_library(
    binary: Path, specification: InstanceSpecification, label: str
) -> Iterator[Calls]:
    """Load a binary and yield its calls; after a failure it is unloaded."""
    prefix_pattern, bind = VERSIONS[specification.description.version[0]]
    prefix = prefix_pattern.format(identifier=specification.capabilities.identifier)
    version = bind.version
    library = Library(binary, prefix, label, specification.messages, version=version)
    try:
        yield bind(library, specification)
    except BaseException:
        library.unload()
        raise


def _encode_string(text: str) -> bytes:
    if "\0" in text:
        raise ValueError("a String ends at its first character 0")
    return text.encode()


def to_fmu_type(name: str, variable_type: str, dtype: DTypeLike, values: Vector) -> NDArray[Any]:
    """Convert to a type of the FMU; to integers and Booleans exactly or not at all.

    Raises
    ------
    RunError
        If a value is no number of that type.
    """
    if variable_type in ("Float32", "Float64"):
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    if variable_type == "Boolean":
        fits = np.isin(values, (0.0, 1.0))
    else:
        low, end = _range(dtype)
        fits = (low <= values) & (values < end) & (values == np.floor(values))
    if not fits.all():
        raise RunError(f"{name}: expected numbers of type {variable_type}, got {values.tolist()}")
    return values.astype(dtype)


def from_fmu_type(name: str, received: NDArray[Any]) -> Vector:
    """Convert from a type of the FMU, exactly.

    Raises
    ------
    RunError
        If an integer is no float64.
    """
    values = received.astype(np.float64)
    if received.dtype.kind in "iu" and received.dtype.itemsize == 8:
        _, end = _range(received.dtype)
        with np.errstate(invalid="ignore"):  # what is rounded up to the end of the type
            exact = (values < end) & (values.astype(received.dtype) == received)
        if not exact.all():
            raise RunError(
                f"{name}: an integer beyond 2**53 cannot be carried exactly: {received.tolist()}"
            )
    return values


def _range(dtype: DTypeLike) -> tuple[float, float]:
    """Return the smallest integer of a type, and the first one above it: both are float64."""
    limits = np.iinfo(np.dtype(dtype))
    return float(limits.min), float(limits.max) + 1.0
