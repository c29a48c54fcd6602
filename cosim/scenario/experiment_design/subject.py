"""What of a scenario an experiment is designed for: identifier, observer, noise of y, theta."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from cosim.arrays import Matrix
from cosim.core.port import Port
from cosim.errors import UsageError, option
from cosim.scenario.building.known_truth import (
    covariance_of,
    disturbance_among,
    noise_of,
    parameters_by_term,
)
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.kinds.control import SensorKind
from cosim.scenario.kinds.field_data import FieldDataKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.plants import RecordingKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import NoiseKind


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
    noise: Matrix
    noise_source: str
    theta: tuple[float, ...]

    @property
    def identifier_kind(self) -> IdentifierKind:
        """The table of the identifier."""
        kind = self.scenario.specs[self.identifier]
        assert isinstance(kind, IdentifierKind)
        return kind

    @property
    def regressor_kind(self) -> RegressorKind:
        """The table of the regressor."""
        kind = self.scenario.specs[self.regressor]
        assert isinstance(kind, RegressorKind)
        return kind

    def covariance(self, outputs: int) -> Matrix:
        """Return the covariance of the noise of y, shape (n_y, n_y).

        Raises
        ------
        UsageError
            If it is of another number of outputs.
        """
        covariance = covariance_of(self.noise, outputs)
        if covariance is None:
            raise UsageError(
                f"noise: expected one number, or one for each of {outputs} outputs, got "
                f"{len(self.noise)}"
            )
        return covariance


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
    identifier = _only_identifier(scenario)
    regressor = _driver(scenario, identifier, "regressor", RegressorKind)
    observer = _driver(scenario, regressor, "delta", UnknownInputObserverKind)
    designed = scenario.specs[observer]
    if isinstance(designed, UnknownInputObserverKind) and designed.relinearize:
        raise UsageError(
            f"{observer!r} is relinearized at its estimate, so that its response to noise is not "
            "linear; set relinearize = false to design at a single operating point"
        )
    upstream = _upstream(scenario, {observer})
    _check_models(scenario, upstream)
    deviations, source = noise_of(scenario, identifier, observer, noise)
    edits: dict[str, Any] = {}
    for name in upstream:
        kind = scenario.specs[name]
        if isinstance(kind, SensorKind):
            edits |= {f"components.{name}.noise": 0.0, f"components.{name}.jitter": 0.0}
        if isinstance(kind, NoiseKind):
            edits[f"components.{name}.deviation"] = 0.0
    values = _theta(scenario, regressor, upstream, theta, edits)
    if any(to.component == regressor and to.signal == "alpha" for to in scenario.connections):
        upstream = _upstream(scenario, {observer, regressor})
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


def _only_identifier(scenario: Scenario) -> str:
    names = [name for name, kind in scenario.specs.items() if isinstance(kind, IdentifierKind)]
    if len(names) != 1:
        found = ", ".join(names) or "none"
        raise UsageError(f"{scenario.name}: identifiers: expected one to design for, got {found}")
    return names[0]


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


def _upstream(scenario: Scenario, components: Collection[str]) -> frozenset[str]:
    """Return the components that some follow, directly or through others, and themselves."""
    upstream: set[str] = set()
    front = set(components)
    while front:
        upstream |= front
        sources = [scenario.sources_of(name) for name in front]
        front = set().union(*sources) - upstream
    return frozenset(upstream)


def _check_models(scenario: Scenario, upstream: frozenset[str]) -> None:
    """Check that what is upstream can be simulated under other steps and without noise."""
    for name in sorted(upstream):
        kind = scenario.specs[name]
        if isinstance(kind, RecordingKind | FieldDataKind):
            raise UsageError(
                f"{name!r} is recorded (kind {kind.kind!r}): it has no model, and its noise "
                "cannot be left out; use the plant itself, such as kind 'descriptor' or 'fmu'"
            )


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
    at = 0
    for place, replaced in zip(places, own, strict=True):
        part = values[at : at + len(replaced)]
        if part:
            changed[place]["theta"] = part[0] if len(part) == 1 else part
        at += len(part)
    edits[f"components.{name}.terms"] = changed
    return tuple(values)
