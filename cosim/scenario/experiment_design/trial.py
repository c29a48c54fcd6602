"""What of a scenario an experiment is designed for, and variants of it without noise of y.

A trial has the signals of a variant, and what noise would leave in delta.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.clock import seconds
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.errors import UsageError, option
from cosim.native.estimation.alphas import signals_among
from cosim.scenario.building.build import Builder
from cosim.scenario.building.known_truth import (
    covariance_of,
    disturbance_among,
    noise_of,
    parameters_by_term,
)
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.control import SensorKind
from cosim.scenario.kinds.field_data import FieldDataKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identification_source import IdentifierSource
from cosim.scenario.kinds.identified_plant import IdentifiedPlant, inputs_in_feedback
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.plants import RecordingKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import NoiseKind
from cosim.theory.disturbed_plant import DataSet
from cosim.theory.experiment_design.bound import AccuracyBound, accuracy_bound
from cosim.theory.experiment_design.predictions import RegressionExperiment
from cosim.theory.experiment_design.reconstruction_noise import ReconstructionNoise
from cosim.theory.forced_response import simulate

_SPAN_OF_NOISE: Final = 200_000  # samples that a response to noise is followed over, at most


# --- what is designed for ---


@dataclass(frozen=True, eq=False, kw_only=True)
class DesignSubject:
    """The parts of a scenario that a design is made for.

    Parameters
    ----------
    scenario : Scenario
        Without noise of y.
    identifier, regressor, observer : str
        Names of the components.
    upstream : frozenset of str
        The components that the observer follows, and itself; with an alpha that is a signal those
        of the regressor too.
    noise : Matrix, shape (n,) or (n_y, n_y)
        Deviations of the noise of y, one or one an output, or its covariance.
    noise_source : str
        Where that is from.
    theta : tuple of float
    """

    scenario: Scenario
    identifier: str
    regressor: str
    observer: str
    upstream: frozenset[str]
    noise: Vector | Matrix
    noise_source: str
    theta: tuple[float, ...]


def subject_of(
    scenario: Scenario,
    *,
    noise: float | Sequence[float] | None = None,
    theta: Sequence[float] | None = None,
) -> DesignSubject:
    """Return what an experiment is designed for.

    Parameters
    ----------
    scenario : Scenario
    noise : float or sequence of float, optional
        Deviations of the noise of y; by default what the tables state.
    theta : sequence of float, optional
        By default that of the scenario's disturbance.

    Raises
    ------
    UsageError
        If there is not one identifier behind one observer, the plant has no model, or the noise or
        theta is not known.
    """
    specs = scenario.specs
    identifiers = [name for name, kind in specs.items() if isinstance(kind, IdentifierKind)]
    if len(identifiers) != 1:
        found = ", ".join(identifiers) or "none"
        raise UsageError(f"{scenario.name}: identifiers: expected one to design for, got {found}")
    (identifier,) = identifiers
    regressor = _driver(scenario, identifier, "regressor", RegressorKind)
    observer = _driver(scenario, regressor, "delta", UnknownInputObserverKind)
    designed = specs[observer]
    if isinstance(designed, UnknownInputObserverKind) and designed.relinearize:
        raise UsageError(
            f"{observer!r} is relinearized at its estimate, so that its response to noise is not "
            "linear; set relinearize = false to design at a single operating point"
        )
    upstream = frozenset(scenario.upstream(observer).specs)
    edits: dict[str, Any] = {}
    for name in sorted(upstream):
        match specs[name]:
            case RecordingKind() | FieldDataKind() as recorded:
                raise UsageError(
                    f"{name!r} is recorded (kind {recorded.kind!r}): it has no model, and its "
                    "noise cannot be left out; use the plant itself, such as kind 'descriptor' or "
                    "'fmu'"
                )
            case SensorKind():
                edits |= {f"components.{name}.noise": 0.0, f"components.{name}.jitter": 0.0}
            case NoiseKind():
                edits[f"components.{name}.deviation"] = 0.0
    deviations, source = noise_of(scenario, identifier, observer, noise)
    values = _theta(scenario, regressor, upstream, theta, edits)
    if any(to.component == regressor and to.signal == "alpha" for to in scenario.connections):
        upstream = frozenset(scenario.upstream(regressor).specs)
    return DesignSubject(
        scenario=scenario.edit(set=edits),
        identifier=identifier,
        regressor=regressor,
        observer=observer,
        upstream=upstream,
        noise=deviations,
        noise_source=source,
        theta=values,
    )


def _driver(scenario: Scenario, component: str, signal: str, needed: type[Any]) -> str:
    name = scenario.driver(Port(component, signal))
    if name is None or not isinstance(scenario.specs.get(name), needed):
        found = "several components, or none" if name is None else repr(name)
        kind = needed.model_fields["kind"].annotation.__args__[0]
        raise UsageError(
            f"'{component}.{signal}': expected one component of kind {kind!r} as its source, got "
            f"{found}"
        )
    return name


def _theta(
    scenario: Scenario,
    regressor: str,
    upstream: frozenset[str],
    given: Sequence[float] | None,
    edits: dict[str, Any],
) -> tuple[float, ...]:
    """Return theta in the order of the regressor's terms; have the disturbance use one given."""
    name = disturbance_among(scenario, upstream)
    if name is None:
        if given is None:
            raise UsageError(
                f"{scenario.name}: theta is unknown: no single component of kind 'disturbance' "
                f"drives the plant; give {option('theta')}"
            )
        return tuple(map(float, given))
    own, places = parameters_by_term(scenario, regressor, name)
    if given is None:
        return tuple(chain.from_iterable(own))
    values = list(map(float, given))
    needed = sum(map(len, own))
    if len(values) != needed or not np.isfinite(values).all():
        raise UsageError(f"theta: expected {needed} finite numbers, got {values}")
    changed = deepcopy(list(scenario.tree["components"][name]["terms"]))
    rest = iter(values)
    for place, replaced in zip(places, own, strict=True):
        part = [next(rest) for _ in replaced]
        if part:
            changed[place]["theta"] = part[0] if len(part) == 1 else part
    edits[f"components.{name}.terms"] = changed
    return tuple(values)


