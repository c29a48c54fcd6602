"""The first stages of output error as identifiers: the Rayleigh quotient, projection on delta."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.blocks.identification_problem import (
    IdentificationProblem,
    IdentificationSchedule,
    design_of_delta,
    model_of_delta,
)
from cosim.core.contracts import Design
from cosim.core.signals import Interface, Signal
from cosim.native.identifier import IdentifierConstants, IdentifierStep
from cosim.native.output_error import OutputErrorConstants


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
        regressor = self.problem.regressor_signal()
        theta = self.problem.theta_signal()
        return Interface(
            (regressor,), (theta,), delayed=("regressor",), prepares=True, rollback=True
        )

    def design(self, h: float, held: Mask) -> Design:
        """Return the start time."""
        return {"start": np.array([self.schedule.start])}

    def kernel(self, h: float, held: Mask, design: Design) -> IdentifierStep:
        """Return the identifier without samples."""
        (start,) = design["start"]
        schedule = replace(self.schedule, start=float(start))
        box = self.problem.rayleigh
        return IdentifierStep(stage_constants(self.problem, schedule, None, box.lower, box.upper))


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
        inputs = (
            self.problem.regressor_signal(),
            Signal("delta", 1, optional=True, role="input"),
        )
        order = self.problem.rayleigh.generators.order
        amplitude = Signal("amplitude", order, optional=True, role="estimate")
        outputs = (self.problem.theta_signal(), amplitude)
        names = tuple(signal.name for signal in inputs)
        return Interface(inputs, outputs, delayed=names, prepares=True, rollback=True)

    def design(self, h: float, held: Mask) -> Design:
        """Discretize the modes of the observer."""
        times = np.array([self.schedule.start, self.schedule.settled])
        return {**design_of_delta(self.problem, h), "times": times}

    def kernel(self, h: float, held: Mask, design: Design) -> IdentifierStep:
        """Return the identifier without samples."""
        start, settled = design["times"]
        schedule = replace(self.schedule, start=float(start), settled=float(settled))
        on_delta = model_of_delta(self.problem, h, design)
        constants = stage_constants(self.problem, schedule, on_delta, self.lower, self.upper)
        return IdentifierStep(constants)


def stage_constants(
    problem: IdentificationProblem,
    schedule: IdentificationSchedule,
    on_delta: OutputErrorConstants | None,
    lower: Vector,
    upper: Vector,
) -> IdentifierConstants:
    """Return the numbers of an identifier that does not go on to y."""
    components = len(problem.rayleigh.generators.size)
    return IdentifierConstants(
        period=schedule.period,
        average=schedule.average,
        window=schedule.window,
        capacity=schedule.steps,
        start=schedule.start,
        settled=schedule.settled,
        lag=schedule.lag,
        products=problem.products,
        alphas=problem.alphas,
        rayleigh=problem.rayleigh,
        on_delta=on_delta,
        on_y=None,
        known=None,
        lower=lower,
        upper=upper,
        scale=problem.box.step,
        threshold=np.zeros(components),  # the noise of delta is not white
    )
