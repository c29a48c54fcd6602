"""The first stages of output error as identifiers: the Rayleigh quotient, projection on delta."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.blocks.output_error_identifier import IdentificationProblem, IdentificationSchedule
from cosim.core.contracts import Design
from cosim.core.signals import Interface, Signal
from cosim.native.estimation import OutputErrorConstants
from cosim.native.identifier import IdentifierConstants, IdentifierStep
from cosim.theory.disturbed_plant import discretize, white_noise
from cosim.theory.estimators.projection import reconstruction_model


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
        regressor = _regressor_signal(self.problem)
        theta = _theta_signal(self.problem)
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
            _regressor_signal(self.problem),
            Signal("delta", 1, optional=True, role="input"),
        )
        order = self.problem.rayleigh.generators.order
        amplitude = Signal("amplitude", order, optional=True, role="estimate")
        outputs = (_theta_signal(self.problem), amplitude)
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


def design_of_delta(problem: IdentificationProblem, h: float) -> dict[str, Matrix]:
    """Discretize the modes of the observer, whose transients are in delta."""
    generators = problem.rayleigh.generators
    model = reconstruction_model(problem.modes, problem.row, len(generators.size))
    never = np.zeros(1, np.bool_)
    on_delta, _ = discretize(
        model, generators, step=np.array([h]), predicts=never, noise=white_noise(1)
    )
    return {"delta_Ad": on_delta.Ad, "delta_C": on_delta.C}


def model_of_delta(
    problem: IdentificationProblem, h: float, design: Design
) -> OutputErrorConstants:
    """Return the numbers of a fit to delta."""
    generators = problem.rayleigh.generators
    components = len(generators.size)
    m = len(problem.modes)
    no_input = np.zeros((1, components, m))
    return OutputErrorConstants(
        generators=generators,
        step=np.array([h]),
        Ad=design["delta_Ad"],
        B0=no_input,
        B1=no_input,
        K=np.zeros((1, m, 1)),
        C=design["delta_C"],
        D=np.ones((components, 1)),
        W=np.eye(1),
        a=np.zeros((1, 0)),
    )


def _regressor_signal(problem: IdentificationProblem) -> Signal:
    return Signal("regressor", len(problem.rayleigh.parts), optional=True, role="input")


def _theta_signal(problem: IdentificationProblem) -> Signal:
    parameters = problem.rayleigh.generators.parameters
    return Signal("theta", parameters, optional=True, role="estimate")


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
