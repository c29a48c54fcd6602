"""What is identified, when, and the models of it that methods share.

A method discretizes once, for the design that is recorded (``design_of_...``), and makes the
numbers of its kernel of what was recorded (``model_of_...``). Its inputs and outputs are some of
the signals of the problem.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.blocks.estimator import estimate, optional_input
from cosim.blocks.regressor import alpha_signals
from cosim.core.contracts import Design
from cosim.core.signals import Interface, Signal
from cosim.native.estimation.alphas import Alpha, PastAlphas
from cosim.native.estimation.identifier import IdentifierConstants
from cosim.native.estimation.output_error import KnownInput, OutputErrorConstants
from cosim.native.estimation.rayleigh import RayleighConstants
from cosim.native.estimation.regression import RegressorConstants
from cosim.theory.disturbances.families import Family, SearchBox, search_box
from cosim.theory.disturbed_plant import DisturbedPlant, NoiseModel, discretize, white_noise
from cosim.theory.estimators.output_error import presence_threshold
from cosim.theory.estimators.projection import reconstruction_model
from cosim.theory.estimators.rayleigh import shortest_delay
from cosim.theory.interchangeable import interchangeable
from cosim.theory.predictor import stationary_predictor, unstable_modes

MOST_GRIDS: Final = 12
OF_Y: Final = ("Ad", "B0", "B1", "K", "L", "C", "D", "W")


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
        Weight of the square of a sample over that of the next sample; 1: all weigh the same.
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
    alphas : sequence of Alpha
        The known factor of every component.
    families : sequence of Family
        Of the components of the disturbance.
    stated : Matrix, shape (n_y, n_y), or None
        Covariance of the noise of y; None: it is not known.
    disturbances : int
        Elements of delta.
    """

    plant: DisturbedPlant
    modes: Matrix
    row: Vector
    rayleigh: RayleighConstants
    products: RegressorConstants
    alphas: Sequence[Alpha]
    families: Sequence[Family]
    stated: Matrix | None = None
    disturbances: int = 1

    @property
    def box(self) -> SearchBox:
        """The theta that delays tell apart, of data of any length: its step is that of a fit."""
        shortest = shortest_delay(self.rayleigh.delays)
        return search_box(self.families, span=math.inf, shortest=shortest)

    def reach(self, number: int) -> float:
        """Return the length of the data that a grid of starts on y is for [s].

        Each is for data four times as long as the one before, the first for those of the delays:
        a start must not depend on how long a run will be.
        """
        delays = self.rayleigh.delays
        return float(4.0**number * (max(delays) - min(delays)))

    def boxes(self, lower: Vector, upper: Vector) -> Matrix:
        """Return the ends of all grids, shape (MOST_GRIDS, 2, P).

        Parameters
        ----------
        lower, upper : Vector, shape (P,)
            Bounds of theta.
        """
        shortest = shortest_delay(self.rayleigh.delays)
        ends = []
        for number in range(MOST_GRIDS):
            box = search_box(self.families, span=self.reach(number), shortest=shortest)
            ends.append(np.clip([box.lower, box.upper], lower, upper))
        boxes = np.array(ends)
        # All have as many points: one that bounds leave none has those of the nearest.
        for j, wide in enumerate((boxes[:, 1] > boxes[:, 0]).T):
            there = np.flatnonzero(wide)
            for narrow in np.flatnonzero(~wide) if there.size else ():
                nearest = there[np.abs(there - narrow).argmin()]
                boxes[narrow, :, j] = boxes[nearest, :, j]
        return boxes

    @property
    def has_regression(self) -> bool:
        """Whether mu is that of (25), which gives a start."""
        return bool(self.rayleigh.parts.shape[1])

    @property
    def noise(self) -> NoiseModel:
        """The noise of y: as it is stated, else of one deviation on every output."""
        white = white_noise(len(self.plant.C))
        return white if self.stated is None else replace(white, covariance=self.stated)

    def held_inputs(self, held: Mask) -> Mask:
        """Return which entries of u are held, of all inputs: u stands last."""
        n_u = self.plant.D.shape[1]
        return held[len(held) - n_u :]

    def within(self, lower: Vector, upper: Vector) -> IdentificationProblem:
        """Return the problem with its search within bounds, shape (P,)."""
        first = np.clip(self.rayleigh.lower, lower, upper)
        last = np.clip(self.rayleigh.upper, lower, upper)
        searched = replace(self.rayleigh, lower=first, upper=last)
        return replace(self, rayleigh=searched)

    def without_lag(self, lag: float) -> IdentificationProblem:
        """Return the problem of a delta that does not lag so much [s] as that of the observer."""
        past = self.products.alphas
        ages = [age - lag for age in past.ages]
        products = replace(self.products, alphas=replace(past, ages=ages))
        return replace(self, products=products)

    def lagging(self, lag: float) -> PastAlphas:
        """Return the alphas of the components, as late as delta, which lags so much [s]."""
        past = self.products.alphas
        return PastAlphas(alphas=self.alphas, ages=[lag], h=past.h, depth=past.samples)

    def interchangeable(self, lower: Vector, upper: Vector) -> tuple[int, ...]:
        """Return for every term the last one before it that is interchangeable with it, or -1.

        Parameters
        ----------
        lower, upper : Vector, shape (P,)
            Bounds of theta.
        """
        texts = [alpha.text for alpha in self.alphas]
        bounds = {j: (float(lower[j]), float(upper[j])) for j in range(len(lower))}
        return interchangeable(
            self.rayleigh.generators, self.plant, lambda i, k: texts[i] == texts[k], bounds
        )

    # --- signals ---

    def alpha_signals(self) -> tuple[Signal, ...]:
        """Return the input alpha, where there are signals among the alphas."""
        return alpha_signals(self.alphas)

    def regressor_signal(self) -> Signal:
        """Return the input mu."""
        return optional_input("regressor", len(self.rayleigh.parts))

    def delta_signal(self) -> Signal:
        """Return the input delta."""
        return optional_input("delta", self.disturbances)

    def y_signal(self) -> Signal:
        """Return the input y."""
        return Signal("y", len(self.plant.D), role="input", description="measured output")

    def u_signals(self) -> tuple[Signal, ...]:
        """Return the input u, where the plant has one; it stands last of all inputs."""
        n_u = self.plant.D.shape[1]
        return (Signal("u", n_u, role="input", description="known input"),) if n_u else ()

    def theta_signals(self, *names: str) -> tuple[Signal, ...]:
        """Return outputs as long as theta; none where the terms have no parameters."""
        parameters = self.rayleigh.generators.parameters
        return tuple(estimate(name, parameters) for name in names if parameters)

    def amplitude_signal(self) -> Signal:
        """Return the output with the amplitudes at the beginning of the window."""
        return estimate("amplitude", self.rayleigh.generators.order)

    # --- the model of y ---

    def design_of_y(self, h: float, held: Mask, *, predicts: bool) -> dict[str, Matrix]:
        """Discretize the plant.

        Parameters
        ----------
        h : float
            Communication step [s].
        held : Mask
            Inputs of the identifier with a zero-order hold.
        predicts : bool
            y is predicted from the sample before, as the plant is unstable.
        """
        generators = self.rayleigh.generators
        plant = self.plant
        noise = self.noise
        predictor = None
        if predicts:
            predictor = stationary_predictor(plant.A, plant.C, h, noise.covariance)
        on_y, known = discretize(
            plant,
            generators,
            step=np.array([h]),
            predictor=predictor,
            noise=noise,
            held=self.held_inputs(held),
        )
        design = {name: np.asarray(getattr(on_y, name)) for name in OF_Y}
        design |= {"Bu0": known.B0, "Bu1": known.B1, "Du": known.D}
        design["threshold"] = presence_threshold(generators.size, 1)
        return design

    def design_of_predictor(self, h: float) -> dict[str, Matrix]:
        """Return the modes by which y is predicted from samples that may be missing."""
        covariance = self.noise.covariance
        modes = unstable_modes(self.plant.A, self.plant.C, h, covariance)
        return {
            "predictor_T": modes.transition,
            "predictor_C": self.plant.C @ modes.V,
            "predictor_R": covariance,
            "predictor_V": modes.V,
            "predictor_P": modes.P,
        }

    def model_of_y(
        self, h: float, design: Design, *, offset: bool = False, forgetting: float = 1.0
    ) -> tuple[OutputErrorConstants, KnownInput]:
        """Return the numbers of a fit to y, and of what is known of y."""
        model = OutputErrorConstants(
            generators=self.rayleigh.generators,
            step=np.array([h]),
            **{name: design[name] for name in OF_Y},
            a=np.zeros((len(design["W"]), 0)),
            offset=offset,
            forgetting=forgetting,
            average=1,
            every=None,
            source=None,
        )
        predicts = np.array([bool(design["K"].any())])
        return model, KnownInput(design["Bu0"], design["Bu1"], design["Du"], predicts)

    # --- the model of delta ---

    def design_of_delta(self, h: float) -> dict[str, Matrix]:
        """Discretize the modes of the observer, whose transients are in delta."""
        generators = self.rayleigh.generators
        model = reconstruction_model(self.modes, self.row, len(generators.size))
        on_delta, _ = discretize(model, generators, step=np.array([h]), noise=white_noise(1))
        return {"delta_Ad": on_delta.Ad, "delta_C": on_delta.C}

    def model_of_delta(self, h: float, design: Design) -> OutputErrorConstants:
        """Return the numbers of a fit to delta."""
        generators = self.rayleigh.generators
        components = len(generators.size)
        m = len(self.modes)
        no_input = np.zeros((1, components, m))
        return OutputErrorConstants(
            generators=generators,
            step=np.array([h]),
            Ad=design["delta_Ad"],
            B0=no_input,
            B1=no_input,
            K=np.zeros((1, m, 1)),
            L=np.ones((1, 1, 1)),
            C=design["delta_C"],
            D=np.ones((components, 1)),
            W=np.eye(1),
            a=np.zeros((1, 0)),
        )

    # --- the identifier without a model of y ---

    def stage_constants(
        self,
        schedule: IdentificationSchedule,
        on_delta: OutputErrorConstants | None,
        lower: Vector,
        upper: Vector,
    ) -> IdentifierConstants:
        """Return the numbers of an identifier that does not go on to y.

        Parameters
        ----------
        schedule : IdentificationSchedule
        on_delta : OutputErrorConstants, optional
            The model of delta; without it theta is that of the Rayleigh quotient.
        lower, upper : Vector, shape (P,)
            Bounds of theta; where they are equal it is known.
        """
        components = len(self.rayleigh.generators.size)
        return IdentifierConstants(
            period=schedule.period,
            average=schedule.average if self.has_regression else 0,
            window=schedule.window,
            capacity=schedule.steps,
            start=schedule.start,
            settled=schedule.settled,
            products=self.products,
            lagging=self.lagging(schedule.lag),
            rayleigh=self.rayleigh,
            on_delta=on_delta,
            on_y=None,
            known=None,
            lower=lower,
            upper=upper,
            scale=self.box.step,
            threshold=np.zeros(components),  # the noise of delta is not white
            disturbances=self.disturbances,
        )


def sampling_interface(inputs: Sequence[Signal], outputs: Sequence[Signal]) -> Interface:
    """Return the interface of a component that takes samples at the beginning of a step."""
    names = tuple(signal.name for signal in inputs)
    return Interface(
        tuple(inputs),
        tuple(outputs),
        delayed=names,
        prepares=True,
        rollback=True,
        native=True,
        continuous=True,
    )
