"""A model of ours behind the FMI calls for model exchange; enforces the standard's call order.

::

    instantiated --enter_initialization_mode--> initialization --exit_initialization_mode--> event
    event --enter_continuous_time_mode--> continuous --enter_event_mode--> event
    event, continuous --terminate--> terminated
    any --reset--> instantiated;  any --free_instance--> freed

(FMI 2.0.4 section 3.2.3, FMI 3.0 section 3.2.1.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, Literal, NamedTuple, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.core.contracts import Model
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface
from cosim.errors import FmuError
from cosim.fmi.describing import describe, states_of_outputs
from cosim.fmi.description import Capabilities, Description
from cosim.fmi.instance import DiscreteStates
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable
from cosim.native.numerics.linear import affine

Mode: TypeAlias = Literal[
    "instantiated", "initialization", "event", "continuous", "terminated", "freed"
]

RUNNING: Final = ("event", "continuous")
READABLE: Final = ("initialization", "event", "continuous", "terminated")
ALLOWED: Final[Mapping[str, tuple[str, ...]]] = {
    "setup_experiment": ("instantiated",),
    "enter_initialization_mode": ("instantiated",),
    "exit_initialization_mode": ("initialization",),
    "enter_event_mode": RUNNING,
    "update_discrete_states": ("event",),
    "enter_continuous_time_mode": ("event",),
    "set_time": RUNNING,
    "set_continuous_states": ("continuous",),
    "get_continuous_states": READABLE,
    "get_derivatives": READABLE,
    "completed_integrator_step": ("continuous",),
    "set_float64": ("instantiated", "initialization", *RUNNING),
    "get_float64": ("instantiated", *READABLE),
    "get_directional_derivative": READABLE,
    "get_fmu_state": ("instantiated", *READABLE),
    "set_fmu_state": ("instantiated", *READABLE),
    "free_fmu_state": ("instantiated", *READABLE, "freed"),
    "terminate": RUNNING,
    "reset": ("instantiated", *READABLE),
    "free_instance": ("instantiated", *READABLE, "freed"),
}


@final
class GeneratedInstance:
    """A model as an instance for model exchange.

    Parameters
    ----------
    model : Model
        Nothing but its contract is used.
    name : str
        Stands in messages and in the description.
    linear : LinearModel or None
        The same model, where it is linear: it then has directional derivatives, which are exact,
        and can be solved exactly.
    """

    def __init__(
        self, model: Model, name: str = "model", *, linear: LinearModel | None = None
    ) -> None:
        self._model = model
        self._linear = linear
        self._name = name
        self._description = _describe(model, name, linear)
        self._n = len(model.states)
        self._m = model.interface.n_u
        self._p = model.interface.n_y
        self._state_of = states_of_outputs(linear) if linear else [-1] * self._p
        self._mode: Mode = "instantiated"
        self.may_go_back = False
        self._set_defaults()

    @staticmethod
    def of(model: LinearModel, name: str = "model") -> GeneratedInstance:
        """Build the instance of a linear model."""
        return GeneratedInstance(model, name, linear=model)

    @property
    def description(self) -> Description:
        """Variables and structure, as the export writes them."""
        return self._description

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough: those of the model."""
        return self._model.interface

    @property
    def linear(self) -> LinearModel | None:
        """The model, where it is linear; assigning one of the same shape replaces its numbers."""
        return self._linear

    @linear.setter
    def linear(self, model: LinearModel | None) -> None:
        assert model is not None  # numbers are replaced, never removed
        self._model = model
        self._linear = model
        self._stale = True

    def _set_defaults(self) -> None:
        self._t = 0.0
        self._x = np.zeros(self._n)
        self._u = np.zeros(self._m)
        self._starts: dict[int, float] = {}  # start values that were set, by state
        self._values = np.zeros(self._m + self._p + 2 * self._n)
        self._stale = True

    def _require(self, call: str) -> None:
        modes = ALLOWED[call]
        if self._mode not in modes:
            raise FmuError(
                f"{self._name}: {call} is not allowed in mode {self._mode!r}; "
                f"allowed in: {', '.join(modes)}"
            )

    def addresses(self) -> None:
        """Return None: nothing was loaded."""

    def clock_calls(self) -> None:
        """Return None: it has no clocks."""

    # --- modes ---

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self._require("reset")
        self._mode = "instantiated"
        self._set_defaults()

    def setup_experiment(self, t: float) -> None:
        """Take the start time ``t`` [s]."""
        self._require("setup_experiment")
        self._t = t
        self._stale = True

    def enter_initialization_mode(self) -> None:
        """Begin the initialization at the start time."""
        self._require("enter_initialization_mode")
        self._mode = "initialization"

    def exit_initialization_mode(self) -> None:
        """End the initialization."""
        self._require("exit_initialization_mode")
        self._update()
        self._mode = "event"

    def enter_event_mode(self) -> None:
        """Enter event mode, for discrete changes."""
        self._require("enter_event_mode")
        self._mode = "event"

    def update_discrete_states(self) -> DiscreteStates:
        """Do one event iteration: a model without memory has no discrete states."""
        self._require("update_discrete_states")
        return DiscreteStates(need_update=False, terminate=False, next_event_time=None)

    def enter_continuous_time_mode(self) -> None:
        """Enter continuous-time mode."""
        self._require("enter_continuous_time_mode")
        self._mode = "continuous"

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Accept the step: neither an event nor the end."""
        self._require("completed_integrator_step")
        return False, False

    def terminate(self) -> None:
        """End the run."""
        self._require("terminate")
        self._mode = "terminated"

    def free_instance(self) -> None:
        """Free the instance."""
        self._require("free_instance")
        self._mode = "freed"

    # --- values ---

    def set_time(self, t: float) -> None:
        """Set the time [s]."""
        self._require("set_time")
        self._t = t
        self._stale = True

    def set_continuous_states(self, x: Vector) -> None:
        """Set the states, shape (n_x,)."""
        self._require("set_continuous_states")
        self._x = x.copy()
        self._stale = True

    def get_continuous_states(self) -> Vector:
        """Return the states, shape (n_x,)."""
        self._require("get_continuous_states")
        self._update_states()
        return self._x.copy()

    def get_derivatives(self) -> Vector:
        """Return x', shape (n_x,)."""
        self._require("get_derivatives")
        self._update_states()
        return self._model.derivatives(self._t, self._x, self._u)

    def set_float64(self, references: ReferenceMap, values: Vector) -> None:
        """Set inputs; before the run also start values of states that do not depend on inputs."""
        self._require("set_float64")
        for group in references.groups:
            numbers = values[group.columns].tolist()
            for reference, number in zip(group.references.tolist(), numbers, strict=True):
                if reference < self._m:
                    self._u[reference] = number
                else:
                    self._set_start(reference, number)
        self._stale = True

    def _set_start(self, reference: int, value: float) -> None:
        variable = next(v for v in self._description.variables if v.reference == reference)
        if not (variable.settable and self._is_before_run):
            raise FmuError(f"{self._name}: {variable.name!r} cannot be set in mode {self._mode!r}")
        self._starts[self._state(reference)] = value

    @property
    def _is_before_run(self) -> bool:
        return self._mode in ("instantiated", "initialization")

    def _state(self, reference: int) -> int:
        """Return the state behind the reference of an output or of a state; -1: none."""
        index = reference - self._m
        if index < self._p:
            return self._state_of[index]
        return index - self._p - self._n

    def get_float64(self, references: ReferenceMap) -> Vector:
        """Return variables as a new vector."""
        self._require("get_float64")
        self._update()
        values = np.empty(references.size)
        for group in references.groups:
            values[group.columns] = self._values[group.references]
        return values

    def _update_states(self) -> None:
        if self._stale and self._is_before_run:
            self._x = self._model.initial(self._t, self._u)
            for state, value in self._starts.items():
                self._x[state] = value

    def _update(self) -> None:
        """Bring every value up to date: u, y, x', x."""
        if not self._stale:
            return
        self._update_states()
        first_output = self._m
        first_derivative = first_output + self._p
        first_state = first_derivative + self._n
        values = self._values
        values[:first_output] = self._u
        values[first_output:first_derivative] = self._model.outputs(self._t, self._x, self._u)
        values[first_derivative:first_state] = self._model.derivatives(self._t, self._x, self._u)
        values[first_state:] = self._x
        self._stale = False

    def get_event_indicators(self) -> Vector:
        """Return none: a model without memory has no events of its own."""
        return np.zeros(0)

    def get_nominals(self) -> Vector:
        """Return the nominal values of the states, shape (n_x,): nothing is known of them."""
        return np.ones(self._n)

    # --- what a model of ours does not have ---

    def enter_configuration_mode(self) -> None:
        """Raise an error: there are no structural parameters."""
        raise FmuError(f"{self._name}: a model has no structural parameters")

    def exit_configuration_mode(self) -> None:
        """Raise an error: there are no structural parameters."""
        self.enter_configuration_mode()

    def set_text(self, variable: Variable, values: tuple[str, ...]) -> None:
        """Raise an error: there are no texts."""
        raise FmuError(f"{self._name}: a model has no strings")

    def get_text(self, variable: Variable) -> tuple[str, ...]:
        """Return none."""
        return ()

    # --- directional derivatives and states ---

    def get_directional_derivative(
        self, unknowns: ReferenceMap, knowns: ReferenceMap, seed: Vector
    ) -> Vector:
        """Return d(unknowns)/d(knowns) . seed from the matrices (FMI 2.0.4 section 2.1.9).

        Raises
        ------
        FmuError
            If the model is not linear, or a variable is neither known nor unknown.
        """
        self._require("get_directional_derivative")
        if self._linear is None:
            raise FmuError(f"{self._name}: no directional derivatives; the model is not linear")
        columns = [self._known(reference) for reference in knowns.ungrouped.references.tolist()]
        rows = [self._unknown(reference) for reference in unknowns.ungrouped.references.tolist()]
        jacobian = self._jacobian(self._linear)
        return affine([(jacobian[rows][:, columns], seed)])

    def _jacobian(self, model: LinearModel) -> NDArray[np.float64]:
        """Return d(y, x', x)/d(u, x); in initialization mode x follows the inputs by Xu."""
        by_x = np.vstack([model.C, model.A, np.eye(self._n)])
        no_feedthrough = np.zeros((self._n, self._m))
        by_u = np.vstack([model.D, model.B, no_feedthrough])
        if self._mode == "initialization":
            # neither BLAS nor einsum, which fuse products and sums on some processors
            products = by_x[:, :, np.newaxis] * model.Xu
            by_u = by_u + products.sum(axis=1)
        return np.hstack([by_u, by_x])

    def _known(self, reference: int) -> int:
        """Return the column of an input or a state in the Jacobian."""
        if reference < self._m:
            return reference
        first_derivative = self._m + self._p
        is_derivative = first_derivative <= reference < first_derivative + self._n
        state = -1 if is_derivative else self._state(reference)
        if state < 0:
            raise FmuError(
                f"{self._name}: the knowns of a directional derivative are inputs and states"
            )
        return self._m + state

    def _unknown(self, reference: int) -> int:
        """Return the row of an output, a derivative or a state in the Jacobian."""
        if reference < self._m:
            raise FmuError(
                f"{self._name}: the unknowns of a directional derivative are outputs, derivatives "
                "and states, not inputs"
            )
        return reference - self._m

    def get_fmu_state(self, into: object | None = None) -> object:
        """Copy the whole state; the memory of an earlier copy is of no use."""
        self._require("get_fmu_state")
        return _GeneratedState(
            self._mode, self._t, self._x.copy(), self._u.copy(), dict(self._starts)
        )

    def set_fmu_state(self, state: object) -> None:
        """Go back to a copied state."""
        self._require("set_fmu_state")
        assert isinstance(state, _GeneratedState)
        self._mode = state.mode
        self._t = state.t
        self._x = state.x.copy()
        self._u = state.u.copy()
        self._starts = dict(state.starts)
        self._stale = True

    def free_fmu_state(self, state: object) -> None:
        """Do nothing: a copy holds nothing that must be freed."""

    def mark_messages(self) -> object:
        """Return nothing: there are no messages."""
        return None

    def forget_messages(self, mark: object, *, of_calls: bool = True) -> None:
        """Do nothing: there are no messages."""


class _GeneratedState(NamedTuple):
    """A copy of an instance's state."""

    mode: Mode
    t: float
    x: Vector
    u: Vector
    starts: Mapping[int, float]


def _describe(model: Model, name: str, linear: LinearModel | None) -> Description:
    capabilities = Capabilities(
        name, directional_derivatives=linear is not None, saves_state=True, completed_step=False
    )
    description = describe(model, name, linear)
    return replace(description, capabilities={"me": capabilities})
