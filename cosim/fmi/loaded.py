"""An .fmu behind the unit calls, whatever its version and kind."""

from __future__ import annotations

from ctypes import byref, c_double, c_size_t, c_void_p
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.arrays import Vector
from cosim.core.signals import Interface
from cosim.core.solver import LinearModel
from cosim.errors import RunError
from cosim.fmi.binding import Library, Messages, bind, instantiate, pointer
from cosim.fmi.description import LARGEST_EXACT, Description, Mode
from cosim.fmi.references import References
from cosim.fmi.unit import DiscreteStates, StepEnd


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
        self.messages = Messages()
        binding, prefix = instantiate(folder, library, description, mode=mode, name=name, label=label, messages=self.messages)
        self._library = Library(binding, prefix, label, self.messages)
        self._freed = False
        self._states: list[c_void_p] = []
        self._calls = bind(self._library, description, mode)
        self._n = description.n_states
        self._x = np.empty(self._n)
        self._x_memory = pointer(self._x)
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
        if self._running and not self._library.failed and not self._freed:
            self._running = False
            self._terminate()

    def free_instance(self) -> None:
        """Free the instance and unload the library; once."""
        if not self._freed:
            for state in tuple(self._states):
                self.free_fmu_state(state)
            self._freed = True
            self._library.free()

    # --- values ---

    def set_float64(self, references: References, values: Vector) -> None:
        """Set variables; the values of integers and Booleans must be such."""
        if references.plain:
            self._calls.access("Set", references.groups[0], values)
            return
        for group in references.groups:
            own = to_own(self._library.name, group.type, self._calls.dtypes[group.type], values[group.columns])
            self._calls.access("Set", group, own)

    def get_float64(self, references: References) -> Vector:
        """Get variables as a new vector."""
        values = np.empty(references.size)
        if references.plain:
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

    def get_directional_derivative(self, unknowns: References, knowns: References, seed: Vector) -> Vector:
        """Give d(unknowns)/d(knowns) . seed, for Float64 variables."""
        result = np.empty(unknowns.size)
        self._calls.directional_derivative(unknowns.groups[0], knowns.groups[0], seed, result)
        return result

    # --- co-simulation ---

    def set_input_derivatives(self, references: References, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        self._calls.set_input_derivatives(references.groups[0], slopes)

    def do_step(self, t: float, h: float) -> StepEnd:
        """Advance from ``t`` by ``h`` seconds."""
        return self._calls.do_step(t, h)

    # --- states ---

    def get_fmu_state(self) -> object:
        """Copy the whole state."""
        state = c_void_p()
        self._get_state(byref(state))
        self._states.append(state)
        return state

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state."""
        self._set_state(state)

    def free_fmu_state(self, state: object) -> None:
        """Let go of a copied state; nothing to do once the instance is gone."""
        mine = next((i for i, known in enumerate(self._states) if known is state), None)
        if mine is not None:
            known = self._states.pop(mine)
            if not self._library.lost:
                self._free_state(byref(known))


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
