"""A variant of a scenario without noise of y: its signals, and what noise would leave in delta."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.clock import seconds
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import UsageError
from cosim.native.estimation.alphas import signals_among
from cosim.scenario.building.build import Builder
from cosim.scenario.experiment_design.subject import DesignSubject
from cosim.scenario.kinds.feedback import inputs_in_feedback
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identification_source import IdentifierSource
from cosim.scenario.kinds.identified_plant import IdentifiedPlant
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.theory.disturbed_plant import DataSet
from cosim.theory.experiment_design.bound import AccuracyBound, accuracy_bound
from cosim.theory.experiment_design.predictions import RegressionExperiment
from cosim.theory.experiment_design.reconstruction_noise import ReconstructionNoise
from cosim.theory.forced_response import simulate

_SPAN_OF_NOISE: Final = 200_000  # samples that a response to noise is followed over, at most


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """A variant of a scenario, simulated without noise of y.

    Parameters
    ----------
    settings : mapping of dotted key to value
        What a user sets for the variant.
    identified : IdentifiedPlant
        The model of y.
    data : DataSet
        What the observer takes in.
    covariance : Matrix, shape (n_y, n_y)
        Of the noise of y.
    regression : RegressionExperiment
        What the observer makes of it.
    delta_of_u : Vector, shape (N,)
        The part of delta hat that the input makes, which is an error; NaN: no value.
    steps : tuple of int
        The delays of the regressor in samples.
    """

    settings: Mapping[str, Any]
    identified: IdentifiedPlant
    data: DataSet
    covariance: Matrix
    regression: RegressionExperiment
    delta_of_u: Vector
    steps: tuple[int, ...]

    @property
    def step(self) -> float:
        """Communication step [s]."""
        return self.regression.step

    @property
    def span(self) -> float:
        """Length of the run [s]."""
        return float(self.data.t[-1] - self.data.t[0])

    def bound(self, window: float = math.inf) -> AccuracyBound:
        """Return the Cramer-Rao bound of theta from y, or from its last ``window`` seconds."""
        data = self.data if window >= self.span else self.data.last(window)
        return accuracy_bound(
            self.identified.plant,
            self.identified.families,
            self.regression.theta,
            data,
            noise=self.covariance,
            offset=self.identified.offset,
        )

    def with_input(self, factor: float) -> RegressionExperiment:
        """Return the regression with an input ``factor`` times as large."""
        delta = self.regression.delta + (factor - 1.0) * self.delta_of_u
        return replace(self.regression, delta=delta)

    @property
    def leakage(self) -> float:
        """Root mean square of what u leaves in delta hat, over that of delta hat, once settled."""
        begin = self.regression.settled
        of_u = np.nanmean(self.delta_of_u[begin:] ** 2)
        whole = np.nanmean(self.regression.delta[begin:] ** 2)
        return float(np.sqrt(of_u / whole)) if whole else 0.0


def trial_of(
    subject: DesignSubject, settings: Mapping[str, Any], edits: Mapping[str, Any] | None = None
) -> Trial:
    """Simulate a variant of a scenario without noise of y.

    Parameters
    ----------
    subject : DesignSubject
    settings : mapping of dotted key to value
        What a user sets for it.
    edits : mapping of dotted key to value, optional
        What is set here, where the tables have keys that do not go with the settings.

    Raises
    ------
    CosimError
        If the variant is not valid, or cannot be simulated.
    UsageError
        If u depends on y, or y has values between the samples of a sensor.
    """
    scenario = subject.scenario.edit(set=settings if edits is None else edits)
    with ExitStack() as resources:
        builder = Builder(scenario, resources)
        builder.check()
        return _Simulation(subject, builder).trial(settings)


class _Simulation:
    """The observer of a variant, and what it follows, simulated without noise of y.

    Parameters
    ----------
    subject : DesignSubject
    builder : Builder
        Of the variant.
    """

    def __init__(self, subject: DesignSubject, builder: Builder) -> None:
        self._subject = subject
        self._builder = builder
        self._graph = _upstream_graph(builder, subject)
        _check(subject, builder, self._graph)
        self._identified = _identified(subject, builder)
        self._recording = Memory()
        run(self._graph, builder.clock, self._recording)
        self._t = seconds(self._recording.time_ns(subject.observer))
        interface = self._graph.layout[subject.observer].interface
        inputs = interface.input_columns()
        self._y = inputs["y"]
        self._u = inputs.get("u", slice(0, 0))
        self._signals = self._alpha_signals()
        self._delta = np.asarray(self._recording[f"{subject.observer}.delta"])

    def trial(self, settings: Mapping[str, Any]) -> Trial:
        """Return what the observer took in and made, and what it would make of noise."""
        subject = self._subject
        observer = self._builder.components[subject.observer]
        covariance = subject.covariance(len(self._identified.plant.C))
        response = _ObserverResponse(observer, self._t, self._y)
        data = self._data()
        delta_of_u = response.to_input(data, self._identified, self._u)
        regressor = self._builder.scenario.specs[subject.regressor]
        assert isinstance(regressor, RegressorKind)
        h = self._builder.clock.h
        return Trial(
            settings=settings,
            identified=self._identified,
            data=data,
            covariance=covariance,
            regression=self._regression(response.to_noise(covariance), regressor.delays),
            delta_of_u=delta_of_u,
            steps=tuple(round(delay / h) for delay in regressor.delays),
        )

    def _data(self) -> DataSet:
        """Return what the observer took in."""
        observer = self._subject.observer
        rows = self._recording.rows(observer)
        u = rows[:, self._u]
        return self._identified.data_set(
            self._t,
            rows[:, self._y],
            u,
            self._graph.held[observer][self._u],
            np.zeros(u.shape[1], np.bool_),  # an open loop, which was checked
            self._signals,
        )

    def _regression(
        self, noise: ReconstructionNoise, delays: Sequence[float]
    ) -> RegressionExperiment:
        """Return what the regressor would be given."""
        subject = self._subject
        builder = self._builder
        identified = self._identified
        kind = builder.scenario.specs[subject.observer]
        lag = kind.lag(subject.observer, "delta", builder.context)
        settled, start = _start(builder, subject.identifier, max(delays))
        return RegressionExperiment(
            delta=self._delta,
            alpha=identified.alpha_at(self._t - lag, self._t, self._signals),
            names=tuple(alpha.text for alpha in identified.alphas),
            families=identified.families,
            theta=np.array(subject.theta),
            step=builder.clock.h,
            noise=noise,
            settled=settled,
            start=start,
        )

    def _alpha_signals(self) -> Matrix:
        """Return the alphas that are signals, shape (N, signals)."""
        if not signals_among(self._identified.alphas):
            return np.zeros((len(self._t), 0))
        return as_columns(self._recording[f"{self._subject.regressor}.alpha"])


class _ObserverResponse:
    """What an observer makes of inputs, beyond what it makes of none.

    Parameters
    ----------
    component : Component
        After a run.
    t : Vector, shape (N,)
        Communication points [s].
    y : slice
        Its columns of the inputs.
    """

    def __init__(self, component: Component, t: Vector, y: slice) -> None:
        self._component = component
        self._t = t[: _SPAN_OF_NOISE + 1]
        self._y = y
        self._delta = component.interface.output_columns()["delta"].start
        self._of_nothing = self._driven(self._no_input())

    def to_noise(self, covariance: Matrix) -> ReconstructionNoise:
        """Return the noise of delta, once it has values."""
        factor = np.linalg.cholesky(covariance)
        has_value = np.isfinite(self._of_nothing)
        # at the first point the input sets the initial state too, which noise does only once
        first = int(np.argmax(has_value)) + 1
        responses = []
        for column in factor.T:
            u = self._no_input()
            u[first, self._y] = column
            response = self._driven(u) - self._of_nothing
            responses.append(response[first:])
        return ReconstructionNoise(np.array(responses).T)

    def _no_input(self) -> Matrix:
        return np.zeros((len(self._t), self._component.interface.n_u))

    def to_input(self, data: DataSet, identified: IdentifiedPlant, u: slice) -> Vector:
        """Return the part of delta that the known input makes, through the plant and at once."""
        plant = identified.plant
        at_rest = np.zeros(len(plant.A))
        x = simulate(plant.A, plant.B, data.t, data.u, at_rest, data.is_held)
        y = x @ plant.C.T + data.u @ plant.D.T
        followed = len(self._t)
        driven = self._no_input()
        driven[:, u] = data.u[:followed]
        driven[:, self._y] = y[:followed]
        delta = np.full(len(data.t), np.nan)
        delta[:followed] = self._driven(driven) - self._of_nothing
        return delta

    def _driven(self, u: Matrix) -> Vector:
        component = self._component
        begin, second = map(float, self._t[:2])
        component.initialize(begin, u[0])
        initial = component.outputs(begin, u[0])
        rows = component.advance(self._t, second - begin, u)
        return np.append(initial[self._delta], rows[:, self._delta])


def _upstream_graph(builder: Builder, subject: DesignSubject) -> Graph:
    """Return the graph of the observer and of what it follows."""
    names = subject.upstream
    connections = {
        to: connection
        for to, connection in builder.scenario.connections.items()
        if to.component in names
    }
    settings = builder.scenario.file.scenario
    ordered = [name for name in builder.components if name in names]
    return Graph(
        {name: builder.components[name] for name in ordered},
        connections,
        coupling=settings.coupling,
        iterations=settings.iterations,
        input_interpolation=settings.input_interpolation,
        periods={name: builder.periods[name] for name in names},
    )


def _check(subject: DesignSubject, builder: Builder, graph: Graph) -> None:
    if inputs_in_feedback(graph, subject.observer).any():
        raise UsageError(
            f"the input u of {subject.observer!r} depends on its y (feedback), which carries the "
            "noise of y into u; use an input that does not depend on y"
        )
    source = IdentifierSource(subject.identifier, builder.context)
    if source.most_samples():
        raise UsageError(
            f"y of {subject.observer!r} has values between the samples of a sensor; expected "
            "noise at every communication point: no period, dropout or time_stamps, and a step "
            "as long as the period"
        )


def _identified(subject: DesignSubject, builder: Builder) -> IdentifiedPlant:
    """Return the model of y.

    Raises
    ------
    UsageError
        If there is none.
    """
    if subject.identifier in builder.context.identified:
        return builder.context.identified[subject.identifier]
    missing = IdentifierSource(subject.identifier, builder.context).missing_model()
    raise UsageError(f"{subject.identifier!r}: {missing}")


def _start(builder: Builder, identifier: str, longest: float) -> tuple[int, int | None]:
    """Return when delta has settled, and the first point that counts where that is given."""
    clock = builder.clock
    start_time = float(builder.context.metadata[identifier]["start_time"])
    start = round((start_time - clock.start_time) / clock.h)
    settled = start - round(longest / clock.h)
    kind = builder.scenario.specs[identifier]
    assert isinstance(kind, IdentifierKind)
    return settled, start if isinstance(kind.start, float) else None
