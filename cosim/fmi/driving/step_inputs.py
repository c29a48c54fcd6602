"""The inputs of a co-simulation FMU in its steps: how they are set, and what outputs belong to.

``stepping.py`` shows which values they have in a part of a communication step.
"""

from __future__ import annotations

import math
from typing import final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import RunError
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.input_ramp import InputRamp
from cosim.fmi.instance import CoSimulationInstance, StepEnd
from cosim.fmi.references import ReferenceMap
from cosim.native.fmi.co_simulation import CoSimulationStruct
from cosim.native.memory import place


class InputDerivativesFailed(RunError):
    """The FMU does not take the slopes of its inputs, though it says that it can."""


@final
class StepInputs:
    """Sets the inputs of an FMU for calls of do_step.

    Parameters
    ----------
    instance : CoSimulationInstance
    diagnostics : Diagnostics
        Takes what the run shows about the FMU.
    references : ReferenceMap
        The inputs that are set in steps.
    struct : CoSimulationStruct
        Has whether the FMU gets slopes, where compiled steps find it.

    Attributes
    ----------
    references : ReferenceMap
    interpolated : ReferenceMap
        The inputs that the FMU can interpolate.
    can_interpolate : bool
        Whether it says that it does.
    ramped : Mask, shape (n_u,)
        The inputs that have no mean over a step where the FMU gets slopes.
    """

    def __init__(
        self,
        instance: CoSimulationInstance,
        diagnostics: Diagnostics,
        references: ReferenceMap,
        struct: CoSimulationStruct,
    ) -> None:
        description = instance.description
        self._instance = instance
        self._diagnostics = diagnostics
        self._struct = struct
        self.references = references
        self._is_interpolated = description.interpolated_inputs
        self.interpolated = description.references("input").select(self._is_interpolated)
        others = ~description.discrete_inputs & ~self._is_interpolated
        self._some_not_interpolated = bool(others.any())
        self.ramped = place(self._is_interpolated | (not self._some_not_interpolated))
        capabilities = description.capabilities["cs"]
        self.can_interpolate = capabilities.interpolates_inputs and self.interpolated.size > 0

    @property
    def interpolates(self) -> bool:
        """Whether the FMU gets slopes of its inputs."""
        return bool(self._struct.interpolates)

    def set(self, ramp: InputRamp, s0: float, mean: float) -> None:
        """Set the inputs for a call of do_step.

        Those that are interpolated have their values at ``s0``, the others those at ``mean``.

        Raises
        ------
        InputDerivativesFailed
            If the FMU refuses their slopes.
        RunError
            If it refuses their values.
        """
        if not self.interpolates:
            self._instance.set_float64(self.references, self.references.take(ramp.at(mean)))
            return
        # Values and derivatives are those at the beginning of the step (FMI 2.0.4 section 4.2.1).
        inputs = self._at(ramp, s0, mean)
        self._instance.set_float64(self.references, self.references.take(inputs))
        try:
            self._instance.set_input_derivatives(self.interpolated, self._slopes(ramp))
        except RunError as error:
            raise InputDerivativesFailed(str(error)) from error

    def applied(self, ramp: InputRamp, s0: float, s1: float, mean: float, end: StepEnd) -> Vector:
        """Return the inputs that the outputs after a call of do_step belong to.

        An FMU that has interpolated none of them gets no slopes any more.
        """
        if not self.interpolates:
            return ramp.at(mean)
        if end.interpolated_until == -math.inf and self._slopes(ramp).any():
            self._stop_interpolating(ramp.time(s0))
        s_end = s1
        if end.interpolated_until != math.inf:
            s_end = min(max(s0, ramp.fraction(end.interpolated_until)), s1)
        return self._at(ramp, s_end, mean)

    def _slopes(self, ramp: InputRamp) -> Vector:
        """Return du/dt of the inputs that are interpolated."""
        slopes: Vector = self.interpolated.take(ramp.change) / ramp.h
        return slopes

    def _at(self, ramp: InputRamp, s: float, mean: float) -> Vector:
        """Return the inputs at ``s``; those that cannot be interpolated as they are at ``mean``."""
        if not self._some_not_interpolated:
            return ramp.at(s)
        return np.where(self._is_interpolated, ramp.at(s), ramp.at(mean))

    def _stop_interpolating(self, t: float) -> None:
        self._struct.interpolates = False
        self._diagnostics.add(
            t,
            "interpolation",
            f"asked for no inputs in the step from t = {t} s, though it says it can "
            "(providesIntermediateUpdate): they kept their value from the start of "
            "that step; from then on it gets one value of them over a step, and the direct "
            "feedthrough to outputs belongs to that",
        )
