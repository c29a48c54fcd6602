"""Steps of model exchange in compiled code: what ``integrator.py`` does, on the same state.

Compiled steps advance the FMU and the numbers of the integrator. ``take_over`` brings the
integrator to where they ended, at a communication point or inside a step that they declined;
``hand_over`` lets them go on from where it is.
"""

from __future__ import annotations

import ctypes
from typing import Final, final

import numpy as np

from cosim.core.clock import Standstill
from cosim.fmi.driving.events import BITS, KINDS
from cosim.fmi.driving.integrator import Integrator, IntegratorState, Interruption
from cosim.fmi.instance import Addresses, ModelExchangeInstance
from cosim.native.fmi.model_exchange import EVENT, FAILED_CALL, FAILED_INPUTS, ModelExchangeStruct
from cosim.native.library import address, int32, pointer
from cosim.native.step import NativeStep

ROOM: Final = 8192  # events that are kept until they are taken over
UPDATES: Final = {1: "EventUpdate", 2: "NewDiscreteStates", 3: "UpdateDiscreteStates"}
"""The function that iterates an event, by version."""


@final
class CompiledIntegrator:
    """The compiled step of an FMU, and the way between it and the integrator.

    Parameters
    ----------
    integrator : Integrator
        With an explicit Runge-Kutta method, or without states.
    instance : ModelExchangeInstance
    addresses : Addresses
        Of this instance.
    """

    def __init__(
        self, integrator: Integrator, instance: ModelExchangeInstance, addresses: Addresses
    ) -> None:
        description = instance.description
        self._integrator = integrator
        self._instance = instance
        self._addresses = addresses
        n_x = description.n_states
        n_z = description.event_indicators
        n_u = description.references("input").size
        self._inputs = np.zeros(n_u)
        self._indicators = np.zeros(n_z)
        self._nominals = np.ones(n_x)
        self._in_events = int32(integrator.event_inputs)
        self._step_inputs = np.zeros((2, n_u))
        self._scratch = np.zeros(2 * n_x + n_u + 4 * n_z)
        self._events = np.zeros(ROOM, EVENT)
        self._left = np.zeros(description.references("output").size)
        struct = ModelExchangeStruct(addresses.fmu, room=ROOM)
        self._struct = struct
        self._solver, self._x = integrator.compiled_solver(
            address("cosim_model_exchange_derivatives"), ctypes.addressof(struct)
        )
        struct.n_x = n_x
        struct.n_z = n_z
        struct.n_u = n_u
        struct.n_in_events = len(self._in_events)
        struct.parts = integrator.parts
        struct.longest_step = integrator.max_step
        self._point_to_memory()
        self._point_to_calls()

    def native(self) -> NativeStep:
        """Return the step, which is allowed after ``hand_over``."""
        return NativeStep(
            address("cosim_model_exchange_step"),
            self._struct,
            n_y=self._instance.description.references("output").size,
            memory=self._scratch,
            keep=(self,),
            outputs=address("cosim_model_exchange_outputs"),
            left_outputs=self._left_outputs(),
        )

    def _left_outputs(self) -> tuple[int, int] | None:
        """Return where compiled steps tell left limits; None: nobody asks for them."""
        struct = self._struct
        if not self._integrator.keeps_left:
            return None
        struct.left = pointer(self._left)
        offset = ModelExchangeStruct.has_left.offset
        return ctypes.addressof(struct) + offset, pointer(self._left)

    def _point_to_memory(self) -> None:
        struct = self._struct
        struct.x = pointer(self._x)
        struct.inputs = pointer(self._inputs)
        struct.indicators = pointer(self._indicators)
        struct.nominals = pointer(self._nominals)
        struct.in_events = pointer(self._in_events)
        struct.events = pointer(self._events)
        struct.end_inputs, struct.u = (pointer(row) for row in self._step_inputs)
        struct.scratch = pointer(self._scratch)
        if self._solver is not None:
            struct.solver = ctypes.addressof(self._solver)

    def _point_to_calls(self) -> None:
        struct = self._struct
        addresses = self._addresses
        capabilities = self._instance.description.capabilities["me"]
        references = self._instance.description.references("input")
        continuous = references.select(~self._instance.description.discrete_inputs)
        struct.input_variables = addresses.variables(references)
        struct.continuous_variables = addresses.variables(continuous)
        struct.output_variables = addresses.variables(
            self._instance.description.references("output")
        )
        struct.set_time = addresses.call("SetTime")
        struct.set_states = addresses.call("SetContinuousStates")
        struct.get_states = addresses.call("GetContinuousStates")
        struct.get_derivatives = addresses.call("GetContinuousStateDerivatives")
        struct.get_indicators = addresses.call("GetEventIndicators")
        struct.update = addresses.call(UPDATES[addresses.version])
        if capabilities.completed_step:
            struct.completed_step = addresses.call("CompletedIntegratorStep")
        if addresses.version > 1:
            struct.enter_event_mode = addresses.call("EnterEventMode")
            struct.enter_continuous_time_mode = addresses.call("EnterContinuousTimeMode")
        if capabilities.saves_state:
            struct.get_state = addresses.call("GetFMUState")
            struct.set_state = addresses.call("SetFMUState")

    def hand_over(self) -> None:
        """Allow compiled steps, from where the integrator is; none behind the end of the run."""
        struct = self._struct
        integrator = self._integrator
        state = integrator.state
        if state.ended:
            return
        self._x[:] = state.x
        self._inputs[:] = state.inputs
        self._indicators[:] = state.indicators
        self._nominals[:] = state.nominals
        struct.t = state.t
        struct.next_event = state.next_event
        struct.inputs_time = integrator.inputs_time
        struct.due = sum(BITS[kind] for kind in state.due)
        struct.ended = 0
        struct.rolls_back = int(integrator.rolls_back)
        if integrator.fmu_state is not None:
            struct.fmu_state = self._addresses.state(integrator.fmu_state)
        struct.in_step = integrator.events.in_step
        struct.first = integrator.events.first
        struct.reached = 0
        struct.failure = 0
        struct.moved = 0
        struct.allowed = 1

    def take_over(self) -> Interruption | None:
        """Bring the integrator to where compiled steps ended; none is allowed any more.

        Returns
        -------
        Interruption or None
            What the last step has left to be done; None: none was begun.
        """
        struct = self._struct
        declined = not struct.allowed
        struct.allowed = 0
        if not struct.moved:
            return None
        integrator = self._integrator
        kinds = [kind for bit, kind in KINDS.items() if struct.due & bit]
        integrator.state = IntegratorState(
            struct.t,
            self._x.copy(),
            self._inputs.copy(),
            self._indicators.copy(),
            integrator.state.nominals,
            struct.next_event,
            tuple(kinds),
            bool(struct.ended),
        )
        integrator.inputs_time = struct.inputs_time
        self.list_events()
        if struct.has_left:
            integrator.left = self._left.copy()
        nominals_changed = bool(struct.nominals_changed)
        struct.nominals_changed = 0
        struct.moved = 0
        if not declined:
            return None
        standstill = Standstill(struct.since, struct.handled)
        return Interruption(struct.reached, struct.failure, nominals_changed, standstill)

    def list_events(self) -> None:
        """Give the integrator the events since it got them last."""
        struct = self._struct
        if not struct.moved:
            return
        records = self._events[: struct.n_events].copy()
        self._integrator.events.extend(
            records, struct.in_step, first=struct.first, latest=struct.latest
        )
        struct.n_events = 0

    @property
    def first_event(self) -> float:
        """Time of the first event inside the last step [s]; infinity: there was none."""
        first: float = self._struct.first
        return first

    def begin_events(self) -> None:
        """Begin to count the events anew, as after they were fetched."""
        self._struct.in_step = 0

    def finish(self, interruption: Interruption) -> None:
        """Finish the event that a step was left in; raise what failed in it.

        Raises
        ------
        RunError
            With the words of the same step in Python.
        """
        if interruption.failure == FAILED_CALL:
            error = self._addresses.failure()
            assert error is not None
            raise error
        if interruption.failure == FAILED_INPUTS:
            # Refused here as there: the values do not fit their types.
            inputs = self._instance.description.references("input")
            self._instance.set_float64(inputs, self._integrator.state.inputs)
        if interruption.failure:
            raise self._integrator.failure(interruption)
        if interruption.nominals_changed:
            self._integrator.finish_event()
