"""The first stages of output error as identifiers: the Rayleigh quotient, projection on delta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Mask, Vector
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
        nothing = np.zeros(self.problem.rayleigh.generators.parameters)
        return IdentifierStep(
            _constants(self.problem, self.schedule, float(start), threshold=nothing)
        )


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
        problem = self.problem
        generators = problem.rayleigh.generators
        model = reconstruction_model(problem.modes, problem.row, len(generators.size))
        never = np.zeros(1, np.bool_)
        on_delta, _ = discretize(
            model, generators, step=np.array([h]), predicts=never, noise=white_noise(1)
        )
        times = np.array([self.schedule.start, self.schedule.settled])
        return {"delta_Ad": on_delta.Ad, "delta_C": on_delta.C, "times": times}

    def kernel(self, h: float, held: Mask, design: Design) -> IdentifierStep:
        """Return the identifier without samples."""
        generators = self.problem.rayleigh.generators
        components = len(generators.size)
        m = len(self.problem.modes)
        no_input = np.zeros((1, components, m))
        on_delta = OutputErrorConstants(
            generators=generators,
            step=np.array([h]),
            Ad=design["delta_Ad"],
            B0=no_input,
            B1=no_input,
            K=np.zeros((1, m, 1)),
            C=design["delta_C"],
            D=np.ones((components, 1)),
            W=np.eye(1),
            a=np.zeros(0),
        )
        start, settled = design["times"]
        constants = _constants(
            self.problem,
            self.schedule,
            float(start),
            settled=float(settled),
            on_delta=on_delta,
            lower=self.lower,
            upper=self.upper,
            threshold=np.zeros(components),
        )
        return IdentifierStep(constants)


def _regressor_signal(problem: IdentificationProblem) -> Signal:
    return Signal("regressor", len(problem.rayleigh.parts), optional=True, role="input")


def _theta_signal(problem: IdentificationProblem) -> Signal:
    parameters = problem.rayleigh.generators.parameters
    return Signal("theta", parameters, optional=True, role="estimate")


def _constants(
    problem: IdentificationProblem,
    schedule: IdentificationSchedule,
    start: float,
    *,
    threshold: Vector,
    settled: float = 0.0,
    on_delta: OutputErrorConstants | None = None,
    lower: Vector | None = None,
    upper: Vector | None = None,
) -> IdentifierConstants:
    rayleigh = problem.rayleigh
    return IdentifierConstants(
        period=schedule.period,
        average=schedule.average,
        window=schedule.window,
        capacity=schedule.steps,
        start=start,
        settled=settled,
        lag=schedule.lag,
        products=problem.products,
        alphas=problem.alphas,
        rayleigh=rayleigh,
        on_delta=on_delta,
        on_y=None,
        known=None,
        lower=rayleigh.lower if lower is None else lower,
        upper=rayleigh.upper if upper is None else upper,
        scale=problem.box.step,
        threshold=threshold,
    )
