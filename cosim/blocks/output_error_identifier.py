"""The identifier by output error: theta from y, its start from the regression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped, check_design
from cosim.core.signals import Interface, Signal
from cosim.errors import AssumptionError
from cosim.native.estimation import (
    KnownInput,
    OutputErrorConstants,
    RayleighConstants,
)
from cosim.native.expression import Program
from cosim.native.identifier import (
    BetweenConstants,
    IdentifierConstants,
    IdentifierState,
    IdentifierStep,
)
from cosim.native.start_grid import StartGridConstants
from cosim.native.step import RegressorConstants
from cosim.theory.disturbance import SearchBox
from cosim.theory.disturbed_plant import (
    DisturbedPlant,
    NoiseModel,
    discretize,
    needs_predictor,
    white_noise,
)
from cosim.theory.estimators.output_error import presence_threshold
from cosim.theory.estimators.projection import reconstruction_model
from cosim.theory.estimators.start_grid import start_grid

_OF_Y = ("Ad", "B0", "B1", "K", "C", "D", "W")
_OF_DELTA = ("delta_Ad", "delta_C")
_OF_U = ("Bu0", "Bu1", "Du")
_OUTSIDE = 6  # COSIM_OUTSIDE


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationProblem:
    """What is identified, from which signals.

    Parameters
    ----------
    plant : DisturbedPlant
        The design model of y.
    modes, row : Matrix (m, m), Vector (m,)
        The observer's own dynamics, and how they enter delta.
    rayleigh : RayleighConstants
        The regression as a function of theta.
    products : RegressorConstants
        Of the regressor that makes mu.
    alphas : sequence of Program
        The known factor of every component.
    box : SearchBox
        Where theta is searched.
    stated : Matrix, shape (n_y, n_y), or None
        Covariance of the noise of y; None: it is not known.
    """

    plant: DisturbedPlant
    modes: Matrix
    row: Vector
    rayleigh: RayleighConstants
    products: RegressorConstants
    alphas: Sequence[Program]
    box: SearchBox
    stated: Matrix | None = None

    @property
    def noise(self) -> NoiseModel:
        """The noise of y: as it is stated, else of one deviation on every output."""
        white = white_noise(len(self.plant.C))
        return white if self.stated is None else replace(white, covariance=self.stated)

    def within(self, lower: Vector, upper: Vector) -> IdentificationProblem:
        """Return the problem with its search within bounds, shape (P,)."""
        searched = replace(
            self.rayleigh,
            lower=np.clip(self.rayleigh.lower, lower, upper),
            upper=np.clip(self.rayleigh.upper, lower, upper),
        )
        return replace(self, rayleigh=searched)


@dataclass(frozen=True, kw_only=True)
class IdentificationSchedule:
    """When samples count, and how many.

    Parameters
    ----------
    period : int
        Communication steps between two estimates.
    steps : int
        Communication steps of the longest run.
    average : int
        Samples of mu that make one row of the regression.
    window : int
        Samples of a moving window; 0: all.
    forgetting : float
        Weight of a sample over that of the next one; 1: all weigh the same.
    start : float
        First instant of which mu counts, the identification start time T_id (36) [s].
    settled : float
        First instant of which delta counts [s].
    lag : float
        Of delta [s].
    """

    period: int
    steps: int
    average: int
    window: int
    forgetting: float
    start: float
    settled: float
    lag: float


class OutputErrorIdentifier:
    """Estimates theta online by output error on y.

    Inputs regressor (mu), delta, y and u; outputs theta, its standard errors, the deviation of the
    noise of y, and the amplitudes of the components at the beginning of the window. They have no
    value (NaN) until the data determine them, theta of a component that noise alone explains never.
    An estimate rests on the samples before its instant. Where the noise of several outputs is not
    stated, they are weighed by the covariance of what the fit leaves.

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

    Raises
    ------
    Stopped
        From ``advance``, where a sample is said to be of an instant outside its step.
    AssumptionError
        From ``prepare``, where the plant is unstable, and its samples have instants of their own or
        the noise of several outputs is not stated.
    """

    def __init__(
        self,
        problem: IdentificationProblem,
        schedule: IdentificationSchedule,
        *,
        offset: bool,
        lower: Vector,
        upper: Vector,
        most: int = 0,
    ) -> None:
        self.problem = problem
        self.schedule = schedule
        self._offset = offset
        self._lower = lower
        self._upper = upper
        self._most = most
        generators = problem.rayleigh.generators
        n_y, n_u = problem.plant.D.shape
        inputs = [
            Signal("regressor", len(problem.rayleigh.parts), optional=True, role="input"),
            Signal("delta", 1, optional=True, role="input"),
            Signal("y", n_y, role="input"),
        ]
        if most:
            inputs.append(Signal("samples", n_y * most, optional=True, role="input"))
            inputs.append(Signal("sample_times", most, unit="s", optional=True, role="input"))
        if n_u:
            inputs.append(Signal("u", n_u, role="input"))
        P = generators.parameters
        outputs = (
            Signal("theta", P, optional=True, role="estimate"),
            Signal("standard_error", P, optional=True, role="estimate"),
            Signal("deviation", n_y, optional=True, role="estimate"),
            Signal("amplitude", generators.order, optional=True, role="estimate"),
        )
        names = tuple(signal.name for signal in inputs)
        self.interface = Interface(
            tuple(inputs), outputs, delayed=names, prepares=True, rollback=True
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize the models, or take the recorded matrices."""
        n_u = self.problem.plant.D.shape[1]
        held_u = held[len(held) - n_u :]
        computed = self._design(h, held_u)
        design = dict(recorded) or computed
        check_design(design, {name: array.shape for name, array in computed.items()})
        self._kernel = IdentifierStep(self._constants(h, design, held_u))
        return design

    def constants(self, h: float, held: Mask) -> IdentifierConstants:
        """Return the numbers of its kernel, for a design that is computed now."""
        held_u = held[len(held) - self.problem.plant.D.shape[1] :]
        return self._constants(h, self._design(h, held_u), held_u)

    def _design(self, h: float, held: Mask) -> dict[str, Matrix]:
        problem = self.problem
        generators = problem.rayleigh.generators
        span = self.schedule.steps * h
        step = np.array([h])
        predicts = np.array([needs_predictor(problem.plant.A, span)])
        if self._most and predicts[0]:
            raise AssumptionError(
                "the plant is unstable, so that its output has to be predicted from the samples "
                "before, at constant distances; needed samples at the communication points"
            )
        if predicts[0] and problem.stated is None and len(problem.plant.C) > 1:
            raise AssumptionError(
                "the plant is unstable, so that its outputs have to be predicted by what is known "
                "of their noise; needed its deviation, one number an output, or its covariance"
            )
        on_y, known = discretize(
            problem.plant,
            generators,
            step=step,
            predicts=predicts,
            noise=problem.noise,
            held=held,
        )
        model = reconstruction_model(problem.modes, problem.row, len(generators.size))
        white = white_noise(1)
        never = np.zeros(1, np.bool_)
        on_delta, _ = discretize(model, generators, step=step, predicts=never, noise=white)
        design = {name: np.asarray(getattr(on_y, name)) for name in _OF_Y}
        design["delta_Ad"] = on_delta.Ad
        design["delta_C"] = on_delta.C
        design["Bu0"] = known.B0
        design["Bu1"] = known.B1
        design["Du"] = known.D
        design["threshold"] = presence_threshold(generators.size, 1)
        if self._most:
            design["A"] = problem.plant.A
            design["B"] = np.hstack([problem.plant.B, problem.plant.Bd])
        design["times"] = np.array([self.schedule.start, self.schedule.settled])
        # from logarithms and exponentials of the C library
        rayleigh = problem.rayleigh
        design["box"] = np.stack([rayleigh.lower, rayleigh.upper, problem.box.step])
        design["forgetting"] = np.array([self.schedule.forgetting])
        return design

    def _constants(self, h: float, design: Design, held: Mask) -> IdentifierConstants:
        problem = self.problem
        schedule = self.schedule
        generators = problem.rayleigh.generators
        components = len(generators.size)
        m = len(problem.modes)
        no_input = np.zeros((1, components, m))
        step = np.array([h])
        on_delta = OutputErrorConstants(
            generators=generators,
            step=step,
            Ad=design["delta_Ad"],
            B0=no_input,
            B1=no_input,
            K=np.zeros((1, m, 1)),
            C=design["delta_C"],
            D=np.ones((components, 1)),
            W=np.eye(1),
            a=np.zeros((1, 0)),
        )
        on_y = OutputErrorConstants(
            generators=generators,
            step=step,
            **{name: design[name] for name in _OF_Y},
            a=np.zeros((len(design["W"]), 0)),
            offset=self._offset,
            forgetting=float(design["forgetting"][0]),
            average=1,
            source=None,
        )
        lower, upper, scale = design["box"]
        predicts = np.array([bool(design["K"].any())])
        known = KnownInput(design["Bu0"], design["Bu1"], design["Du"], predicts)
        start, settled = design["times"]
        return IdentifierConstants(
            period=schedule.period,
            average=schedule.average,
            window=schedule.window,
            capacity=schedule.steps,
            start=float(start),
            settled=float(settled),
            lag=schedule.lag,
            products=problem.products,
            alphas=problem.alphas,
            rayleigh=replace(problem.rayleigh, lower=lower, upper=upper),
            on_delta=on_delta,
            on_y=on_y,
            known=known,
            lower=self._lower,
            upper=self._upper,
            scale=scale,
            threshold=design["threshold"],
            deviations=None if problem.stated is None else problem.noise.deviations,
            grid=self._grid(on_y, lower, upper),
            between=self._between(design, held),
        )

    def _grid(self, on_y: OutputErrorConstants, lower: Vector, upper: Vector) -> StartGridConstants:
        schedule = self.schedule
        forgetting = on_y.forgetting
        if schedule.window:
            forgetting = 1.0 - 1.0 / schedule.window
        return start_grid(
            replace(on_y, forgetting=forgetting),
            lower,
            upper,
            points=self.problem.rayleigh.points,
            average=max(1, schedule.average // 10),
        )

    def _between(self, design: Design, held: Mask) -> BetweenConstants | None:
        if not self._most:
            return None
        D = np.hstack([design["Du"], design["D"].T])
        return BetweenConstants(
            most=self._most, A=design["A"], B=design["B"], C=design["C"], D=D, held=held
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget all samples; there is no estimate yet."""
        self._last = self._kernel.initialize()
        return self._last.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the last estimate; the samples at this instant do not change it."""
        return self._last.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K samples, those at the beginning of the K steps."""
        y = self._kernel.step.advance(t, h, u)
        if len(y):
            self._last = y[-1].copy()
        if self._kernel.step.status == _OUTSIDE:
            raise Stopped(
                y,
                f"a sample at {t[len(y)]} s is said to be of an instant that is not since the "
                "communication point before; needed the samples of that step",
            )
        return y

    def save(self) -> tuple[IdentifierState, Vector]:
        """Copy the state and the estimate."""
        return self._kernel.save(), self._last.copy()

    def restore(self, state: tuple[IdentifierState, Vector]) -> None:
        """Return to a saved state."""
        memory, last = state
        self._kernel.restore(memory)
        self._last = last.copy()
