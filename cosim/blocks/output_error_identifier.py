"""The identifier by output error: theta from y, its start from the regression."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.blocks.estimator import GRIDS, estimate, optional_input
from cosim.blocks.identification_problem import (
    IdentificationProblem,
    IdentificationSchedule,
    sampling_interface,
)
from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.errors import AssumptionError
from cosim.native.estimation.between import BetweenConstants
from cosim.native.estimation.identifier import IdentifierConstants, IdentifierStep
from cosim.native.estimation.output_error import OutputErrorConstants
from cosim.native.estimation.predictor import ModePredictorConstants
from cosim.native.estimation.start_grid import StartGridConstants
from cosim.theory.disturbed_plant import needs_predictor
from cosim.theory.estimators.start_grid import (
    COLUMNS,
    MOST_POINTS_ONLINE,
    axis_points,
    start_grid,
)

LONGEST: Final = 1e6  # s: a mode that grows less in it is simulated
MOST_SAMPLES: Final = 2**31 - 1


@dataclass(frozen=True, eq=False)
class OutputErrorIdentifier:
    """Estimates theta online by output error on y.

    Inputs regressor (mu), delta, y and u; outputs theta, its standard errors, the deviation of the
    noise of y, and the amplitudes of the components at the beginning of the window. They have no
    value (NaN) until the data determine them, theta of a component that noise alone explains never.
    An estimate rests on the samples before its instant. Its standard error is that of noise, or the
    distance to the farthest other optimum that the samples do not rule out, where that is more.
    Where the noise of several outputs is not stated, they are weighed by the covariance of what the
    fit leaves.

    Where y is sampled at instants of its own, these count in its place: the inputs ``samples``
    (the ``most`` values of a step for each output, one output behind the other) and
    ``sample_times`` have those since the last communication point, NaN where there is none.

    Parameters
    ----------
    problem : IdentificationProblem
    schedule : IdentificationSchedule
    offset : bool
        A constant on every output is unknown.
    lower, upper : Vector, shape (P,)
        Bounds of theta; where they are equal it is known.
    most : int
        Samples in one communication step at instants of their own; 0: y is sampled at the
        communication points.
    at_points : bool
        They are of communication points alone, of which some have none.

    Raises
    ------
    AssumptionError
        From ``design``, where the plant is unstable, and its samples have instants of their own or
        the noise of several outputs is not stated.
    """

    problem: IdentificationProblem
    schedule: IdentificationSchedule
    offset: bool
    lower: Vector
    upper: Vector
    most: int = 0
    at_points: bool = False

    @property
    def interface(self) -> Interface:
        """Inputs regressor, delta, y, the samples and u; outputs theta and what belongs to it."""
        problem = self.problem
        y = problem.y_signal()
        inputs = [problem.regressor_signal(), *problem.alpha_signals(), problem.delta_signal(), y]
        if self.most:
            times = optional_input("sample_times", self.most)
            inputs.append(optional_input("samples", y.size * self.most))
            inputs.append(replace(times, unit="s"))
        inputs.extend(problem.u_signals())
        outputs = [
            *problem.theta_signals("theta", "standard_error"),
            estimate("deviation", y.size),
            problem.amplitude_signal(),
        ]
        return sampling_interface(inputs, outputs)

    def design(self, h: float, held: Mask) -> Design:
        """Discretize the models of y and of delta."""
        problem = self.problem
        span = self.schedule.steps * h
        grows = needs_predictor(problem.plant.A, span)
        misses = self.most > 0 and self.at_points
        if self.most and grows and not misses:
            raise AssumptionError(
                "the plant is unstable, so that its output is predicted from equidistant samples; "
                "expected samples at the communication points"
            )
        has_noise = problem.stated is not None or len(problem.plant.C) == 1
        if grows and not has_noise:
            raise AssumptionError(
                "the plant is unstable, so that its outputs are predicted from the statistics of "
                "their noise; expected its standard deviation (one number per output) or its "
                "covariance"
            )
        # what a run computes does not depend on how long it will be
        is_predictable = has_noise and (not self.most or misses)
        predicts = is_predictable and needs_predictor(problem.plant.A, max(span, LONGEST))
        design = problem.design_of_y(h, held, predicts=predicts and not misses)
        if predicts and misses:
            design |= problem.design_of_predictor(h)
        design |= problem.design_of_delta(h)
        if self.most:
            design["A"] = problem.plant.A
            design["B"] = np.hstack([problem.plant.B, problem.plant.Bd])
        design["times"] = np.array([self.schedule.start, self.schedule.settled])
        # from logarithms and exponentials of the C library
        rayleigh = problem.rayleigh
        design["box"] = np.stack([rayleigh.lower, rayleigh.upper, problem.box.step])
        design[GRIDS] = problem.boxes(self.lower, self.upper)
        design["forgetting"] = np.array([self.schedule.forgetting])
        return design

    def kernel(self, h: float, held: Mask, design: Design) -> IdentifierStep:
        """Return the identifier without samples."""
        return IdentifierStep(self.constants(h, held, design))

    def constants(self, h: float, held: Mask, design: Design) -> IdentifierConstants:
        """Return the numbers of its kernel."""
        problem = self.problem
        start, settled = design["times"]
        schedule = replace(self.schedule, start=float(start), settled=float(settled))
        on_delta = problem.model_of_delta(h, design)
        stages = problem.stage_constants(schedule, on_delta, self.lower, self.upper)
        (forgetting,) = design["forgetting"]
        on_y, known = problem.model_of_y(
            h, design, offset=self.offset, forgetting=float(forgetting)
        )
        lower, upper, scale = design["box"]
        boxes = design.get(GRIDS, design["box"][np.newaxis, :2])[: self._needed_grids(h)]
        return replace(
            stages,
            rayleigh=replace(problem.rayleigh, lower=lower, upper=upper),
            on_y=on_y,
            known=known,
            scale=scale,
            threshold=design["threshold"],
            deviations=None if problem.stated is None else problem.noise.deviations,
            grids=tuple(self._grid(on_y, *ends) for ends in boxes),
            reach=tuple(self._reach(number, h) for number in range(len(boxes))),
            between=self._between(design, problem.held_inputs(held)),
            predictor=_predictor(design),
        )

    def _needed_grids(self, h: float) -> int:
        """Return how many grids a run of the longest length comes to."""
        number = 0
        while self.problem.reach(number) < self.schedule.steps * h:
            number += 1
        return number + 1

    def _reach(self, number: int, h: float) -> int:
        """Return the samples up to which a grid counts."""
        return min(math.ceil(self.problem.reach(number) / h), MOST_SAMPLES)

    def _grid(self, on_y: OutputErrorConstants, lower: Vector, upper: Vector) -> StartGridConstants:
        schedule = self.schedule
        box = self.problem.box
        points = axis_points(on_y.generators, box.graded, most=MOST_POINTS_ONLINE, columns=COLUMNS)
        forgetting = on_y.forgetting
        if schedule.window:
            forgetting = 1.0 - 1.0 / schedule.window
        grid = start_grid(
            replace(on_y, forgetting=forgetting),
            replace(box, lower=lower, upper=upper),
            points=points,
            average=max(1, schedule.average // 10),
            alike=self.problem.interchangeable(self.lower, self.upper),
            beside=[lower],  # the place of a fit
        )
        return replace(grid, beside=True)

    def _between(self, design: Design, held: Mask) -> BetweenConstants | None:
        if not self.most:
            return None
        D = np.hstack([design["Du"], design["D"].T])
        return BetweenConstants(
            most=self.most,
            A=design["A"],
            B=design["B"],
            C=design["C"],
            D=D,
            held=held,
        )


def _predictor(design: Design) -> ModePredictorConstants | None:
    """Return the predictor from samples that may be missing; None: there is no need of one."""
    if "predictor_T" not in design:
        return None
    return ModePredictorConstants(
        T=design["predictor_T"],
        C=design["predictor_C"],
        R=design["predictor_R"],
        V=design["predictor_V"],
        P=design["predictor_P"],
    )
