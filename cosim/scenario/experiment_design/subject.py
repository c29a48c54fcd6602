"""What of a scenario an experiment is designed for: identifier, observer, noise of y, theta."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.errors import UsageError, option
from cosim.scenario.kinds.field_data import FieldDataKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.plants import RecordingKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sensors import SensorKind
from cosim.scenario.kinds.sources import DisturbanceKind, NoiseKind
from cosim.scenario.kinds.stated_noise import stated_covariance
from cosim.scenario.kinds.terms import FamilyTerm, ValuedTerm
from cosim.scenario.parsing import Scenario

NOISE_NEEDED: Final = (
    "found no noise of y; needed its deviation: that of a sensor which drives the observer "
    "directly, the deviation of the identifier, or"
)


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
                f"noise: found {len(self.noise)} numbers; needed one, or one for each of {outputs} "
                "outputs"
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
            f"{observer!r} is linearized anew at its estimate, so that its noise is no linear "
            "response; needed relinearize = false, for what one operating point says"
        )
    upstream = _upstream(scenario, {observer})
    _check_models(scenario, upstream)
    deviations, source = noise_of(scenario, identifier, observer, noise)
    edits: dict[str, Any] = {}
    for name in upstream:
        kind = scenario.specs[name]
        if isinstance(kind, SensorKind):
            edits |= {f"{name}.noise": 0.0, f"{name}.jitter": 0.0}
        if isinstance(kind, NoiseKind):
            edits[f"{name}.deviation"] = 0.0
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
        raise UsageError(f"{scenario.name}: identifiers: found {found}; needed one to design for")
    return names[0]


def _driver(scenario: Scenario, component: str, signal: str, needed: type[Any]) -> str:
    name = scenario.driver(Port(component, signal))
    if name is None or not isinstance(scenario.specs.get(name), needed):
        found = "several components, or none" if name is None else repr(name)
        kind = needed.model_fields["kind"].annotation.__args__[0]
        raise UsageError(
            f"'{component}.{signal}' is driven by {found}; needed one component of kind {kind!r}"
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
                f"{name!r} is recorded (kind {kind.kind!r}): it has no model, and its noise cannot "
                "be left out; needed the plant itself, such as kind 'descriptor' or 'fmu'"
            )


def covariance_of(noise: Matrix, outputs: int) -> Matrix | None:
    """Return the covariance of noise from deviations, or as it is; None: they do not fit y."""
    if noise.ndim == 2:
        return noise
    if len(noise) not in (1, outputs):
        return None
    return np.diag(np.broadcast_to(noise, outputs) ** 2)


def noise_of(
    scenario: Scenario,
    identifier: str,
    observer: str,
    given: float | Sequence[float] | None = None,
) -> tuple[Matrix, str]:
    """Return deviations or covariance of the noise of y, and where they are from.

    Raises
    ------
    UsageError
        If nothing says what they are.
    """
    if given is not None:
        return _checked_deviations(given), option("noise")
    kind = scenario.specs[identifier]
    assert isinstance(kind, IdentifierKind)
    if kind.deviation is not None:
        return _checked_deviations(kind.deviation), f"{identifier}.deviation"
    if kind.covariance is not None:
        covariance = stated_covariance(None, kind.covariance, len(kind.covariance))
        assert covariance is not None
        return covariance, f"{identifier}.covariance"
    designed = scenario.specs[observer]
    assert isinstance(designed, UnknownInputObserverKind)
    if designed.noise is not None:
        return _checked_deviations(designed.noise), f"{observer}.noise"
    return _noise_of_sensor(scenario, observer)


def _checked_deviations(given: float | Sequence[float]) -> Matrix:
    deviations = np.atleast_1d(np.asarray(given, np.float64))
    usable = (deviations > 0.0) & (deviations < math.inf)
    if deviations.ndim != 1 or not usable.all():
        raise UsageError(f"noise: found {given}; needed positive finite deviations")
    return deviations


def _noise_of_sensor(scenario: Scenario, observer: str) -> tuple[Matrix, str]:
    """Return the noise of the sensor that drives y directly."""
    to = Port(observer, "y")
    connection: Connection | None = scenario.connections.get(to)
    name = scenario.driver(to)
    kind = None if name is None else scenario.specs.get(name)
    if connection is None or name is None or not isinstance(kind, SensorKind):
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    if connection.matrix.ndim:
        raise UsageError(
            f"'{to}' mixes the outputs of {name!r} by a matrix; give the noise of y by "
            f"{option('noise')}"
        )
    deviations = abs(float(connection.matrix)) * np.atleast_1d(np.asarray(kind.noise, np.float64))
    if not deviations.all():
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    return deviations, f"{name}.noise"


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
                f"{scenario.name}: theta is not known: no single component of kind 'disturbance' "
                f"drives the plant; give {option('theta')}"
            )
        return tuple(map(float, given))
    own, places = parameters_by_term(scenario, regressor, name)
    if given is None:
        return tuple(chain.from_iterable(own))
    values = list(map(float, given))
    needed = sum(map(len, own))
    if len(values) != needed or not np.isfinite(values).all():
        raise UsageError(f"theta: found {values}; needed {needed} finite numbers")
    changed = deepcopy(list(scenario.tree["components"][name]["terms"]))
    at = 0
    for place, replaced in zip(places, own, strict=True):
        part = values[at : at + len(replaced)]
        if part:
            changed[place]["theta"] = part[0] if len(part) == 1 else part
        at += len(part)
    edits[f"{name}.terms"] = changed
    return tuple(values)


def disturbance_among(scenario: Scenario, components: Collection[str]) -> str | None:
    """Return the only component that makes a disturbance of the class; None: there is not one."""
    names = [name for name in components if isinstance(scenario.specs[name], DisturbanceKind)]
    return names[0] if len(names) == 1 else None


def parameters_by_term(
    scenario: Scenario, regressor: str, disturbance: str
) -> tuple[list[list[float]], list[int]]:
    """Return the parameters of every term of a regressor, and which of the disturbance it is.

    Raises
    ------
    UsageError
        If their terms differ.
    """
    kind = scenario.specs[regressor]
    makes = scenario.specs[disturbance]
    assert isinstance(kind, RegressorKind)
    assert isinstance(makes, DisturbanceKind)
    places = _places(kind.terms, makes.terms)
    if places is None:
        raise UsageError(
            f"the terms of {regressor!r} are not those of {disturbance!r}, which makes the "
            "disturbance; needed the same alphas and families in both"
        )
    return [_values(makes.terms[place]) for place in places], places


def _places(terms: Sequence[FamilyTerm], others: Sequence[FamilyTerm]) -> list[int] | None:
    """Return which of the other terms each term is; None: they differ."""
    left = list(range(len(others)))
    places = []
    for term in terms:
        same = [place for place in left if _shape(others[place]) == _shape(term)]
        if not same:
            return None
        left.remove(same[0])
        places.append(same[0])
    return None if left else places


def _shape(term: FamilyTerm) -> dict[str, Any]:
    """Return what a term has without its parameters and constants."""
    return {key: getattr(term, key) for key in FamilyTerm.model_fields}


def _values(term: ValuedTerm) -> list[float]:
    theta = () if term.theta is None else term.theta
    return [float(value) for value in np.atleast_1d(theta)]
