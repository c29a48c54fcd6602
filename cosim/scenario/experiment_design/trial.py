"""What of a scenario an experiment is designed for, and variants of it without noise of y.

A trial has the signals of a variant, and what noise would leave in delta.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.errors import UsageError, option
from cosim.scenario.assumptions.beginning import disturbance_among, noise_of, parameters_by_term
from cosim.scenario.building.build import Builder
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.field_data import FieldDataKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import (
    NO_SIGNALS,
    IdentifiedPlant,
    IdentifierSource,
    inputs_in_feedback,
)
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.parts import SensorKind
from cosim.scenario.kinds.plants import RecordingKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import NoiseKind
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
    noise_source : str
        Where that is from.
    regression : RegressionExperiment
        What the observer makes of it.
    delta_of_u : Vector, shape (N,)
        The part of delta hat that the input makes, which is an error; NaN: no value.
    delays : tuple of float
        Those of the regressor [s].
    """

    settings: Mapping[str, Any]
    identified: IdentifiedPlant
    data: DataSet
    covariance: Matrix
    noise_source: str
    regression: RegressionExperiment
    delta_of_u: Vector
    delays: tuple[float, ...]

    @property
    def step(self) -> float:
        """Communication step [s]."""
        return self.regression.step

    @property
    def steps(self) -> tuple[int, ...]:
        """The delays of the regressor in samples."""
        return tuple(round(delay / self.step) for delay in self.delays)

    @property
    def span(self) -> float:
        """Length of the run [s]."""
        return float(self.data.t[-1] - self.data.t[0])

    def bound(self, window: float = math.inf) -> AccuracyBound:
        """Return the Cramer-Rao bound of theta from y, or from its last ``window`` seconds."""
        return accuracy_bound(
            self.identified.plant,
            self.identified.families,
            self.regression.theta,
            self.data if window >= self.span else self.data.last(window),
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


class DesignSubject:
    """What of a scenario an experiment is designed for, and its variants without noise of y.

    Parameters
    ----------
    scenario : Scenario
    noise : float or sequence of float, optional
        Deviations of the noise of y; by default what the tables state.
    theta : sequence of float, optional
        By default that of the scenario's disturbance.

    Attributes
    ----------
    scenario : Scenario
    identifier, regressor, observer : str
        Names of the components.
    theta : tuple of float

    Raises
    ------
    UsageError
        If there is not one identifier behind one observer, the plant has no model, or theta is not
        known.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        noise: float | Sequence[float] | None = None,
        theta: Sequence[float] | None = None,
    ) -> None:
        specs = scenario.specs
        identifiers = [name for name, kind in specs.items() if isinstance(kind, IdentifierKind)]
        if len(identifiers) != 1:
            raise UsageError(
                f"{scenario.name}: identifiers: expected one to design for, got "
                f"{', '.join(identifiers) or 'none'}"
            )
        self.scenario = scenario
        self._noise = noise
        self.identifier = identifiers[0]
        self.regressor = scenario.driver(Port(self.identifier, "regressor")) or ""
        observer = scenario.driver(Port(self.regressor, "delta")) if self.regressor else None
        if observer is None or not isinstance(specs.get(observer), UnknownInputObserverKind):
            raise UsageError(
                f"{self.identifier!r}: expected one regressor that drives it, and one component "
                "of kind 'unknown-input-observer' that drives the regressor"
            )
        self.observer = observer
        self._upstream = frozenset(scenario.upstream(observer).specs)
        self._edits = dict(self._without_noise())
        self.theta = self._theta(theta)
        if scenario.sources(Port(self.regressor, "alpha")):
            self._upstream = frozenset(scenario.upstream(self.regressor).specs)

    def _without_noise(self) -> Iterator[tuple[str, Any]]:
        """Yield the edits that take the noise of y away."""
        for name in sorted(self._upstream):
            match self.scenario.specs[name]:
                case RecordingKind() | FieldDataKind() as recorded:
                    raise UsageError(
                        f"{name!r} is recorded (kind {recorded.kind!r}): it has no model, and its "
                        "noise cannot be left out; use the plant itself, such as kind "
                        "'descriptor' or 'fmu'"
                    )
                case SensorKind():
                    yield f"components.{name}.noise", 0.0
                    yield f"components.{name}.jitter", 0.0
                case NoiseKind():
                    yield f"components.{name}.deviation", 0.0

    def _theta(self, given: Sequence[float] | None) -> tuple[float, ...]:
        """Return theta in the order of the terms; have the disturbance use one given."""
        scenario = self.scenario
        name = disturbance_among(scenario, self._upstream)
        if name is None:
            if given is None:
                raise UsageError(
                    f"{scenario.name}: theta is unknown: no single component of kind "
                    f"'disturbance' drives the plant; give {option('theta')}"
                )
            return tuple(map(float, given))
        own, places = parameters_by_term(scenario, self.regressor, name)
        if given is None:
            return tuple(chain.from_iterable(own))
        values = list(map(float, given))
        needed = sum(map(len, own))
        if len(values) != needed or not np.isfinite(values).all():
            raise UsageError(f"theta: expected {needed} finite numbers, got {values}")
        rest = iter(values)
        for place, replaced in zip(places, own, strict=True):
            part = [next(rest) for _ in replaced]
            if part:
                key = f"components.{name}.terms[{place}].theta"
                self._edits[key] = part[0] if len(part) == 1 else part
        return tuple(values)

    def trial(
        self,
        settings: Mapping[str, Any] = MappingProxyType({}),
        edits: Mapping[str, Any] | None = None,
    ) -> Trial:
        """Simulate a variant of the scenario without noise of y.

        Parameters
        ----------
        settings : mapping of dotted key to value
            What a user sets for it; by default it is the scenario as it is.
        edits : mapping of dotted key to value, optional
            What is set here, where the tables have keys that do not go with the settings.

        Raises
        ------
        CosimError
            If the variant is not valid, or cannot be simulated.
        UsageError
            If u depends on y, y has values between the samples of a sensor or no model, or the
            noise is not known, or of another number of outputs.
        """
        changes = settings if edits is None else edits
        scenario = self.scenario.edit(set={**self._edits, **changes})
        observer = self.observer
        with ExitStack() as resources:
            builder = Builder(scenario, resources)
            builder.check()
            graph = builder.graph_of(self._upstream)
            identified = self._identified(builder, graph)
            outputs = len(identified.plant.C)
            covariance, source = noise_of(
                self.scenario, self.identifier, observer, outputs, self._noise
            )
            recording = Memory()
            run(graph, builder.clock, recording)
            t, rows = identified.recorded(recording)
            data = identified.data_set(graph, t, rows)
            response = _ObserverResponse(builder.components[observer], t)
            regressor = scenario.specs[self.regressor]
            identifier = scenario.specs[self.identifier]
            assert isinstance(regressor, RegressorKind)
            assert isinstance(identifier, IdentifierKind)
            clock = builder.clock
            start_time = float(builder.context.metadata[self.identifier]["start_time"])
            start = round((start_time - clock.start_time) / clock.h)
            lag = scenario.specs[observer].lag(observer, "delta", builder.context)
            regression = RegressionExperiment(
                delta=np.asarray(recording[f"{observer}.delta"]),
                alpha=identified.alpha_at(t - lag, t, rows.get("alpha", NO_SIGNALS)),
                names=tuple(alpha.text for alpha in identified.alphas),
                families=identified.families,
                theta=np.array(self.theta),
                step=clock.h,
                noise=response.to_noise(covariance),
                settled=start - round(max(regressor.delays) / clock.h),
                start=start if isinstance(identifier.start, float) else None,
            )
            return Trial(
                settings=settings,
                identified=identified,
                data=data,
                covariance=covariance,
                noise_source=source,
                regression=regression,
                delta_of_u=response.to_input(data, identified),
                delays=regressor.delays,
            )

    def _identified(self, builder: Builder, graph: Graph) -> IdentifiedPlant:
        """Return the model of y, after checks that its noise is all that is left out."""
        if inputs_in_feedback(graph, self.observer).any():
            raise UsageError(
                f"the input u of {self.observer!r} depends on its y (feedback), which carries the "
                "noise of y into u; use an input that does not depend on y"
            )
        source = IdentifierSource(self.identifier, builder.context)
        if source.most_samples():
            raise UsageError(
                f"y of {self.observer!r} has values between the samples of a sensor; expected "
                "noise at every communication point: no period, dropout or time_stamps, and a "
                "step as long as the period"
            )
        identified: IdentifiedPlant | None = builder.context.identified.get(self.identifier)
        if identified is None:
            raise UsageError(f"{self.identifier!r}: {source.missing_model()}")
        return identified


class _ObserverResponse:
    """What an observer makes of inputs, beyond what it makes of none.

    Parameters
    ----------
    component : Component
        After a run.
    t : Vector, shape (N,)
        Communication points [s].
    """

    def __init__(self, component: Component, t: Vector) -> None:
        self._component = component
        self._inputs = component.interface.input_columns()
        self._t = t[: _SPAN_OF_NOISE + 1]
        self._delta = component.interface.output_columns()["delta"].start
        self._of_nothing = self._driven()

    def to_noise(self, covariance: Matrix) -> ReconstructionNoise:
        """Return the noise of delta, once it has values."""
        # at the first point the input sets the initial state too, which noise does only once
        first = int(np.argmax(np.isfinite(self._of_nothing))) + 1
        responses = []
        for column in np.linalg.cholesky(covariance).T:
            y = np.zeros((len(self._t), len(column)))
            y[first] = column
            response = self._driven(y=y) - self._of_nothing
            responses.append(response[first:])
        return ReconstructionNoise(np.array(responses).T)

    def to_input(self, data: DataSet, identified: IdentifiedPlant) -> Vector:
        """Return the part of delta that the known input makes, through the plant and at once."""
        plant = identified.plant
        x = simulate(plant.A, plant.B, data.t, data.u, np.zeros(len(plant.A)), data.is_held)
        delta = np.full(len(data.t), np.nan)
        driven = self._driven(y=x @ plant.C.T + data.u @ plant.D.T, u=data.u)
        delta[: len(self._t)] = driven - self._of_nothing
        return delta

    def _driven(self, **signals: Matrix) -> Vector:
        """Return delta of inputs by name; those that are not given are 0."""
        u = np.zeros((len(self._t), self._component.interface.n_u))
        for name, values in signals.items():
            u[:, self._inputs.get(name, slice(0, 0))] = values[: len(u)]
        begin, second = map(float, self._t[:2])
        self._component.initialize(begin, u[0])
        initial = self._component.outputs(begin, u[0])
        rows = self._component.advance(self._t, second - begin, u)
        return np.append(initial[self._delta], rows[:, self._delta])
