"""The exact solver of a linear model, also in compiled steps.

A step changes the state only. The instance gets time, states and inputs at the end of a block, and
after compiled steps by ``take_over``.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design
from cosim.core.linear import Linear, LinearModel
from cosim.fmi.driving.integrator import Integrator
from cosim.fmi.instance import ModelExchangeInstance
from cosim.native.fmi.exact import ExactStruct
from cosim.native.library import address, int32, pointer
from cosim.native.step import NativeStep


@final
class ExactSolver:
    """Advances a linear model, and sets time, states and inputs in its instance.

    Parameters
    ----------
    model : LinearModel
    instance : ModelExchangeInstance
        Of this model.
    integrator : Integrator
        Handles its events; time, states and inputs are written to its state.
    """

    def __init__(
        self, model: LinearModel, instance: ModelExchangeInstance, integrator: Integrator
    ) -> None:
        self._linear = Linear(model)
        self._instance = instance
        self._integrator = integrator
        self._native: NativeStep | None = None

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize, or take the recorded matrices."""
        self._native = None
        return self._linear.prepare(h, held, recorded)

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Discretize for parts of a step, or take the recorded matrices."""
        return self._linear.prepare_substeps(lengths, recorded)

    def begin(self) -> None:
        """Begin with the states of the integrator."""
        self._linear.state[:] = self._integrator.state.x

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times, over which no input changes that does so in events only; return y."""
        self._integrator.events.begin_step()
        y = self._linear.advance(t, h, u)
        # Inputs that change in events only keep their value to the end of the step.
        end_inputs = u[-1].copy()
        in_events = self._integrator.event_inputs
        end_inputs[in_events] = u[0, in_events]
        self._accept(float(t[-1]), end_inputs)
        return y

    def _accept(self, t: float, end_inputs: Vector) -> None:
        """Accept the last step, which ended at ``t`` with these inputs."""
        state = self._integrator.state
        state.t = t
        state.x = self._linear.state.copy()
        # All arguments are set before the step is accepted (FMI 2.0.4 section 3.2.2).
        self._instance.set_time(state.t)
        self._instance.set_continuous_states(state.x)
        self._integrator.set_continuous_inputs(end_inputs)
        self._instance.completed_integrator_step()
        state.inputs = end_inputs

    # --- compiled steps ---

    def native(self) -> NativeStep:
        """Return the compiled step, which is allowed after ``hand_over``."""
        linear = self._linear.native()
        events = int32(self._integrator.event_inputs)
        inputs = np.zeros(self._linear.interface.n_u)
        struct = ExactStruct(linear.state, n_events=len(events))
        struct.events = pointer(events)
        struct.inputs = pointer(inputs)
        self._struct = struct
        self._inputs: NDArray[np.float64] = inputs
        self._native = NativeStep(
            address("cosim_exact_step"),
            struct,
            n_y=linear.n_y,
            memory=linear.memory,
            keep=(linear, events, inputs),
            outputs=address("cosim_exact_outputs"),
        )
        return self._native

    def take_over(self) -> None:
        """Bring instance and integrator to where compiled steps have got to; allow none."""
        if self._native is None:
            return
        self._struct.allowed = 0
        if self._struct.moved:
            self._struct.moved = 0
            self._accept(self._struct.t, self._inputs.copy())

    def hand_over(self) -> None:
        """Allow compiled steps from where the integrator is."""
        if self._native is None:
            return
        state = self._integrator.state
        self._inputs[:] = state.inputs
        self._struct.t = state.t
        self._struct.allowed = int(not (state.ended or state.due))
