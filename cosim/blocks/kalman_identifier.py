"""The Kalman filters as identifiers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask
from cosim.blocks.identification_problem import (
    IdentificationProblem,
    IdentificationSchedule,
    sampling_interface,
)
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import UsageError
from cosim.native.estimation.kalman import (
    AugmentedKalmanConstants,
    AugmentedKalmanStep,
    ExtendedKalmanConstants,
    ExtendedKalmanStep,
)
from cosim.theory.estimators.augmented_kalman import augmented_model, first_spread
from cosim.theory.estimators.extended_kalman import first_theta

_AUGMENTED = ("Phi", "B0", "B1", "C", "D", "W", "noise")


@dataclass(frozen=True, eq=False, kw_only=True)
class ExtendedKalmanIdentifier:
    """Inputs regressor, whose values are not used, y and u; outputs theta and its standard errors.

    Parameters
    ----------
    problem : IdentificationProblem
    deviation : float
        Of the noise of y.
    size : float
        Deviation of x and of the amplitudes at first.

    Raises
    ------
    UsageError
        If deviation or size is not positive and finite.
    """

    problem: IdentificationProblem
    deviation: float
    size: float

    def __post_init__(self) -> None:
        check_positive(deviation=self.deviation, size=self.size)

    @property
    def interface(self) -> Interface:
        """Inputs regressor, y and u, outputs theta and standard_error."""
        problem = self.problem
        inputs = [
            problem.regressor_signal(),
            *problem.alpha_signals(),
            problem.y_signal(),
            *problem.u_signals(),
        ]
        outputs = problem.theta_signals("theta", "standard_error")
        return sampling_interface(inputs, outputs)

    def design(self, h: float, held: Mask) -> Design:
        """Discretize the plant."""
        box = self.problem.box
        model = self.problem.design_of_y(h, held, predicts=False)
        return {**model, "theta": first_theta(box), "spread": box.step}

    def kernel(self, h: float, held: Mask, design: Design) -> ExtendedKalmanStep:
        """Return the filter without samples."""
        problem = self.problem
        model, known = problem.model_of_y(h, design)
        constants = ExtendedKalmanConstants(
            terms=len(problem.rayleigh.parts),
            model=model,
            known=known,
            alphas=problem.alphas,
            deviation=self.deviation,
            size=self.size,
            theta=design["theta"],
            spread=design["spread"],
            threshold=design["threshold"],
        )
        return ExtendedKalmanStep(constants)


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmentedKalmanIdentifier:
    """Inputs regressor, whose values are not used, y and u; output theta.

    Parameters
    ----------
    problem : IdentificationProblem
    schedule : IdentificationSchedule
    deviation : float
        Of the noise of y.
    size : float
        Deviation of x, delta and its derivative at first.
    intensity : float
        Spectral density of the second derivative of delta.

    Raises
    ------
    UsageError
        If a number is not positive and finite.
    """

    problem: IdentificationProblem
    schedule: IdentificationSchedule
    deviation: float
    size: float
    intensity: float

    def __post_init__(self) -> None:
        check_positive(deviation=self.deviation, size=self.size, intensity=self.intensity)

    @property
    def interface(self) -> Interface:
        """Inputs regressor, y and u, output theta."""
        problem = self.problem
        inputs = [
            problem.regressor_signal(),
            *problem.alpha_signals(),
            problem.y_signal(),
            *problem.u_signals(),
        ]
        return sampling_interface(inputs, problem.theta_signals("theta"))

    def design(self, h: float, held: Mask) -> Design:
        """Discretize the plant with delta and its derivative as states."""
        problem = self.problem
        model = augmented_model(
            problem.plant,
            h,
            noise=problem.noise,
            intensity=self.intensity,
            held=problem.held_inputs(held),
        )
        start = np.array([self.schedule.start])
        return {**model, **problem.design_of_delta(h), "start": start}

    def kernel(self, h: float, held: Mask, design: Design) -> AugmentedKalmanStep:
        """Return the filter without samples."""
        (start,) = design["start"]
        schedule = replace(self.schedule, start=float(start), lag=0.0, window=0)
        problem = self.problem.without_lag(self.schedule.lag)
        infinite = np.full(problem.rayleigh.generators.parameters, np.inf)
        on_delta = problem.model_of_delta(h, design)
        projection = problem.stage_constants(schedule, on_delta, -infinite, infinite)
        constants = AugmentedKalmanConstants(
            **{name: design[name] for name in _AUGMENTED},
            first_spread=first_spread(len(problem.plant.A), self.size),
            deviation=self.deviation,
            capacity=self.schedule.steps,
            projection=projection,
        )
        return AugmentedKalmanStep(constants)


def check_positive(**numbers: float) -> None:
    """Check numbers by name.

    Raises
    ------
    UsageError
        If a number is not positive and finite.
    """
    for name, value in numbers.items():
        if not 0.0 < value < np.inf:
            raise UsageError(f"{name}: expected a finite number > 0, got {value}")
