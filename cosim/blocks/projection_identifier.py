"""The first stages of output error as identifiers: the Rayleigh quotient, projection on delta."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.blocks.identification_problem import (
    IdentificationProblem,
    IdentificationSchedule,
    sampling_interface,
)
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.native.estimation.identifier import IdentifierStep


@dataclass(frozen=True, eq=False)
class RayleighIdentifier:
    """theta at the minimum of the Rayleigh quotient: input regressor (mu), output theta.

    Parameters
    ----------
    problem : IdentificationProblem
    schedule : IdentificationSchedule
    """

    problem: IdentificationProblem
    schedule: IdentificationSchedule

    @property
    def interface(self) -> Interface:
        """Input regressor, output theta."""
        problem = self.problem
        return sampling_interface(
            [problem.regressor_signal(), *problem.alpha_signals()], problem.theta_signals("theta")
        )

    def design(self, h: float, held: Mask) -> Design:
        """Return the start time."""
        return {"start": np.array([self.schedule.start])}

    def kernel(self, h: float, held: Mask, design: Design) -> IdentifierStep:
        """Return the identifier without samples."""
        (start,) = design["start"]
        schedule = replace(self.schedule, start=float(start))
        box = self.problem.rayleigh
        return IdentifierStep(self.problem.stage_constants(schedule, None, box.lower, box.upper))


@dataclass(frozen=True, eq=False)
class ProjectionIdentifier:
    """Variable projection on delta, started by the Rayleigh quotient.

    Inputs regressor (mu) and delta, outputs theta and the amplitudes of the components at the
    beginning of the window.

    Parameters
    ----------
    problem : IdentificationProblem
    schedule : IdentificationSchedule
    lower, upper : Vector, shape (P,)
        Bounds of theta; where they are equal it is known.
    """

    problem: IdentificationProblem
    schedule: IdentificationSchedule
    lower: Vector
    upper: Vector

    @property
    def interface(self) -> Interface:
        """Inputs regressor and delta, outputs theta and amplitude."""
        problem = self.problem
        inputs = [problem.regressor_signal(), *problem.alpha_signals(), problem.delta_signal()]
        outputs = [*problem.theta_signals("theta"), problem.amplitude_signal()]
        return sampling_interface(inputs, outputs)

    def design(self, h: float, held: Mask) -> Design:
        """Discretize the modes of the observer."""
        times = np.array([self.schedule.start, self.schedule.settled])
        return {**self.problem.design_of_delta(h), "times": times}

    def kernel(self, h: float, held: Mask, design: Design) -> IdentifierStep:
        """Return the identifier without samples."""
        start, settled = design["times"]
        schedule = replace(self.schedule, start=float(start), settled=float(settled))
        on_delta = self.problem.model_of_delta(h, design)
        constants = self.problem.stage_constants(schedule, on_delta, self.lower, self.upper)
        return IdentifierStep(constants)