# --- variants ---


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
    delays : tuple of float
        Those of the regressor [s].
    """

    settings: Mapping[str, Any]
    identified: IdentifiedPlant
    data: DataSet
    covariance: Matrix
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
        If u depends on y, y has values between the samples of a sensor or no model, or the noise
        is of another number of outputs.
    """
    scenario = subject.scenario.edit(set=settings if edits is None else edits)
    observer = subject.observer
    with ExitStack() as resources:
        builder = Builder(scenario, resources)
        builder.check()
        graph = builder.graph_of(subject.upstream)
        identified = _identified(builder, subject, graph)
        recording = Memory()
        run(graph, builder.clock, recording)
        t = seconds(recording.time_ns(observer))
        delta = np.asarray(recording[f"{observer}.delta"])
        signals = np.zeros((len(t), 0))
        if signals_among(identified.alphas):
            signals = as_columns(recording[f"{subject.regressor}.alpha"])
        inputs = graph.layout[observer].interface.input_columns()
        y = inputs["y"]
        u = inputs.get("u", slice(0, 0))
        rows = recording.rows(observer)
        data = identified.data_set(graph, t, rows[:, y], rows[:, u], signals)
        covariance = covariance_of(subject.noise, len(identified.plant.C))
        if covariance is None:
            raise UsageError(
                "noise: expected one number, or one for each of "
                f"{len(identified.plant.C)} outputs, got {len(subject.noise)}"
            )
        response = _ObserverResponse(builder.components[observer], t)
        regressor = scenario.specs[subject.regressor]
        assert isinstance(regressor, RegressorKind)
        lag = scenario.specs[observer].lag(observer, "delta", builder.context)
        settled, start = _start(builder, subject.identifier, max(regressor.delays))
        regression = RegressionExperiment(
            delta=delta,
            alpha=identified.alpha_at(t - lag, t, signals),
            names=tuple(alpha.text for alpha in identified.alphas),
            families=identified.families,
            theta=np.array(subject.theta),
            step=builder.clock.h,
            noise=response.to_noise(y, covariance),
            settled=settled,
            start=start,
        )
        return Trial(
            settings=settings,
            identified=identified,
            data=data,
            covariance=covariance,
            regression=regression,
            delta_of_u=response.to_input(data, identified, y, u),
            delays=regressor.delays,
        )


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
        self._t = t[: _SPAN_OF_NOISE + 1]
        self._delta = component.interface.output_columns()["delta"].start
        self._of_nothing = self._driven(self._no_input())

    def to_noise(self, y: slice, covariance: Matrix) -> ReconstructionNoise:
        """Return the noise of delta, once it has values."""
        # at the first point the input sets the initial state too, which noise does only once
        first = int(np.argmax(np.isfinite(self._of_nothing))) + 1
        responses = []
        for column in np.linalg.cholesky(covariance).T:
            u = self._no_input()
            u[first, y] = column
            response = self._driven(u) - self._of_nothing
            responses.append(response[first:])
        return ReconstructionNoise(np.array(responses).T)

    def to_input(self, data: DataSet, identified: IdentifiedPlant, y: slice, u: slice) -> Vector:
        """Return the part of delta that the known input makes, through the plant and at once."""
        plant = identified.plant
        x = simulate(plant.A, plant.B, data.t, data.u, np.zeros(len(plant.A)), data.is_held)
        followed = len(self._t)
        driven = self._no_input()
        driven[:, u] = data.u[:followed]
        driven[:, y] = (x @ plant.C.T + data.u @ plant.D.T)[:followed]
        delta = np.full(len(data.t), np.nan)
        delta[:followed] = self._driven(driven) - self._of_nothing
        return delta

    def _no_input(self) -> Matrix:
        return np.zeros((len(self._t), self._component.interface.n_u))

    def _driven(self, u: Matrix) -> Vector:
        begin, second = map(float, self._t[:2])
        self._component.initialize(begin, u[0])
        initial = self._component.outputs(begin, u[0])
        rows = self._component.advance(self._t, second - begin, u)
        return np.append(initial[self._delta], rows[:, self._delta])


def _identified(builder: Builder, subject: DesignSubject, graph: Graph) -> IdentifiedPlant:
    """Return the model of y, after checks that its noise is all that is left out.

    Raises
    ------
    UsageError
        If there is none, u depends on y, or y has values between samples.
    """
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
    identified = builder.context.identified.get(subject.identifier)
    if identified is None:
        raise UsageError(f"{subject.identifier!r}: {source.missing_model()}")
    return identified


def _start(builder: Builder, identifier: str, longest: float) -> tuple[int, int | None]:
    """Return when delta has settled, and the first point that counts where that is given."""
    clock = builder.clock
    start_time = float(builder.context.metadata[identifier]["start_time"])
    start = round((start_time - clock.start_time) / clock.h)
    settled = start - round(longest / clock.h)
    kind = builder.scenario.specs[identifier]
    assert isinstance(kind, IdentifierKind)
    return settled, start if isinstance(kind.start, float) else None
